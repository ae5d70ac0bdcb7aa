// A minimal viewer: three.js and its loader, the model in view, a plain background, a directional and a sky light.
import * as THREE from 'three';
import { GLTFLoader } from 'three/addons/loaders/GLTFLoader.js';

const GRAY = 0x9a9a9a;
const DARK = 0x202020; // background of points, most of which are as light as the gray
const FROM = new THREE.Vector3(0.35, 0.25, 1).normalize(); // +z is the front of a glTF model
const FOV = 35;
const MARGIN = 1.08;
const FAR_OUT = 0.01;

// Return what must be in view: everything but the farthest points on each side, which would make the rest small.
function middling(scene, farOut) {
  const places = [];
  const lines = [];
  scene.traverse((object) => {
    const position = object.geometry?.attributes.position;
    for (let i = 0; i < (position?.count ?? 0); i++) {
      const place = new THREE.Vector3().fromBufferAttribute(position, i).applyMatrix4(object.matrixWorld);
      (object.isLine ? lines : places).push(place);
    }
  });
  const low = new THREE.Vector3();
  const high = new THREE.Vector3();
  for (const axis of ['x', 'y', 'z']) {
    const sorted = Float64Array.from(places, (place) => place[axis]).sort();
    low[axis] = sorted[Math.floor(farOut * (sorted.length - 1))];
    high[axis] = sorted[Math.ceil((1 - farOut) * (sorted.length - 1))];
  }
  const inner = new THREE.Box3(low, high);
  const kept = [...places.filter((place) => inner.containsPoint(place)), ...lines];
  return { box: new THREE.Box3().setFromPoints(kept), places: kept };
}

// Place the camera as near as possible with all places in view.
function framed({ box, places }, aspect) {
  const camera = new THREE.PerspectiveCamera(FOV, aspect, 0.01, 1000);
  const middle = box.getCenter(new THREE.Vector3());
  camera.position.copy(middle).add(FROM);
  camera.lookAt(middle);
  const tan = Math.tan(THREE.MathUtils.degToRad(FOV / 2));
  const turned = camera.quaternion.clone().invert();
  const distance = places.reduce((farthest, place) => {
    const { x, y, z } = place.clone().sub(middle).applyQuaternion(turned);
    return Math.max(farthest, z + (MARGIN * Math.max(Math.abs(x) / aspect, Math.abs(y))) / tan);
  }, 0);
  camera.position.copy(middle).addScaledVector(FROM, distance);
  camera.near = distance / 100;
  camera.far = distance * 100;
  camera.updateProjectionMatrix();
  return camera;
}

function counted(scene) {
  const found = { triangles: 0, points: 0, lines: 0, textures: 0, materials: new Set(), finite: true };
  scene.traverse((object) => {
    if (!object.geometry) return;
    const { position } = object.geometry.attributes;
    const count = (object.geometry.index ?? position).count;
    if (object.isMesh) found.triangles += count / 3;
    if (object.isPoints) found.points += count;
    if (object.isLine) found.lines += count / 2;
    if (object.material.map?.image?.width > 0) found.textures += 1;
    found.materials.add(object.material.type);
    found.finite &&= position.array.every(Number.isFinite);
  });
  return { ...found, materials: [...found.materials] };
}

function drawn(renderer, background, { width, height }) {
  const pixels = new Uint8Array(4 * width * height);
  const gl = renderer.getContext();
  gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
  const colors = {};
  let other = 0;
  for (let i = 0; i < pixels.length; i += 4) {
    const color = (pixels[i] << 16) | (pixels[i + 1] << 8) | pixels[i + 2];
    if (color === background) continue;
    other += 1;
    colors[color] = (colors[color] ?? 0) + 1;
  }
  const most = Object.entries(colors).sort((a, b) => b[1] - a[1]).slice(0, 2);
  return { covered: other / (width * height), most: most.map(([color]) => Number(color)) };
}

window.show = async (url, size) => {
  const gltf = await new GLTFLoader().loadAsync(url);
  const renderer = new THREE.WebGLRenderer({ antialias: true, preserveDrawingBuffer: true });
  renderer.setSize(size.width, size.height);
  const scene = new THREE.Scene();
  const parts = counted(gltf.scene);
  const background = parts.triangles ? GRAY : DARK;
  scene.background = new THREE.Color(background);
  scene.add(gltf.scene, new THREE.HemisphereLight(0xffffff, 0x888888, 2), new THREE.DirectionalLight(0xffffff, 2));
  const box = new THREE.Box3().setFromObject(gltf.scene);
  scene.updateMatrixWorld();
  renderer.render(scene, framed(middling(gltf.scene, parts.triangles ? 0 : FAR_OUT), size.width / size.height));
  return {
    ...parts, ...drawn(renderer, background, size), cameras: gltf.cameras.length,
    low: box.min.toArray(), high: box.max.toArray(), png: renderer.domElement.toDataURL('image/png'),
  };
};

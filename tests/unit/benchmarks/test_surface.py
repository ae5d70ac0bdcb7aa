import numpy as np
import pytest

from benchmarks.surface.photos import likeness, psnr_db
from benchmarks.surface.rendered.truth import seen_places, truth_scores
from benchmarks.surface.sparse_poisson import points_ply
from sfm_app.geometry.poses import Similarity
from sfm_app.synthetic.cameras import Views, axis_rotation, look_at, make_camera
from sfm_app.synthetic.photo_folder import Truth
from sfm_app.synthetic.render import Picture
from sfm_app.types import Surface

TURN = Similarity(2.5, axis_rotation(np.array([0.6, 0.0, 0.8]), 40.0), np.array([3.0, -1.0, 2.0]))


def sheet(x, y=0.0, side=2.0, *, down=False):
    """A square of that side in the plane of that height, in the middle at x: (4, 3) and two triangles that face up."""
    h = side / 2
    vertices = np.array([[x - h, y, -h], [x - h, y, h], [x + h, y, h], [x + h, y, -h]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    return vertices, faces[:, ::-1] if down else faces


def joined(*parts):
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in parts[:-1])])
    faces = [faces + start for (_, faces), start in zip(parts, starts, strict=True)]
    return np.concatenate([vertices for vertices, _ in parts]), np.concatenate(faces)


def truth_of(*parts):
    """Three photos from above, which see all of a square of side 2 at the origin."""
    camera = make_camera(120, 120, center=(0.5, 0.5))
    eyes = ((0.0, 3.0, 0.6), (0.7, 3.0, -0.3), (-0.7, 3.2, -0.3))
    views = Views.from_poses(camera, [look_at(np.array(eye), np.zeros(3)) for eye in eyes])
    return Truth(dict(views.cameras), dict(views.cam_from_world), *joined(*parts))


def scores(truth, vertices, faces):
    """As for a reconstruction in a frame of its own."""
    centers = {name: TURN(center[None])[0] for name, center in truth.centers.items()}
    surface = Surface(TURN(vertices), faces, np.zeros((len(vertices), 3), np.uint8))
    return truth_scores(surface, centers, truth, seen_places(truth, samples=4000))


def test_the_truth_itself_is_accurate_and_complete():
    truth = truth_of(sheet(0.0))
    found = scores(truth, truth.vertices, truth.faces)
    assert (found["accuracy %"], found["completeness %"], found["F %"], found["within 0.1 %"]) == (100, 100, 100, 100)
    assert found["median %"] < 1e-3


@pytest.mark.parametrize(("raised", "accuracy", "completeness"), [(0.004, 100, 100), (0.007, 0, 100), (0.012, 0, 0)])
def test_half_a_percent_is_right_and_one_percent_is_there(raised, accuracy, completeness):
    truth = truth_of(sheet(0.0))
    size = np.sqrt(8.0)
    found = scores(truth, *sheet(0.0, y=raised * size))
    assert (found["accuracy %"], found["completeness %"]) == (accuracy, completeness)
    assert found["median %"] == pytest.approx(100 * raised, rel=0.02)


def test_what_is_missing_costs_completeness_and_what_is_invented_accuracy():
    truth = truth_of(sheet(0.0))
    vertices, faces = truth.vertices, truth.faces
    half = scores(truth, vertices, faces[:1])
    assert half["accuracy %"] == 100 and 48 < half["completeness %"] < 53
    more = scores(truth, *joined((vertices, faces), sheet(0.0, y=0.5)))
    assert 49 < more["accuracy %"] < 51 and more["completeness %"] == 100
    assert half["F %"] == pytest.approx(2 * 100 * half["completeness %"] / (100 + half["completeness %"]), abs=0.01)


def test_nothing_is_asked_where_fewer_than_two_photos_see_anything():
    hidden, underside, far = sheet(0.0, y=-0.5, side=1.0), sheet(0.0, y=-0.01, down=True), sheet(9.0)
    seen = seen_places(truth_of(sheet(0.0), hidden, underside, far), samples=6000)
    assert np.abs(seen[:, 1]).max() < 1e-6, "neither what lies behind nor what faces away"
    assert np.abs(seen[:, [0, 2]]).max() <= 1.0, "nor what is outside of the photos"
    assert np.ptp(seen[:, 0]) > 1.9 and np.ptp(seen[:, 2]) > 1.9


def test_more_photos_see_less():
    truth = truth_of(sheet(0.0, side=5.0))
    counts = [len(seen_places(truth, photos, samples=4000)) for photos in (1, 2, 3, 4)]
    assert 4000 > counts[0] > counts[1] > counts[2] > counts[3] == 0


def test_psnr_does_not_mind_exposure_but_noise():
    rng = np.random.default_rng(0)
    scene = rng.uniform(60, 180, (20_000, 3))
    photo = scene * [0.8, 1.1, 0.9] + [10, -20, 30]
    for noise in (2.0, 8.0):
        noisy = photo + rng.normal(scale=noise, size=scene.shape)
        # gains and offsets take out the exposure but not the noise; rounding adds 1/12 twice
        expected = 20 * np.log10(255 / np.sqrt(noise**2 + 1 / 6))
        psnr = psnr_db(np.round(scene).astype(np.uint8), np.round(noisy).astype(np.uint8))
        assert psnr == pytest.approx(expected, abs=0.15)
    flat = np.full((100, 3), 90, np.uint8)
    assert psnr_db(flat, flat + np.uint8(7)) > 80, "one color fits another"


def test_likeness_counts_covered_pixels_alone():
    photo = np.zeros((40, 60, 3), np.uint8)
    photo[:, 20:] = np.random.default_rng(1).integers(50, 200, (40, 40, 3))
    covered = np.zeros((40, 60), bool)
    covered[:, 30:] = True
    found = likeness(Picture(photo * covered[..., None], covered), photo)
    assert (found.coverage, found.coverage_not_black) == (0.5, 0.75)
    assert found.not_black == pytest.approx(2 / 3) and found.psnr_db > 80
    covered[:, :59] = False
    assert np.isnan(likeness(Picture(photo, covered), photo).psnr_db), "40 pixels say nothing"


def test_points_are_written_as_colmap_reads_them(tmp_path):
    import trimesh

    rng = np.random.default_rng(2)
    points, normals = rng.normal(size=(2, 30, 3))
    colors = rng.integers(0, 256, (30, 3)).astype(np.uint8)
    path = tmp_path / "points.ply"
    path.write_bytes(points_ply(points, normals, colors))
    vertex = trimesh.load(path).metadata["_ply_raw"]["vertex"]["data"]
    assert np.allclose(np.stack([vertex[c] for c in ("x", "y", "z")], axis=1), points, atol=1e-6)
    assert np.allclose(np.stack([vertex[c] for c in ("nx", "ny", "nz")], axis=1), normals, atol=1e-6)
    assert np.array_equal(np.stack([vertex[c] for c in ("red", "green", "blue")], axis=1), colors)

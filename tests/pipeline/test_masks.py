"""Folders of masks as people have them, and a run in which somebody stands before the scene."""

import json
import os

import numpy as np
import pytest
from PIL import Image

import sfm_app
from sfm_app.colmap.database import read_match_graph
from sfm_app.colmap.dense import read_depth, read_views
from sfm_app.pipeline import NAMES
from sfm_app.products import read_texture
from sfm_app.runtime.workspace import Workspace
from sfm_app.settings import Settings
from sfm_app.types import Photo, PhotoSet
from tests.pipeline.test_odd_inputs import SIZE, call, picture


def mask(size=SIZE):
    """The left half is masked."""
    used = np.full(size[::-1], 255, np.uint8)
    used[:, : size[0] // 2] = 0
    return Image.fromarray(used)


def read(place, out, *more):
    return call("run", place, "-o", out, "--masks", out.parent / "masks", "--until", "photos", *more)


@pytest.fixture
def folder(tmp_path):
    """Three photos, one of them in a folder, and a mask for one."""
    for name in ("photos/sub", "masks/sub"):
        (tmp_path / name).mkdir(parents=True)
    for seed, name in enumerate(("a.jpg", "b.png", "sub/a.jpg")):
        picture(seed).save(tmp_path / "photos" / name)
    mask().save(tmp_path / "masks" / "sub" / "a.jpg.png")
    return tmp_path / "photos"


@pytest.fixture
def masks(folder):
    return folder.with_name("masks")


def used_share(out, name):
    with Image.open(out / "masks" / f"{name}.png") as image:
        return (np.asarray(image) > 0).mean()


def test_masks_are_counted_and_every_photo_has_one(folder, masks, tmp_path):
    mask().save(masks / "other.jpg.png")
    (masks / "notes.txt").write_text("by hand")
    result = read(folder, tmp_path / "out", "--json")
    assert json.loads(result.stdout)["masks"] == {"photos": 1, "unused": ["notes.txt", "other.jpg.png"]}
    assert [used_share(tmp_path / "out", name) for name in ("a.jpg", "b.png", "sub/a.jpg")] == [1.0, 1.0, 0.5]


def test_masks_and_positions_of_no_use_are_warnings_in_the_terminal_and_in_the_report(folder, masks, tmp_path):
    Image.new("L", SIZE, 255).save(masks / "a.jpg.png")
    mask().save(masks / "other.jpg.png")
    (folder / "geo.txt").write_text("EPSG:4326\na.jpg 8.5 47.3 400\nlost.jpg 8.6 47.3 400\n")
    told = read(folder, tmp_path / "out", "-q").stdout
    page = (tmp_path / "out" / "report.html").read_text()
    assert "masks       2 of 3 photos\nbeware      masks hide nothing: a.jpg\n" in told
    for text in ("masks belong to no photo: other.jpg.png", "geo.txt names photos that are not there: lost.jpg"):
        assert text in told and text in page
    found = json.loads(read(folder, tmp_path / "out", "--json").stdout)
    assert found["missing"] == {"geo.txt": ["lost.jpg"]} and found["masks"]["white"] == ["a.jpg"]
    (folder / "geo.txt").write_text("EPSG:4326\na.jpg 8.5 47.3 400\n")
    assert "lost.jpg" not in read(folder, tmp_path / "out", "-q").stdout


def test_masks_beside_the_photos_in_a_folder_of_their_own_are_no_photos(folder, masks, tmp_path):
    masks.rename(folder / "masks")
    result = call("run", folder, "-o", tmp_path / "out", "--masks", folder / "masks", "--until", "photos", "--json")
    found = json.loads(result.stdout)
    assert (found["photos"]["usable"], found["photos"]["unusable"]) == (3, {})
    assert found["masks"] == {"photos": 1, "unused": []}


def test_a_photo_whose_mask_is_black_is_left_out_with_the_reason(folder, masks, tmp_path):
    Image.new("L", SIZE).save(masks / "a.png")
    found = json.loads(read(folder, tmp_path / "out", "--json").stdout)
    assert found["photos"]["unusable"] == {"a.jpg": "its mask is all black"}
    assert not (tmp_path / "out" / "masks" / "a.jpg.png").exists()


def test_what_is_changed_in_a_mask_is_seen(folder, masks, tmp_path):
    def stamp():
        return Workspace(tmp_path / "out").manifest.record("photos").fingerprint

    read(folder, tmp_path / "out")
    before = stamp()
    read(folder, tmp_path / "out")
    assert stamp() == before

    Image.new("L", SIZE, 1).save(masks / "sub" / "a.jpg.png")
    read(folder, tmp_path / "out")
    assert stamp() != before and used_share(tmp_path / "out", "sub/a.jpg") == 1.0

    call("run", folder, "-o", tmp_path / "out", "--until", "photos")
    assert not (tmp_path / "out" / "masks").exists()


def test_masks_that_are_gone_from_the_output_are_laid_out_again(folder, tmp_path):
    read(folder, tmp_path / "out")
    for path in (tmp_path / "out" / "masks").rglob("*.png"):
        path.unlink()
    call("run", folder, "-o", tmp_path / "out", "--masks", folder.with_name("masks"), "--until", "match_graph")
    assert [used_share(tmp_path / "out", name) for name in ("a.jpg", "b.png", "sub/a.jpg")] == [1.0, 1.0, 0.5]
    (found,) = np.nonzero([at[:, 0].min() < 64 for at in keypoints(tmp_path / "out").values()])
    assert found.tolist() == [0, 1]


def keypoints(out):
    """By name, of photos in the order of their names."""
    entries = json.loads((out / "photos.json").read_text())["photos"]
    photos = tuple(Photo(entry["name"], entry["width"], entry["height"], entry["group"]) for entry in entries)
    graph = read_match_graph(out / "database.db", PhotoSet(out, photos))
    return dict(sorted((graph.images[key].name, at) for key, at in graph.keypoints.items()))


def linked(target):
    return lambda masks: (masks.rename(masks.with_name("x")), masks.symlink_to(target))


REFUSED = {
    "a file": (lambda masks: (masks.rename(masks.with_name("x")), masks.write_text("")), "masks cannot be used: empty"),
    "the output": (linked("out"), "cannot be both the masks and the output"),
    "masks of a former run": (linked("out/masks"), "keeps its own files"),
    "none fits": (lambda masks: (masks / "sub").rename(masks / "other"), "none of the 1 files in"),
    "another shape": (lambda masks: mask((128, 90)).save(masks / "a.jpg.png"), "it has 128 x 90 pixels, its photo 128"),
    "sideways": (lambda masks: mask((96, 128)).save(masks / "a.jpg.png"), "it has 96 x 128 pixels"),
    "text": (lambda masks: (masks / "a.jpg.png").write_text("black"), "a.jpg.png cannot be used: not a photo"),
    "a pipe": (lambda masks: os.mkfifo(masks / "a.jpg.png"), "a.jpg.png cannot be used: not a file"),
    "a link out": (lambda masks: (masks / "a.jpg.png").symlink_to("../photos/a.jpg"),
                   "a.jpg.png cannot be used: a link out of the folder"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_every_refusal_is_one_line_and_a_hint(folder, masks, tmp_path, case):
    make, words = REFUSED[case]
    assert call("run", folder, "-o", tmp_path / "out", "--until", "photos").exit_code == 0
    (tmp_path / "out" / "masks").mkdir()
    (tmp_path / "out" / "masks" / "mine.png").write_bytes(b"x")
    make(masks)
    result = read(folder, tmp_path / "out")
    assert result.exit_code == 3, result.output
    assert words in result.stderr and "Traceback" not in result.output
    assert result.stderr.count("\n") == 2 and "hint: " in result.stderr
    assert (tmp_path / "out" / "masks" / "mine.png").exists()


# somebody in magenta stands before the scene, always in the middle of the photo; a date is printed into a corner

QUICK = {"quality": "draft", "report": False, "depth": {"max_image_size_px": 240}}
PERSON, STAMP = np.s_[110:260, 200:270], np.s_[285:315, 340:470]


def magenta(colors):
    """How much more red and blue than green, in gray levels."""
    red, green, blue = np.moveaxis(np.asarray(colors, np.float64)[..., :3], -1, 0)
    return np.minimum(red, blue) - green


@pytest.fixture(scope="module")
def disturbed(rendered, tmp_path_factory):
    """Four photos with the person and the date, and their masks."""
    place = tmp_path_factory.mktemp("disturbed")
    for name in ("photos", "masks"):
        (place / name).mkdir()
    cloth, digits = (np.random.default_rng(seed).random((40, 40)) for seed in (1, 2))
    for path in sorted(rendered[0].glob("*.jpg"))[1:5]:
        pixels = np.asarray(Image.open(path).convert("RGB")).copy()
        used = np.full(pixels.shape[:2], 255, np.uint8)
        for where, pattern in ((PERSON, cloth), (STAMP, digits)):
            fine = pattern.repeat(4, axis=0).repeat(4, axis=1)[: pixels[where].shape[0], : pixels[where].shape[1]]
            pixels[where] = np.array([255, 0, 240]) * (0.6 + 0.4 * fine[..., None])
            used[where] = 0
        Image.fromarray(pixels).save(place / "photos" / f"{path.stem}.png")  # JPEG would bleed beyond the masks
        Image.fromarray(used).save(place / "masks" / f"{path.stem}.png")
    return place


def test_nobody_is_left_of_whom_masks_cover(disturbed, tmp_path):
    out, plain = tmp_path / "out", tmp_path / "plain"
    masks = str(disturbed / "masks")
    settings = Settings.from_mapping({**QUICK, "photos": {"masks": masks}})

    run = sfm_app.reconstruct(disturbed / "photos", out, settings)
    sfm_app.reconstruct(disturbed / "photos", plain, Settings.from_mapping(QUICK), last="match_graph")

    assert tuple(run.manifest["stages"]) == NAMES and len(run.scene.registered) == 4
    assert sum(map(on_somebody, keypoints(plain).values())) > 200
    assert sum(map(on_somebody, keypoints(out).values())) == 0
    for view in read_views(out / "dense"):
        depth = read_depth(out / "dense", view, "geometric")
        middle = depth[depth.shape[0] // 2 : depth.shape[0] * 3 // 4, view.width * 45 // 100 : view.width * 53 // 100]
        assert (middle < 0).all() and (depth > 0).mean() > 0.3
    model = read_texture(Workspace(out))
    assert len(model.surface.faces) > 2000 and magenta(model.surface.colors).max() < 25
    assert max(magenta(page).max() for page in model.texture.pages) < 25  # 15 in the photos without her


def on_somebody(at):
    """How many of the keypoints lie on the person or the date."""
    hidden = np.zeros((320, 480), bool)
    hidden[PERSON] = hidden[STAMP] = True
    col, row = np.floor(at).astype(int).T
    return np.count_nonzero(hidden[row, col])

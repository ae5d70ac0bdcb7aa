"""What lies in OUT, damaged: it loads, or is refused in one line and made again; nothing else is touched."""

import json
import shutil
from concurrent.futures import ThreadPoolExecutor
from itertools import islice

import numpy as np
import pytest

from sfm_app.engine.stage import Products, rerun_reason
from sfm_app.errors import SfmError
from sfm_app.exports import stored_model
from sfm_app.photos.source import read_source
from sfm_app.pipeline import NAMES, STAGES
from sfm_app.plugins import load_plugins
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.workspace import StageRecord, Workspace
from sfm_app.settings import Settings

from .mutations import ANYTHING, damaged, text_values

OWNERS = {
    "photos.json": "photos", "database.db": "match_graph", "view_graph.npz": "view_graph",
    "calibration.json": "intrinsics", "sparse/cameras.bin": "scene", "sparse/frames.bin": "scene",
    "sparse/images.bin": "scene", "sparse/points3D.bin": "scene", "sparse/rigs.bin": "scene", "scene.json": "scene",
    "dense/sparse/images.bin": "depth_maps", "dense/images/view_01.jpg": "depth_maps",
    "dense/stereo/depth_maps/view_01.jpg.geometric.bin": "depth_maps",
    "dense/stereo/normal_maps/view_01.jpg.geometric.bin": "depth_maps", "surface/surface.npz": "mesh",
    "texture/texture.npz": "texture", "model.glb": "files",
}  # fmt: skip
"""Files and whose they are."""
READ_BY_US = (
    "photos.json", "view_graph.npz", "calibration.json", "scene.json", "surface/surface.npz", "texture/texture.npz"
)  # fmt: skip
SEEDS = 24


@pytest.fixture
def run(made):
    with ThreadPoolExecutor(1) as executor:
        yield RunContext(Settings(), Workspace(made.out), load_plugins(installed=False), executor, 1)


def load(made, run, stage):
    """The product, or the error that is allowed."""
    before = made.outside()
    try:
        return Products(run, read_source(made.photos, made.out, run.settings.photos, map))[STAGES[NAMES.index(stage)]]
    except SfmError as err:
        assert "\n" not in str(err)
        return err
    finally:
        assert made.outside() == before


def mutants(path, seeds, kinds=ANYTHING):
    """Put damaged bytes in place of a file, one after the other, and the sound ones at the end."""
    whole = path.read_bytes()
    try:
        for seed in range(seeds):
            data, how = damaged(whole, seed, kinds)
            if data != whole:
                path.write_bytes(data)
                yield f"{path.name}, {how}"
    finally:
        path.write_bytes(whole)


def test_a_whole_run_leaves_what_its_digests_say(made, run):
    for stage in STAGES:
        assert run.workspace.manifest.record(stage.name).digest == stage.digest(run.workspace)
        assert not isinstance(load(made, run, stage.name), SfmError)


@pytest.mark.parametrize("file", OWNERS)
def test_damage_is_found_before_anything_is_read(made, run, file):
    """COLMAP never ends on some damaged models, and ends the program on others."""
    for how in mutants(made.out / file, SEEDS):
        found = load(made, run, OWNERS[file])
        # of a database only what it says counts
        assert isinstance(found, SfmError) or file == "database.db", how


@pytest.mark.parametrize("file", READ_BY_US)
def test_damage_with_a_digest_that_fits_is_refused_by_the_reader(made, run, file):
    stage = STAGES[NAMES.index(OWNERS[file])]
    manifest = run.workspace.manifest.read()
    record = run.workspace.manifest.record(stage.name)
    kinds = (text_values,) if file.endswith("json") else ANYTHING
    found = []
    try:
        for how in mutants(made.out / file, 2 * SEEDS, kinds):
            digest = stage.digest(run.workspace)
            run.workspace.manifest.finish(stage.name, StageRecord(**{**_fields(record), "digest": digest}), {})
            found.append((how, load(made, run, stage.name)))
    finally:
        run.workspace.manifest.write(manifest)
    assert any(isinstance(product, SfmError) for _, product in found)


def _fields(record):
    return {name: getattr(record, name) for name in record.__dataclass_fields__}


EXTREMES = {
    "a name out of OUT": lambda m: m["stages"]["photos"]["files"].update({"../../x": 5, "/etc/passwd": 6, "a\0b": 1}),
    "wrong types": lambda m: m["stages"].update(photos=3, scene=[], mesh={"fingerprint": []}, texture=None),
    "counts of another kind": lambda m: m["stages"]["scene"].update(counts=[1]),
    "figures of another kind": lambda m: m["stages"]["scene"]["counts"].update(orientation="none"),
    "not a number": lambda m: m["stages"]["photos"].update(seconds=float("nan")),
    "one stage more": lambda m: m["stages"].update(lunch={"files": {}}),
    "a megabyte": lambda m: m["stages"].update({"x" * 1_000_000: {"a": "b" * 1_000_000}}),
}
TEXTS = {
    "deep": b'{"stages": ' + b"[" * 100_000 + b"]" * 100_000 + b"}",
    "deep in a stage": b'{"stages": {"photos": ' + b'{"a":' * 900 + b"1" + b"}" * 900 + b"}}",
    "a long number": b'{"stages": {"photos": ' + b"9" * 100_000 + b"}}",
    "twice": b'{"stages": {"photos": {}}, "stages": {"photos": {}, "photos": 4}}',
    "half a letter": b'{"stages": {"\\ud800": "\xc3"}}',
    "a hundred megabytes": b'{"stages": {}, "x": "' + b"x" * 100_000_000 + b'"}',
}


@pytest.mark.parametrize("case", [*EXTREMES, *TEXTS])
def test_strange_manifests_count_as_none(made, run, case):
    path = made.out / "manifest.json"
    whole = path.read_bytes()
    try:
        if case in TEXTS:
            path.write_bytes(TEXTS[case])
        else:
            manifest = json.loads(whole)
            EXTREMES[case](manifest)
            path.write_text(json.dumps(manifest))
        decide(made, run)
        if case != "one stage more" and case != "a megabyte":
            assert not all(isinstance(run.workspace.manifest.record(name), StageRecord) for name in NAMES)
    finally:
        path.write_bytes(whole)


def test_damaged_manifests(made, run):
    kinds = (*ANYTHING, *[text_values] * 8)
    for _ in mutants(made.out / "manifest.json", 120, kinds):
        decide(made, run)


def decide(made, run):
    """All that a run asks of the manifest, and what `export` reads."""
    before = made.outside()
    for stage in STAGES:
        rerun_reason(stage, "abc", run)
        load(made, run, stage.name)
    for points in (False, True):
        try:
            stored_model(run, points=points)
        except SfmError as err:
            assert "\n" not in str(err)
    assert made.outside() == before


HEALED = [
    ("model.glb", ()), ("surface/surface.npz", ("--from", "texture")),
    ("dense/stereo/depth_maps/view_02.jpg.geometric.bin", ("--from", "mesh")), ("sparse/points3D.bin", ()),
    ("calibration.json", ("--until", "scene")), ("manifest.json", ("--until", "intrinsics")),
]  # fmt: skip


@pytest.mark.parametrize(("file", "flags"), HEALED)
def test_a_run_on_damaged_files_ends_with_the_bytes_of_a_sound_one(kept, file, flags):
    path, before = kept.out / file, kept.outside()
    whole = path.read_bytes()
    middle = len(whole) // 2
    path.write_bytes(whole[:middle] + bytes(byte ^ 0xFF for byte in whole[middle : middle + 40]) + whole[middle + 40 :])
    result = kept.run(*flags)
    assert result.exit_code == 0, result.output
    if path.name != "manifest.json":
        assert path.read_bytes() == whole
    assert json.loads((kept.out / "manifest.json").read_text())["stages"]
    assert kept.outside() == before


def test_a_database_with_other_keypoints_is_made_again(kept):
    """SQLite finds nothing wrong with it."""
    import sqlite3

    with sqlite3.connect(kept.out / "database.db") as database:
        database.execute("UPDATE keypoints SET rows = 3, data = x'00ff' WHERE image_id = 2")
        database.execute("UPDATE matches SET data = zeroblob(length(data) - 4)")
    database.close()
    whole = (kept.out / "view_graph.npz").read_bytes()

    result = kept.run("--from", "view_graph", "--until", "view_graph")

    assert result.exit_code == 0, result.output
    assert (kept.out / "view_graph.npz").read_bytes() == whole


def forge(made, run, change):
    """Change photos.json, with a digest that fits."""
    record, path = run.workspace.manifest.record("photos"), made.out / "photos.json"
    values = json.loads(path.read_text())
    change(values)
    path.write_text(json.dumps(values))
    digest = STAGES[0].digest(run.workspace)
    run.workspace.manifest.finish("photos", StageRecord(**{**_fields(record), "digest": digest}), {})


@pytest.mark.parametrize("name", ["../../evil.jpg", "../evil.jpg", "{place}/evil.jpg", "a/../../evil.jpg", "", "\0"])
@pytest.mark.parametrize("needs_copy", [True, False])
def test_a_forged_name_never_leads_out_of_the_output_folder(kept, run, name, needs_copy):
    forge(kept, run, lambda v: v["photos"][0].update(name=name.format(place=kept.place), needs_copy=needs_copy))
    assert isinstance(load(kept, run, "photos"), SfmError)


@pytest.mark.parametrize("original", ["../secret.jpg", "{place}/secret.jpg"])
def test_a_forged_photo_never_comes_from_outside(kept, run, original):
    forge(kept, run, lambda v: v["photos"][0].update(name="x.jpg", original=original.format(place=kept.place)))
    assert isinstance(load(kept, run, "photos"), SfmError)
    assert not (kept.out / "photos" / "x.jpg").exists()


def test_a_forged_folder_is_not_read(kept, run):
    forge(kept, run, lambda v: v.update(folder=str(kept.place)))
    (kept.out / "photos" / "view_00.jpg").unlink()
    assert load(kept, run, "photos").folder == kept.photos
    assert (kept.out / "photos" / "view_00.jpg").resolve() == (kept.photos / "view_00.jpg").resolve()


@pytest.mark.parametrize("target", ["secret.jpg", "new.jpg"])
def test_a_link_among_the_photos_that_leads_elsewhere_is_replaced(kept, run, target):
    link = kept.out / "photos" / "view_00.jpg"
    link.unlink()
    link.symlink_to(kept.place / target)
    load(kept, run, "photos")
    assert link.resolve() == (kept.photos / "view_00.jpg").resolve()
    assert not (kept.place / "new.jpg").exists()


@pytest.mark.parametrize("name", ["sparse", "database.db", "log.txt", ".lock", "dense/sparse"])
def test_links_out_of_the_output_folder_are_refused(kept, name):
    shutil.rmtree(kept.out / name, ignore_errors=True)
    (kept.out / name).unlink(missing_ok=True)
    (kept.out / name).symlink_to(kept.photos)
    before = kept.outside()
    result = kept.run()
    assert (result.exit_code, "is a link" in result.stderr) == (3, True)
    assert kept.outside() == before


def test_parts_of_a_killed_run_that_are_damaged_are_made_again(tmp_path):
    from sfm_app.estimation.fitting import read_part, write_part
    from sfm_app.types import EpipolarFit, Rejected

    fit = EpipolarFit(np.eye(3), np.ones(40, bool), np.ones(40), 7, 0.3)
    path, pairs = tmp_path / "000000.npz", [(1, 2), (1, 3)]
    write_part(path, {pairs[0]: (fit, 2), pairs[1]: (Rejected("few"), 0)})

    assert read_part(path, pairs) is not None
    assert read_part(path, [*pairs, (2, 3)]) is None
    assert read_part(tmp_path / "000064.npz", pairs) is None
    found = [read_part(path, pairs) for _ in islice(mutants(path, 60), 60)]
    assert sum(part is None for part in found) > 30

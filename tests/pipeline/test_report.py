"""report.html of rendered photos, of a folder that fails, and of photos with hostile names."""

import json
import re
import shutil
from html.parser import HTMLParser

import pytest
from click.testing import CliRunner

import sfm_app
from sfm_app.api import open_run
from sfm_app.cli.program import main
from sfm_app.errors import InputError
from sfm_app.report.page import REPORT
from sfm_app.report.server import read_resources
from sfm_app.settings import Settings

DRAFT = Settings.from_mapping({"quality": "draft"})
HOSTILE = "<img src=x onerror=alert(1)>.png"


class Page(HTMLParser):
    """Collects the elements and the text of a page."""

    def __init__(self, text):
        super().__init__()
        self.elements, self.texts, self.inside = [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        self.inside.append(tag)

    def handle_endtag(self, tag):
        while self.inside and self.inside.pop() != tag:
            pass

    def handle_data(self, data):
        if not {"script", "style"}.intersection(self.inside):
            self.texts.append(data)

    @property
    def text(self):
        return " ".join(" ".join(self.texts).split())


def read(out):
    text = (out / REPORT).read_text(encoding="utf-8")
    return text, Page(text)


def data_of(text):
    return json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL).group(1))


@pytest.fixture(scope="module")
def mapped(rendered, tmp_path_factory):
    """A run until the scene, on photos of which one has a hostile name, and one file is no photo."""
    place = tmp_path_factory.mktemp("report")
    shutil.copytree(rendered[0], place / "photos")
    first = min((place / "photos").iterdir())
    first.rename(first.with_name(HOSTILE))
    (place / "photos" / "notes & more.txt").write_text("no photo")
    return sfm_app.reconstruct(place / "photos", place / "out", DRAFT, last="scene")


def test_nothing_is_loaded_from_anywhere(mapped):
    _, page = read(mapped.out)
    links = [one[key] for _, one in page.elements for key in ("src", "href") if key in one]
    assert links and all(link.startswith(("data:", "#")) for link in links)
    assert not any(tag in ("link", "iframe", "object", "embed") for tag, _ in page.elements)
    policy = next(one["content"] for tag, one in page.elements if tag == "meta" and "http-equiv" in one)
    assert policy.startswith("default-src 'none'") and "http" not in policy


def test_a_hostile_name_is_text(mapped):
    text, page = read(mapped.out)
    assert HOSTILE in page.text and "<img src=x" not in text
    assert not any("onerror" in one for _, one in page.elements)


def test_every_photo_has_a_row_with_its_state(mapped):
    text, page = read(mapped.out)
    rows = data_of(text)["photos"]
    assert len([one for tag, one in page.elements if tag == "tr" and "data-row" in one]) == len(rows) == 8
    assert [row["state"] for row in rows] == ["placed"] * 7 + ["left out"]
    assert all(row["points"] > 100 and 0.05 < row["residual_px"] < 1.0 for row in rows[:7])
    assert rows[7]["name"] == "notes & more.txt" and "not a photo" in rows[7]["reason"]


def test_the_view_has_every_camera_where_it_stands(mapped):
    view = data_of(read(mapped.out)[0])["view"]
    assert {camera["name"] for camera in view["cameras"]} == set(mapped.scene.registered)
    for camera in view["cameras"]:
        pose = mapped.scene.cam_from_world[camera["name"]]
        assert camera["matrix"][12:15] == pytest.approx((-pose[:, :3].T @ pose[:, 3]).tolist(), abs=1e-4)
        assert camera["matrix"][8:11] == pytest.approx((-pose[2, :3]).tolist(), abs=1e-4)  # looks along -z
    assert view["glb"] == "" and len(view["places"]) > 1000


def test_the_page_says_what_was_found(mapped):
    _, page = read(mapped.out)
    focal = next(iter(mapped.scene.cameras.values())).K[0, 0]
    assert "Cameras and points from all 7 photos." in page.text
    assert f"{focal:.0f} px" in page.text and "Seen from above" in page.text and "Connected photos" in page.text
    assert mapped.report_path == mapped.out / REPORT


def test_parameters_that_move_together_are_told_and_kept(mapped):
    _, page = read(mapped.out)
    camera = next(iter(mapped.scene.cameras.values()))
    kept = json.loads((mapped.out / "scene.json").read_text())["cameras"]
    assert "Which parameters move together, after the last adjustment" in page.text
    assert set(camera.correlations) >= {"fx fy", "fx cx", "cx cy"}
    assert all(-1.0 <= value <= 1.0 for value in camera.correlations.values())
    assert [one["correlations"] for one in kept.values()] == [dict(camera.correlations)]


def test_the_view_loads_what_the_report_has_in_it(mapped):
    with open_run(mapped.out, Settings(), None) as run:
        found = read_resources(run)
        text = found.page.decode()
        view = data_of(text)["view"]

        # without single points far away, which no file of points has
        assert 0.95 * mapped.scene.points < sum(view["levels"]) <= mapped.scene.points and view["models"] == []
        assert "data:image/jpeg;base64," not in text and "connect-src 'self'" in text
        sources = [one.get("src", "") for tag, one in Page(text).elements if tag == "img"]
        pictures = [source for source in sources if "pictures/" in source]
        assert len(pictures) == 7 and all(found.find(f"/{address}").content[:2] == b"\xff\xd8" for address in pictures)
        assert found.find(f"/photos/{view['cameras'][0]['row']}").content[:2] == b"\xff\xd8"
        assert "<img src=x" not in text


def test_a_run_that_changes_nothing_leaves_it_alone_and_the_command_makes_it_again(mapped):
    before = (mapped.out / REPORT).stat().st_mtime_ns
    sfm_app.reconstruct(mapped.out.parent / "photos", mapped.out, DRAFT, last="scene")
    assert (mapped.out / REPORT).stat().st_mtime_ns == before
    said = CliRunner().invoke(main, ["report", str(mapped.out)])
    assert said.exit_code == 0 and REPORT in said.output and (mapped.out / REPORT).stat().st_mtime_ns > before


def test_a_damaged_model_is_left_out_and_not_given_to_colmap(mapped, tmp_path, monkeypatch):
    out = tmp_path / "out"
    shutil.copytree(mapped.out, out, symlinks=True)
    with (out / "sparse" / "points3D.bin").open("r+b") as file:
        file.write(b"\xff" * 64)
    monkeypatch.setattr("sfm_app.products.read_scene", lambda _: pytest.fail("COLMAP would hang"))
    sfm_app.write_report(out)
    text, page = read(out)
    assert data_of(text)["view"] is None and [row["state"] for row in data_of(text)["photos"][:7]] == ["usable"] * 7
    assert "Connected photos" in page.text


def test_a_folder_without_photos_says_why_and_names_the_files_until_a_run_succeeds(rendered, tmp_path):
    photos, out = tmp_path / "photos", tmp_path / "out"
    photos.mkdir()
    shutil.copy(min(rendered[0].iterdir()), photos)
    (photos / "<b>broken.jpg").write_bytes(b"no photo")

    with pytest.raises(InputError, match="only one usable photo"):
        sfm_app.reconstruct(photos, out, DRAFT)

    text, page = read(out)
    assert "only one usable photo" in page.text and "at least two photos of a place are needed" in page.text
    assert "<b>broken.jpg : not a photo" in page.text and "<b>broken" not in text
    assert "There is no model." in page.text and "What went wrong" in page.text

    for path in rendered[0].iterdir():
        shutil.copy(path, photos)

    sfm_app.reconstruct(photos, out, DRAFT, last="photos")

    assert "What went wrong" not in read(out)[1].text and "7 usable photos" in read(out)[1].text


def test_no_report_is_written_where_none_is_wanted(rendered, tmp_path):
    settings = Settings.from_mapping({"quality": "draft", "report": False})
    done = sfm_app.reconstruct(rendered[0], tmp_path / "out", settings, last="photos")
    assert done.report_path is None and not (tmp_path / "out" / REPORT).exists()


def test_two_runs_are_set_side_by_side(mapped, tmp_path):
    settings = Settings.from_mapping({"seed": 7, "quality": "draft"})
    other = sfm_app.reconstruct(mapped.out.parent / "photos", tmp_path / "other", settings, last="photos")
    said = CliRunner().invoke(main, ["report", str(mapped.out), "--compare", str(other.out)])
    _, page = read(mapped.out)
    assert said.exit_code == 0 and "Beside other" in page.text
    assert "setting seed 0 7" in page.text and "photos placed 7 of 7" in page.text


def test_a_folder_that_holds_no_run_is_refused(mapped, tmp_path):
    for arguments in ([str(tmp_path)], [str(mapped.out), "--compare", str(tmp_path)]):
        said = CliRunner().invoke(main, ["report", *arguments])
        assert said.exit_code == 3 and "holds no run" in said.output


def test_a_report_that_cannot_be_made_does_not_end_the_run(rendered, tmp_path, monkeypatch):
    def fail(*_):
        raise RuntimeError("a bug")

    monkeypatch.setattr("sfm_app.report.page.render_page", fail)

    done = sfm_app.reconstruct(rendered[0], tmp_path / "out", DRAFT, last="photos")

    assert done.report_path is None and tuple(done.manifest["stages"]) == ("photos",)

"""Projects of the studio: names, uploads, settings, and the command that does the same."""

import shlex
import tomllib
import zipfile
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfm_app.errors import ConfigError, InputError
from sfm_app.settings import Settings
from sfm_app.studio.projects import Projects, safe_name, toml_text


@pytest.fixture
def projects(tmp_path):
    return Projects(tmp_path / "models")


def put(project, name, content=b"a photo"):
    draft = project.root / "draft"
    draft.write_bytes(content)
    return project.keep(draft, name)


@given(st.text(max_size=400))
def test_a_name_is_one_plain_part_of_a_path(name):
    safe = safe_name(name, "photo.jpg")
    assert safe and Path(safe).name == safe and not safe.startswith(".") and len(safe.encode()) <= 500
    assert not set(safe) & set("<>&\"'/\\:*?|\0\n")
    assert safe_name(safe, "photo.jpg") == safe


@pytest.mark.parametrize(
    ("name", "safe"),
    [
        ("a.jpg", "a.jpg"), ("../../etc/passwd", "passwd"), ("..\\a.jpg", "a.jpg"), ("..", "photo.jpg"),
        (".jpg", "jpg"), ("<img src=x onerror=alert(1)>.jpg", "_img src_x onerror_alert(1)_.jpg"),
        ("Größe 1.jpg", "Größe 1.jpg"),
        ("a" * 300 + ".jpeg", "a" * 120 + ".jpeg"),
    ],
)  # fmt: skip
def test_names_stay_readable(name, safe):
    assert safe_name(name, "photo.jpg") == safe


values = st.one_of(
    st.text(st.characters(exclude_characters="\x7f", codec="utf-8")), st.integers(-(2**60), 2**60), st.booleans()
)


@given(
    st.dictionaries(st.from_regex(r"[a-z_]+", fullmatch=True), st.one_of(values, st.lists(values)), max_size=4),
    st.lists(values, max_size=3),
)
def test_settings_are_read_back_as_they_were(table, distances):
    nested = {"quality": "draft", "scale": {"distances": [distances], **table}}
    assert tomllib.loads(toml_text(nested)) == nested


def test_the_same_file_is_kept_once_and_another_of_its_name_beside_it(projects):
    project = projects.create("jug")
    assert [put(project, "a.jpg"), put(project, "a.jpg"), put(project, "a.jpg", b"another")] == [
        "a.jpg",
        "a.jpg",
        "a-2.jpg",
    ]
    assert sorted(project.photos()) == ["a-2.jpg", "a.jpg"]


def test_projects_of_one_name_get_numbers_and_are_found_by_name_alone(projects):
    first, second = projects.create("jug"), projects.create("Jug")
    assert (first.name, second.name) == ("jug", "Jug 2")
    assert projects.find("Jug 2").root == second.root
    assert projects.find("../models/jug") is None and projects.find("") is None


def test_removed_uploads_are_kept_aside(projects):
    project = projects.create("jug")
    put(project, "a.jpg")
    put(project, "b.jpg", b"b")
    project.remove(["a.jpg", "../project.json"])
    assert sorted(project.photos()) == ["b.jpg"]
    assert (project.root / "removed" / "a.jpg").read_bytes() == b"a photo"
    assert (project.root / "project.json").is_file()


def test_another_file_of_a_removed_name_is_kept_beside_it(projects):
    project = projects.create("jug")
    for content in (b"one", b"two"):
        put(project, "a.jpg", content)
        project.remove(["a.jpg"])
    assert sorted(path.read_bytes() for path in (project.root / "removed").iterdir()) == [b"one", b"two"]


def test_uploads_of_a_killed_server_are_forgotten(projects):
    project = projects.create("jug")
    put(project, "a.jpg")
    (project.root / ".upload-1").write_bytes(b"half")
    project.forget_uploads()
    assert [path.name for path in project.root.rglob("*") if path.is_file()] == ["project.json", "a.jpg"]


def test_a_folder_of_the_user_stays_as_it_is(projects, tmp_path):
    folder = tmp_path / "holiday photos"
    folder.mkdir()
    for name in ("a.jpg", "b.jpg"):
        (folder / name).write_bytes(b"a photo")
    project = projects.create("", str(folder))
    project.remove(["a.jpg"])
    assert sorted(path.name for path in folder.iterdir()) == ["a.jpg", "b.jpg"]
    assert sorted(project.photos()) == ["b.jpg"] and project.inputs() == [folder]
    assert Path(Settings.from_mapping(project.settings()).photos.images).read_text() == "b.jpg\n"
    projects.delete(project)
    assert folder.exists() and list(projects) == []


def test_a_folder_has_to_exist_and_be_named_as_a_whole(projects):
    for source in ("no/such", "/no/such/folder"):
        with pytest.raises(InputError, match="no folder of this machine"):
            projects.create("", source)


def test_archives_and_videos_are_inputs_of_their_own(projects):
    project = projects.create("jug")
    put(project, "a.jpg")
    assert project.inputs() == [project.source] and "*" not in project.command()
    with zipfile.ZipFile(project.source / "more.zip", "w") as archive:
        archive.writestr("c.jpg", b"c")
    assert project.inputs() == [project.source / "a.jpg", project.source / "more.zip"]
    assert project.command().startswith(f"sfm-app run {project.source}/* -o")


def test_the_command_reads_the_settings_of_the_page(projects):
    project = projects.create("my jug")
    project.change("", "quality", "draft")
    project.change("scale", "markers", "50mm")
    words = shlex.split(project.command())
    settings = Settings.from_toml(Path(words[words.index("--config") + 1]))
    assert (settings.quality, settings.scale.markers, settings.mesh.faces) == ("draft", "50mm", 50_000)


def test_an_invalid_setting_changes_nothing(projects):
    project = projects.create("jug")
    project.change("", "quality", "draft")
    with pytest.raises(ConfigError, match=r"scale\.markers"):
        project.change("scale", "markers", "wide")
    assert project.settings() == {"quality": "draft"}

"""Damaged settings files and lists of photos: read, or refused in a line or two that can be printed."""

import pytest
from click.testing import CliRunner

from sfm_app.cli.options import parse_assignment
from sfm_app.cli.program import main
from sfm_app.errors import ConfigError, InputError
from sfm_app.frame.control_points import read_control_points
from sfm_app.photos.files import list_photos, resolve_file
from sfm_app.settings import MOST_TOML_BYTES, Settings

from .mutations import ANYTHING, damaged, text_values

LONGEST = 5000


def read(path):
    """The settings, or the refusal."""
    try:
        return Settings.from_toml(path)
    except ConfigError as err:
        assert len(str(err)) < LONGEST
        return err


def test_damaged_settings_are_read_or_refused(tmp_path):
    path, whole = tmp_path / "run.toml", Settings().to_toml().encode()
    kinds = (*ANYTHING, *[text_values] * 12)
    found = []
    for seed in range(600):
        data, _ = damaged(whole, seed, kinds)
        path.write_bytes(data)
        found.append(isinstance(read(path), Settings))
    assert 0 < sum(found) < len(found)


STRANGE = {
    "lists in lists": "a=" + "[" * 8_000 + "]" * 8_000, "tables in tables": "a=" + "{a=" * 6_000 + "1" + "}" * 6_000,
    "a long path": ".".join(["a"] * 6_000) + "=1", "a long header": "[" + ".".join(["a"] * 6_000) + "]",
    "a long number": "seed=" + "9" * 19_000, "a long number in hex": "seed=0x" + "f" * 19_000,
    "a long fraction": "[mesh]\nmax_gap=" + "9" * 19_000 + ".0", "a million digits": "seed=" + "9" * 1_000_000,
    "a long word": 'quality="' + "x" * 19_000 + '"', "a long name": "x" * 19_000 + "=1",
    "many names": "\n".join(f"k{k}=1" for k in range(2_000)), "a date": "seed=2024-01-01",
    "not a number": "[mesh]\nmax_gap=nan", "a list for a table": "photos=[1]",
    "a table for a number": "[depth.neighbors]\nx=1", "tables of a list": "[[depth]]\nneighbors=1",
    "an unknown table": "[x.y.z]\na=1", "an escape": '"\\u001b[2J"="\\u001b[2J"', "twice": "seed=1\nseed=2",
}  # fmt: skip


@pytest.mark.parametrize("case", STRANGE)
def test_strange_settings_are_refused(tmp_path, case):
    path = tmp_path / "run.toml"
    path.write_text(STRANGE[case])
    assert isinstance(read(path), ConfigError)
    result = CliRunner().invoke(main, ["config", "--config", str(path)])
    assert result.exit_code == 2 and "error: " in result.stderr
    assert all(line.isprintable() for line in result.stderr.splitlines())
    if len(STRANGE[case]) < MOST_TOML_BYTES:
        name, _, value = STRANGE[case].partition("=")
        with pytest.raises(ConfigError):
            Settings.from_mapping(parse_assignment(f"{name}={value}"))


def test_a_file_as_large_as_may_be_is_read(tmp_path):
    text = Settings(seed=5).to_toml()
    (tmp_path / "run.toml").write_text(text + "#" * (MOST_TOML_BYTES - len(text)))
    assert Settings.from_toml(tmp_path / "run.toml").seed == 5


LINES = ("a\0b.jpg", "x" * 5000, "x/" * 4000, "../secret.jpg", "/etc/passwd", "..", "~", "a\x1b[2J")


@pytest.mark.parametrize("line", LINES)
def test_strange_names_in_a_list_are_left_out(tmp_path, line):
    folder = tmp_path / "photos"
    folder.mkdir()
    (tmp_path / "secret.jpg").write_bytes(b"secret")
    (tmp_path / "list.txt").write_text(f"{line}\n")
    (name,) = list_photos(folder, tmp_path / "out", tmp_path / "list.txt")
    assert isinstance(resolve_file(folder, name), str)


def test_a_list_that_no_file_can_be(tmp_path):
    with pytest.raises(InputError, match="cannot read"):
        list_photos(tmp_path, tmp_path / "out", tmp_path / "a\0b")


MARKS = b"""\n500000.1 4649000.2 320 10 20 a b.jpg p
500010\t4649020\t321\t11\t22\tc.jpg\tq\n1;2;3;4;5;x y.JPG;n\n"""


@pytest.mark.slow
@pytest.mark.parametrize("header", [b"EPSG:32632", b"+proj=utm +zone=32 +datum=WGS84", b"WGS84 UTM 32N", b"local"])
def test_damaged_control_points_are_read_or_refused(tmp_path, header):
    path, found = tmp_path / "gcp_list.txt", []
    for seed in range(60):
        path.write_bytes(damaged(header + MARKS, seed, (*ANYTHING, *[text_values] * 12))[0])
        try:
            found.append(bool(read_control_points(path, ["a b.jpg", "c.jpg"])))
        except InputError as err:
            assert len(str(err)) < LONGEST
            found.append(False)
    assert 0 < sum(found) < len(found)

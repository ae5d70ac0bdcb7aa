import pytest

from sfm_app.colmap import mapping
from sfm_app.colmap.backend import pycolmap

UNKNOWN = ("SIMPLE_RADIAL", [900.0, 500, 400, 0])
KNOWN = ("SIMPLE_RADIAL", [900.0, 500, 400, -0.1])
TWO_FOCALS = ("OPENCV", [900.0, 800, 500, 400, 0, 0, 0, 0])


@pytest.mark.parametrize(
    ("cameras", "sought"),
    [
        ([UNKNOWN, UNKNOWN], True),
        ([KNOWN], False),  # calibration knows more than the first few photos say
        ([TWO_FOCALS], False),  # four terms run wild
        ([UNKNOWN, KNOWN], False),
    ],
)
def test_mapping_seeks_the_lens_only_where_nothing_is_known_about_it(tmp_path, monkeypatch, cameras, sought):
    start = pycolmap.Reconstruction()
    for camera_id, (model, params) in enumerate(cameras, start=1):
        camera = pycolmap.Camera(camera_id=camera_id, model=model, width=1000, height=800, params=params)
        start.add_camera_with_trivial_rig(camera)
    seen = []

    def grow(database, photos, found, options, **_):
        seen.append(options.ba_refine_extra_params)
        return {0: start}

    monkeypatch.setattr(mapping.pycolmap, "incremental_mapping", grow)

    found = mapping.continue_mapping(tmp_path / "database.db", tmp_path, start, tmp_path / "scratch", 0, lambda: None)

    assert found is start
    assert seen == [sought]

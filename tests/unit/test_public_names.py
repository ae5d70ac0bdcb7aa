import subprocess
import sys

import numpy as np
import pytest

import sfm_app


def test_every_public_name_exists():
    assert {"reconstruct", "calibrate_photos", "estimate_fundamental", "calibrate_fundamentals", "Settings"} <= set(
        sfm_app.__all__
    )
    assert "export_model" in sfm_app.__all__
    assert all(getattr(sfm_app, name) is not None for name in sfm_app.__all__)


def test_an_estimator_refuses_bad_input_clearly():
    with pytest.raises(ValueError, match="x2"):
        sfm_app.estimate_fundamental(np.zeros((9, 2)), np.full((9, 2), np.nan))
    with pytest.raises(sfm_app.ConfigError, match="no calibrator is named 'kruppa5'"):
        sfm_app.calibrate_fundamentals(np.eye(3)[None], (640, 480), method="kruppa5")


def test_a_method_that_does_not_exist_is_refused_before_any_work(tmp_path):
    settings = sfm_app.Settings.from_mapping({"depth": {"method": "guess"}})

    with pytest.raises(sfm_app.ConfigError, match="no depth method is named 'guess'"):
        sfm_app.reconstruct(tmp_path, tmp_path / "out", settings)

    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_the_import_leaves_out_what_an_estimator_does_not_need():
    heavy = {"cv2", "open3d", "pycolmap", "trimesh", "matplotlib", "PIL", "rich"}
    heavy |= {"scipy.optimize", "scipy.sparse", "scipy.spatial"}
    lists = "import sys, sfm_app; sfm_app.estimate_fundamental; print(*sys.modules)"

    done = subprocess.run([sys.executable, "-c", lists], capture_output=True, text=True, check=True)

    assert "sfm_app.fundamental.estimate" in done.stdout.split()
    assert heavy.isdisjoint(done.stdout.split())


@pytest.mark.slow
def test_the_processes_of_colmap_do_not_load_the_estimators():
    heavy = {"numba", "sfm_app.api", "sfm_app.plugins", "sfm_app.fundamental"}
    lists = "import sys, sfm_app.colmap.tasks, sfm_app.colmap.features; print(*sys.modules)"

    done = subprocess.run([sys.executable, "-c", lists], capture_output=True, text=True, check=True)

    assert "pycolmap" in done.stdout.split()
    assert heavy.isdisjoint(done.stdout.split())


def test_the_package_lists_what_it_loads_later():
    assert set(dir(sfm_app)) == set(sfm_app.__all__)
    assert all(hasattr(sfm_app, name) for name in sfm_app.__all__)
    assert not hasattr(sfm_app, "no_such_name")

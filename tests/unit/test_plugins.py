import types

import pytest

from sfm_app.errors import ConfigError, PluginError
from sfm_app.plugins import Estimator, hookimpl, load_plugins
from sfm_app.types import Rejected


def plugin(**functions):
    return types.SimpleNamespace(**functions)


def never(x1, x2, options, seed):
    return Rejected("never fits")


@hookimpl
def sfm_estimators():
    return [Estimator("never", never, "rejects everything")]


def test_built_ins_are_there_and_lead_the_listing():
    found = load_plugins([plugin(sfm_estimators=sfm_estimators)], installed=False)

    assert next(iter(found.estimators)) == "lev-ransac"
    assert {"lev-ransac", "lev-ransac-thesis", "never"} <= set(found.estimators)
    assert {"zero-curves", "zero-curves-thesis"} <= set(found.calibrators)
    assert {"ply", "glb"} <= set(found.exporters)
    assert found.estimator("never").fit is never


def test_an_unknown_name_lists_the_known_ones():
    with pytest.raises(ConfigError, match="no estimator is named 'lev'") as caught:
        load_plugins(installed=False).estimator("lev")

    assert "lev-ransac" in caught.value.hint


def test_a_clash_of_names_is_refused():
    @hookimpl
    def clash():
        return [Estimator("msac", never)]

    with pytest.raises(PluginError, match="two plug-ins offer 'msac'"):
        load_plugins([plugin(sfm_estimators=clash)], installed=False)


def test_a_misspelt_hook_is_refused():
    @hookimpl
    def sfm_estimator():
        return []

    with pytest.raises(PluginError, match="sfm_estimator"):
        load_plugins([plugin(sfm_estimator=sfm_estimator)], installed=False)

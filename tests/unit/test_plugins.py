import pickle
import sys
import types
from dataclasses import replace
from importlib import metadata

import pytest

from sfm_app.errors import ConfigError, PluginError
from sfm_app.plugins import Estimator, hookimpl, installed_plugins, load_plugins
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
    assert {"ply", "glb", "obj"} <= set(found.exporters)
    assert found.estimator("never").fit is never


def test_an_unknown_name_lists_the_known_ones():
    with pytest.raises(ConfigError, match="no estimator is named 'lev'") as caught:
        load_plugins(installed=False).estimator("lev")
    assert "lev-ransac" in caught.value.hint


@hookimpl
def clash():
    return [Estimator("msac", never)]


@pytest.mark.parametrize(
    ("hook", "says"), [("sfm_estimators", "two plug-ins offer 'msac'"), ("sfm_estimator", "sfm_estimator")]
)
def test_a_clash_of_names_and_a_misspelt_hook_are_refused(hook, says):
    with pytest.raises(PluginError, match=says):
        load_plugins([plugin(**{hook: clash})], installed=False)


@pytest.fixture
def installed(monkeypatch):
    """A package that comes and goes, and how often anybody looked for it."""
    looked = []
    module = types.ModuleType("test_plugins_never")
    module.sfm_estimators = sfm_estimators
    monkeypatch.setitem(sys.modules, module.__name__, module)
    package = types.SimpleNamespace(entry_points=[metadata.EntryPoint("never", module.__name__, "sfm_app")])
    monkeypatch.setattr(metadata, "distributions", lambda: looked.append(1) or [package])
    installed_plugins.cache_clear()
    yield looked
    installed_plugins.cache_clear()


def test_installed_packages_are_searched_once_per_process(installed):
    assert load_plugins() is load_plugins()
    assert load_plugins().estimator("never").fit is never
    assert len(installed) == 1
    installed_plugins.cache_clear()
    assert "never" in load_plugins().estimators
    assert len(installed) == 2


def test_given_modules_and_no_installed_ones_are_not_kept(installed):
    extra = plugin()
    assert "never" not in load_plugins(installed=False).estimators
    assert load_plugins([extra]) is not load_plugins([extra])
    assert "never" in load_plugins([extra]).estimators


def test_a_plugin_that_does_not_import_is_named_every_time(installed, monkeypatch):
    monkeypatch.setitem(sys.modules, "test_plugins_never", None)
    for _ in range(2):
        with pytest.raises(PluginError, match="test_plugins_never"):
            load_plugins()


def test_methods_travel_by_name():
    known = load_plugins(installed=False)
    for method in (*known.estimators.values(), *known.features.values()):
        bytes_ = pickle.dumps(method)
        assert len(bytes_) < 200
        assert pickle.loads(bytes_) == method  # noqa: S301 - our own bytes


def test_a_method_that_another_machine_does_not_have_is_named():
    unknown = replace(load_plugins(installed=False).estimator("lev-ransac"), name="only-here")
    with pytest.raises(ConfigError, match="'only-here'"):
        pickle.loads(pickle.dumps(unknown))  # noqa: S301

"""A run that has done nothing yet."""

from types import SimpleNamespace

import pytest

from sfm_app.runtime.context import RunContext
from sfm_app.runtime.parallel import make_executor
from sfm_app.runtime.workspace import Workspace
from sfm_app.settings import Settings


@pytest.fixture
def run(tmp_path):
    with make_executor(1) as executor:
        yield RunContext(Settings(), Workspace(tmp_path / "out"), SimpleNamespace(), executor, 1)

"""A run that has done nothing yet."""

from types import SimpleNamespace

import pytest

from sfm_app.context import RunContext
from sfm_app.parallel import make_executor
from sfm_app.settings import Settings
from sfm_app.workspace import Workspace


@pytest.fixture
def run(tmp_path):
    with make_executor(1) as executor:
        yield RunContext(Settings(), Workspace(tmp_path / "out"), SimpleNamespace(), executor, 1)

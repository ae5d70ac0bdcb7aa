"""Commands of the tutorial and the how-to pages are run for real, in a folder with photos and a finished run."""

import pytest
from click.testing import CliRunner

from sfm_app.cli import main

pytestmark = pytest.mark.slow

COMMANDS = (
    ("run photos -o out", "model.glb"),
    ("run photos -o out --until scene --json", '"photos"'),
    ("calibrate photos -o out --figure camera.png", "px"),
    ("export out --format obj", "model.obj"),
    ("export out --format colmap", "colmap"),
    ("export out --format splat", "splat"),
    ("export out --points -o scene.ply", "scene.ply"),
    ("measure out 0,0,0 1,0,0", "+-"),
    ("report out", "report.html"),
    ("markers 50mm -o markers.pdf", "markers.pdf"),
    ("config --set depth.neighbors=6", "neighbors = 6"),
    ("plugins", "lev-ransac"),
)


@pytest.mark.parametrize(("typed", "says"), COMMANDS, ids=[typed for typed, _ in COMMANDS])
def test_it_does_what_the_page_says(typed, says, beside_a_run):
    done = CliRunner().invoke(main, typed.split())
    assert done.exit_code == 0, done.output
    assert says in done.output

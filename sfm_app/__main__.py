"""``python -m sfm_app`` is ``sfm-app``."""

from sfm_app.cli.program import main

main()

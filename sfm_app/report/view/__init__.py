"""The report on a page that only this machine can open: large models are loaded from OUT instead of from the page."""

from sfm_app.report.view.serving import serve_run

__all__ = ["serve_run"]

"""report.html: one page about a run, which opens from the disk without a network."""

from sfm_app.report.page.writing import REPORT, finish_report, write_report

__all__ = ["REPORT", "finish_report", "write_report"]

"""Reports: plots, pictures, one JSON document and one self-contained page for the results of an analysis."""

from typing import TYPE_CHECKING, Any

from gsvis.report.pictures import ViewPicture, picture_views
from gsvis.report.staircase import PERSON_RULE, load_staircase_result, write_staircase_page

if TYPE_CHECKING:
    from gsvis.report.document import Subject, report_document, write_report

__all__ = [
    "PERSON_RULE",
    "Subject",
    "ViewPicture",
    "load_staircase_result",
    "picture_views",
    "report_document",
    "write_report",
    "write_staircase_page",
]


def __getattr__(name: str) -> Any:
    """Import names that need matplotlib on first use."""
    if name in ("Subject", "report_document", "write_report"):
        from gsvis._extras import require

        require(f"gsvis.report.{name}", "matplotlib")
        from gsvis.report import document

        return getattr(document, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)

"""Reports: plots, pictures, one JSON document and one self-contained page for the results of an analysis."""

from typing import TYPE_CHECKING, Any

from gsvis.report.pictures import ViewPicture, picture_views

if TYPE_CHECKING:
    from gsvis.report.document import Subject, report_document, write_report

__all__ = [
    "Subject",
    "ViewPicture",
    "picture_views",
    "report_document",
    "write_report",
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

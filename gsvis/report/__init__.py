"""Reports: plots, pictures, one JSON document and one self-contained page of what an analysis found."""

from gsvis.report.document import Subject, report_document, write_report
from gsvis.report.pictures import ViewPicture, picture_views
from gsvis.report.staircase import PERSON_RULE, load_staircase_result, write_staircase_page

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

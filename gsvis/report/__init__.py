"""Reports: plots, pictures, one JSON document and one self-contained page of what an analysis found."""

from gsvis.report.document import Subject, report_document, write_report
from gsvis.report.pictures import ViewPicture, picture_views

__all__ = ["Subject", "ViewPicture", "picture_views", "report_document", "write_report"]

"""Reports of tests hold one pixel where users see where people stand, and few judge's eyes: both take seconds each."""

from __future__ import annotations

import base64

import pytest

__all__ = ["PIXEL", "draw_no_places", "take_few_judges"]

PIXEL = base64.b64decode("iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAIAAACQd1PeAAAADElEQVR4nGP4//8/AAX+Av4N70a4AAAAAElFTkSuQmCC")
"""A white PNG of one pixel."""


def draw_no_places(patch: pytest.MonkeyPatch) -> None:
    """Draw no picture of where people stand."""
    from gsvis.report import readings

    patch.setattr(readings, "picture_of", lambda source, place, **options: PIXEL)


def take_few_judges(patch: pytest.MonkeyPatch) -> None:
    """Judge by four eyes of each rule where a command takes fifty."""
    from gsvis.cli import analyze, pvs_report

    for home in (analyze, pvs_report):
        patch.setattr(home, "JUDGES", 4)

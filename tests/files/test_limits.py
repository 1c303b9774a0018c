"""Names of files that a file gives: those that no file system takes are refused where they are read."""

from __future__ import annotations

import pytest

from gsvis.errors import FormatError
from gsvis.files.limits import safe_name


@pytest.mark.parametrize("name", ["a\ud800.ply", "\udfff", "x" * 256, "a/" + "é" * 128])
def test_a_name_that_no_file_can_have_is_refused(name: str) -> None:
    with pytest.raises(FormatError) as caught:
        safe_name("meta.json", "files", name)
    assert str(caught.value).isprintable()


@pytest.mark.parametrize("name", ["é" * 127, "x" * 255, "日本/a.webp", "a/" * 100 + "b"])
def test_long_and_foreign_names_are_taken(name: str) -> None:
    assert safe_name("meta.json", "files", name) == name

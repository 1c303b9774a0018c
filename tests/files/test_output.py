"""A failing write is reported with the path that the user knows; a failing read is not taken for one."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from gsvis.errors import OutputError
from gsvis.files.atomic import atomic_path
from gsvis.files.output import output_errors


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT, errno.EFBIG])
@pytest.mark.parametrize("name", [(), (7,)])
def test_a_full_disk_without_a_name_is_ours(tmp_path: Path, code: int, name: tuple[int, ...]) -> None:
    with pytest.raises(OutputError) as caught, output_errors(tmp_path / "a"):
        raise OSError(code, os.strerror(code), *name)
    assert (caught.value.path, caught.value.errno) == (str(tmp_path / "a"), code)


@pytest.mark.parametrize("code", [errno.EIO, errno.EACCES, errno.EPERM, errno.EROFS])
@pytest.mark.parametrize("name", [(), (7,), ("/elsewhere/source",)])
def test_other_faults_without_our_name_stay(tmp_path: Path, code: int, name: tuple[int | str, ...]) -> None:
    error = OSError(code, os.strerror(code), *name)
    with pytest.raises(OSError) as caught, atomic_path(tmp_path / "a"):  # noqa: PT011 - the very object is compared
        raise error
    assert caught.value is error
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("code", [errno.EIO, errno.EACCES, errno.EPERM, errno.EROFS])
def test_other_faults_of_our_name_are_ours(tmp_path: Path, code: int) -> None:
    with pytest.raises(OutputError) as caught, atomic_path(tmp_path / "a") as partial:
        raise OSError(code, os.strerror(code), str(partial))
    assert (caught.value.path, caught.value.errno) == (str(tmp_path / "a"), code)

"""The files of tests that take longest, in their order: workers begin with them, so that none is left alone with one.

Seconds of the processor, processes and browsers included, as `tools/suite_time.py` measures them.
"""

from __future__ import annotations

__all__ = ["LONGEST"]

LONGEST = (
    "viewer/test_page.py",
    "cli/test_extras.py",
)
"""Names below tests/; of files that take more than five seconds."""

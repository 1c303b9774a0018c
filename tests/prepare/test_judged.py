"""How many views judge a package, and a world of tiles."""

from __future__ import annotations

import pytest

from gsvis.prepare.config import PrepareConfig
from gsvis.prepare.judged import count_judges, small_views


@pytest.mark.parametrize("tiles", [1, 2, 3, 50])
def test_a_world_of_any_size_is_judged_by_a_hundred_views(tiles: int) -> None:
    views = small_views(PrepareConfig().fidelity_views, count_judges(tiles))
    assert 2 * tiles * views.count >= 100
    assert views.count >= 26

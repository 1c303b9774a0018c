from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyroaring import BitMap

from gsvis._kernels.bits import count
from gsvis.files.cache import Cache
from gsvis.pvs import _order
from gsvis.pvs import codec as _codec
from gsvis.pvs._kernels import store as kernels

SIZES = st.sampled_from([0, 1, 63, 64, 65, 1000, 65_535, 65_536, 65_537, 140_000])
SHARES = st.sampled_from([0.0, 0.001, 0.05, 0.0625, 0.4, 1.0])


def draw_ids(n: int, share: float, seed: int) -> np.ndarray:
    return np.flatnonzero(np.random.default_rng(seed).random(n) < share)


@given(SIZES, SHARES, st.integers(0, 99))
def test_a_set_comes_back_from_words_bytes_and_bitmap(n: int, share: float, seed: int) -> None:
    ids = draw_ids(n, share, seed)
    words = _codec.pack(ids, n)
    assert len(words) == _codec.word_count(n)
    assert np.array_equal(_codec.ids_of(words), ids)
    assert count(words) == len(ids)
    bitmap = _codec.bitmap_of(words)
    assert bitmap == BitMap(ids.tolist())
    assert bitmap.serialize() == BitMap.deserialize(bitmap.serialize()).serialize()
    assert (
        _codec.portable(words) == BitMap(ids.tolist(), optimize=False).serialize()
    )  # offsets too, which reading does not need
    data = _codec.encode_set(words)
    assert np.array_equal(_codec.decode_set(data, n, len(ids)), words)
    assert data == _codec.encode_set(words)


@given(SIZES, SHARES, SHARES, st.integers(0, 99))
def test_kernels_agree_with_numpy_sets(n: int, share: float, other: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = draw_ids(n, share, seed), draw_ids(n, other, seed + 1)
    order = rng.permutation(n).astype(np.int32)
    assert kernels.count_shared(_codec.pack(a, n), _codec.pack(b, n)) == len(np.intersect1d(a, b))
    moved = np.zeros(_codec.word_count(n), np.uint64)
    kernels.scatter(_codec.pack(a, n), order, moved)
    assert np.array_equal(_codec.ids_of(moved), np.sort(order[a]))
    out, waiting = np.full(n, -1.0, np.float32), _codec.pack(b, n)
    alive = np.flatnonzero(waiting)
    kept = kernels.reach(_codec.pack(a, n), waiting, alive, order, np.float32(7.0), out)
    assert np.array_equal(alive[:kept], np.flatnonzero(waiting))
    assert np.array_equal(np.flatnonzero(out == 7.0), np.sort(order[np.intersect1d(a, b)]))
    assert np.array_equal(_codec.ids_of(waiting), np.setdiff1d(b, a))


@given(SIZES, SHARES, st.integers(1, 16), st.booleans(), st.integers(0, 99))
def test_classes_come_back_with_and_without_a_parent(
    n: int, share: float, classes: int, child: bool, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    levels = np.where(rng.random(n) < share, rng.integers(1, classes + 1, n), 0).astype(np.uint8)
    parent = rng.integers(0, classes + 1, n).astype(np.uint8) if child else None
    words = _codec.pack(np.flatnonzero(levels), n)
    data = _codec.encode_classes(words, levels, parent, classes)
    assert np.array_equal(_codec.decode_classes(data, words, n, parent, classes), levels)


@pytest.mark.parametrize(("classes", "digits"), [(1, 8), (2, 8), (3, 5), (4, 4), (5, 3), (6, 3), (7, 2), (16, 2)])
def test_a_byte_holds_as_many_classes_as_fit(classes: int, digits: int) -> None:
    assert _codec.digits_a_byte(classes) == digits
    assert classes**digits <= 256


def test_classes_near_those_of_the_parent_cost_little() -> None:
    rng = np.random.default_rng(0)
    n = 50_000
    parent = rng.integers(1, 5, n).astype(np.uint8)
    levels = np.where(rng.random(n) < 0.02, rng.integers(1, 5, n), parent).astype(np.uint8)
    words = _codec.pack(np.arange(n), n)
    alone = len(_codec.encode_classes(words, levels, None, 4))
    assert len(_codec.encode_classes(words, levels, parent, 4)) < alone / 3


def test_bytes_that_are_no_set_are_refused() -> None:
    words = _codec.pack(np.array([1, 5, 99]), 100)
    data = _codec.encode_set(words)
    with pytest.raises(_codec.CodecError, match="expected 4 visible Gaussians, got 3"):
        _codec.decode_set(data, 100, 4)
    with pytest.raises(_codec.CodecError, match="expected ids below 99"):
        _codec.decode_set(data, 99, 3)
    with pytest.raises(_codec.CodecError, match="expected a frame of"):
        _codec.decode_set(data, 70_000, 3)
    with pytest.raises(_codec.CodecError, match="expected a zstd frame"):
        _codec.decode_set(b"nothing of the kind", 100, 3)
    with pytest.raises(_codec.CodecError, match="zstd frame"):
        _codec.decode_set(data[:-3], 100, 3)
    parent = np.zeros(100, np.uint8)
    for broken in (*(bytes(length) for length in range(20)), b"\1\0\0\0", bytes(20) + b"rest"):
        with pytest.raises(_codec.CodecError, match="streams"):
            _codec.decode_classes(broken, words, 100, parent, 4)
    with pytest.raises(_codec.CodecError, match="zstd frame"):
        _codec.decode_classes(bytes(20), words, 100, parent, 4)


@given(SIZES, st.sampled_from([1, 7, 255, 256, 40_000]), st.booleans(), st.integers(0, 99))
def test_labels_come_back(n: int, most: int, ordered: bool, seed: int) -> None:
    labels = np.random.default_rng(seed).integers(0, most + 1, n).astype(np.uint16)
    labels = np.sort(labels) if ordered else labels
    data = _codec.encode_labels(labels)
    decoded = _codec.decode_labels(data, n)
    assert np.array_equal(decoded, labels)
    assert decoded.dtype == np.uint16
    for broken in (b"", b"\0" + data[1:], data[:1] + b"no frame"):
        with pytest.raises(_codec.CodecError):
            _codec.decode_labels(broken, n)


def rooms(shuffled: bool) -> tuple[int, list[np.ndarray]]:
    """A scene of 40,000 Gaussians in 100 groups; each of 40 cells sees whole groups, but for a little noise."""
    rng = np.random.default_rng(5)
    n, cells = 40_000, 40
    groups = np.repeat(np.arange(100), n // 100)
    if shuffled:
        groups = rng.permutation(groups)
    seen = rng.random((cells, 100)) < 0.3
    return n, [_codec.pack(np.flatnonzero(seen[c][groups] ^ (rng.random(n) < 0.001)), n) for c in range(cells)]


@given(st.integers(0, 2**32 - 1), st.integers(0, 500), st.sampled_from([1, 3, 300, 1 << 16]))
def test_the_stored_order_is_by_label_then_by_id(seed: int, n: int, most: int) -> None:
    labels = np.random.default_rng(seed).integers(0, most, n).astype(np.uint16)
    assert np.array_equal(_order.order_of(labels), np.argsort(labels, kind="stable"))


@pytest.mark.parametrize(("words", "count"), [(1, 1), (1, 7), (2, 16), (3, 130)])
def test_the_nearest_center_has_the_fewest_other_bits_and_the_lowest_number(words: int, count: int) -> None:
    rng = np.random.default_rng(count)
    centers = rng.integers(0, 1 << 63, (count, words), dtype=np.uint64)
    centers[count // 2 :] = centers[: count - count // 2]  # equal ones
    signatures = centers[rng.integers(0, count, 3000)] ^ rng.integers(0, 1 << 9, (3000, words), dtype=np.uint64)
    other = np.ascontiguousarray(signatures[:, None] ^ centers[None])
    apart = np.unpackbits(other.view(np.uint8), axis=2).sum(axis=2)
    assert np.array_equal(_order._nearest_of(signatures, centers), apart.argmin(axis=1))


def test_labels_bring_together_what_the_same_cells_see() -> None:
    n, sets = rooms(shuffled=True)
    labels = _order.choose_labels(n, len(sets), sets.__getitem__)
    assert labels.max() > 0
    assert np.array_equal(labels, _order.choose_labels(n, len(sets), sets.__getitem__))
    assert _order._trial_size(sets, labels) < 0.3 * _order._trial_size(sets, np.zeros(n, np.uint16))
    order = _order.order_of(labels)
    assert np.array_equal(np.sort(order), np.arange(n))
    ranks = np.lexsort((np.arange(n), labels))
    assert np.array_equal(order, ranks)


@pytest.mark.parametrize("cells", [1, 2, 12])
@pytest.mark.parametrize("shuffled", [True, False])
def test_an_order_is_taken_only_if_it_pays_for_its_labels(cells: int, shuffled: bool) -> None:
    n, sets = rooms(shuffled)
    sets = sets[:cells]

    def size(labels: np.ndarray) -> int:
        return len(_codec.encode_labels(labels)) + _order._trial_size(sets, labels)

    assert size(_order.choose_labels(n, cells, sets.__getitem__)) <= size(np.zeros(n, np.uint16))


@pytest.mark.parametrize("cells", [2, 7])
def test_few_kinds_of_gaussians_have_a_label_each(cells: int) -> None:
    n, _ = rooms(shuffled=True)
    kinds = np.random.default_rng(2).integers(0, 2, (cells, n)).astype(bool)
    signatures = np.zeros((n, 1), np.uint64)
    for bit in range(cells):
        signatures[:, 0] |= kinds[bit].astype(np.uint64) << np.uint64(bit)
    scene_order, own, *finer = _order._candidates(signatures)
    assert not scene_order.any()
    assert not finer
    pairs = np.unique(np.stack([signatures[:, 0], own.astype(np.uint64)]), axis=1)
    assert pairs.shape[1] == len(np.unique(signatures)) == len(np.unique(own))
    assert own.max() == len(np.unique(own)) - 1


@given(st.lists(st.tuples(st.integers(0, 9), st.integers(0, 11), st.integers(0, 11)), max_size=40))
def test_parents_are_neighbors_and_chains_are_short(edges: list[tuple[int, int, int]]) -> None:
    edges = [edge for edge in edges if edge[1] != edge[2]]
    parents = _order.parents_of(edges, 12)
    pairs = {(a, b) for shared, a, b in edges if shared} | {(b, a) for shared, a, b in edges if shared}
    for cell in range(12):
        depth, at = 0, cell
        while parents[at] >= 0:
            assert (at, int(parents[at])) in pairs
            at, depth = int(parents[at]), depth + 1
            assert depth <= _order.MAX_DEPTH
        if not any(a == cell for a, _ in pairs):
            assert parents[cell] == -1


@given(st.lists(st.tuples(st.integers(0, 9), st.integers(0, 11), st.integers(0, 11)), max_size=60))
def test_groups_hang_on_their_heads_and_chains_are_short(edges: list[tuple[int, int, int]]) -> None:
    groups = np.arange(12) // 3
    heads = np.arange(0, 12, 3, dtype=np.int32)
    within = [edge for edge in edges if edge[1] != edge[2] and groups[edge[1]] == groups[edge[2]]]
    among = [(shared, a % 4, b % 4) for shared, a, b in edges if a % 4 != b % 4]
    parents = _order.parents_in_groups(heads, within, among, 12)
    for cell in range(12):
        depth, at = 0, cell
        while parents[at] >= 0:
            crosses = groups[at] != groups[parents[at]]
            assert not crosses or {at, int(parents[at])} <= set(heads.tolist())
            at = int(parents[at])
            depth += 1
        assert depth <= _order.MAX_DEPTH


def test_the_cache_forgets_what_was_used_longest_ago() -> None:
    cache, array = Cache(300), np.zeros(100, np.uint8)
    for key in "abc":
        cache.keep(key, array)
    assert cache.find("a") is array
    cache.keep("d", array)
    assert cache.find("b") is None
    assert [cache.find(key) is array for key in "acd"] == [True] * 3
    assert cache.nbytes == 300
    cache.keep("large", np.zeros(301, np.uint8))
    assert len(cache) == 3
    cache.keep("a", np.zeros(100, np.uint8))  # kept twice, counted once
    assert cache.find("a") is array
    assert cache.nbytes == 300
    cache.clear()
    assert len(cache) == cache.nbytes == 0


@pytest.mark.parametrize("words", [1, 2])
@pytest.mark.parametrize("unseen", [0, 700])
def test_signatures_are_found_as_numpy_finds_them(words: int, unseen: int) -> None:
    rng = np.random.default_rng([words, unseen])
    signatures = rng.integers(1, 9, (1000, words)).astype(np.uint64) << np.uint64(60)
    signatures[rng.permutation(1000)[:unseen]] = 0
    distinct, which = _order._unique(signatures)
    expected, places = np.unique(signatures, axis=0, return_inverse=True)
    assert np.array_equal(distinct, expected)
    assert np.array_equal(which, places.reshape(-1))

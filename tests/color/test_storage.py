from __future__ import annotations

import json
import os
import re
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsvis.color import storage
from gsvis.color.evaluate import evaluate
from gsvis.color.records import PRECISIONS, Grids, Precision, quantize
from gsvis.color.srbf import SrbfColors
from gsvis.color.storage import load_srbf, save_srbf, srbf_info
from gsvis.color.variants import VARIANTS
from gsvis.errors import FormatError
from gsvis.scene.content import scene_hash
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.sh import SH_C0
from tests.color.samples import random_colors

PARTS = ("base", "scales", "offsets", "functions", "centers", "decays", "intensities")
GEOMETRY = ("means", "quats", "scales", "opacities")


def random_scene(rng: np.random.Generator, count: int) -> Gaussians:
    return Gaussians(
        rng.normal(size=(count, 3)), rng.normal(size=(count, 4)), np.exp(rng.normal(size=(count, 3))),
        rng.random(count), rng.normal(size=(count, 1, 3)), rng.normal(size=(count, 8, 3)),
    )  # fmt: skip


def same(a: tuple[Gaussians, SrbfColors], b: tuple[Gaussians, SrbfColors]) -> bool:
    return (
        a[1].variant == b[1].variant
        and all(getattr(a[1], part).tobytes() == getattr(b[1], part).tobytes() for part in PARTS)
        and all(getattr(a[0], part).tobytes() == getattr(b[0], part).tobytes() for part in GEOMETRY)
    )


def rewritten(data: bytes, edit: Any) -> bytes:
    """A file whose bytes were edited and whose checksum fits all the same."""
    changed = edit(data)
    zeros = re.sub(rb'\{"crc32" : "[0-9a-f]{8}', b'{"crc32" : "00000000', changed)
    return zeros.replace(b'{"crc32" : "00000000', b'{"crc32" : "%08x' % zlib.crc32(zeros))


@pytest.fixture
def saved(tmp_path: Path) -> tuple[Path, Gaussians, SrbfColors]:
    rng = np.random.default_rng(0)
    g, colors = random_scene(rng, 30), random_colors(rng, 30, "hsl")
    path = tmp_path / "scene.arrow"
    save_srbf(path, g, colors, provenance={"fit": {"max_terms": 4}, "by": "tests"})
    return path, g, colors


@settings(max_examples=40)
@given(
    st.integers(0, 2**32 - 1),
    st.integers(0, 20),
    st.sampled_from(sorted(VARIANTS)),
    st.sampled_from([None, *sorted(PRECISIONS)]),
    st.integers(0, 5),
)
def test_what_was_saved_is_loaded_to_the_bit(
    tmp_path: Path, seed: int, count: int, name: str, precision: str | None, most_terms: int
) -> None:
    rng = np.random.default_rng(seed)
    g, colors = random_scene(rng, count), random_colors(rng, count, name, most_terms)
    save_srbf(tmp_path / "a.arrow", g, colors, precision=precision)
    expected = colors if precision is None else quantize(colors, precision).dequantize()
    assert same(load_srbf(tmp_path / "a.arrow"), (g, expected))


def test_many_batches_make_one_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(storage, "ROWS", 7)
    rng = np.random.default_rng(1)
    g, colors = random_scene(rng, 33), random_colors(rng, 33, "hsl")
    save_srbf(tmp_path / "a.arrow", g, colors)
    assert pa.ipc.open_file(tmp_path / "a.arrow").num_record_batches == 5
    assert same(load_srbf(tmp_path / "a.arrow"), (g, colors))


def test_the_header_states_what_is_in_the_file(saved: tuple[Path, Gaussians, SrbfColors]) -> None:
    path, g, colors = saved
    info = srbf_info(path)
    assert (info.variant, info.gaussians, info.terms, info.grids) == ("hsl", 30, colors.num_terms, None)
    assert info.scene == scene_hash(g)
    assert info.provenance == {"fit": {"max_terms": 4}, "by": "tests"}
    assert info.nbytes == path.stat().st_size
    packed = quantize(colors, "coarse")
    save_srbf(path, g, packed)
    assert srbf_info(path).grids == packed.grids == Grids.from_colors(packed.dequantize(), "coarse")


def test_any_arrow_client_reads_it(saved: tuple[Path, Gaussians, SrbfColors]) -> None:
    path, g, colors = saved
    with pa.memory_map(str(path)) as source:
        table = pa.ipc.open_file(source).read_all()
    assert json.loads(table.schema.metadata[b"gsvis"])["format"] == "gsvis-srbf"
    rows = table.to_pylist()
    np.testing.assert_array_equal([row["means"] for row in rows], g.means)
    terms = [term for row in rows for term in row["terms"]]
    np.testing.assert_array_equal([len(row["terms"]) for row in rows], colors.counts)
    np.testing.assert_array_equal([[t["theta"], t["phi"]] for t in terms], colors.centers)
    np.testing.assert_array_equal([t["intensities"] for t in terms], colors.intensities)


def test_integers_and_header_are_all_a_decoder_needs(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    g, colors = random_scene(rng, 9), random_colors(rng, 9, "rgb")
    packed = quantize(colors, "wire")
    save_srbf(tmp_path / "a.arrow", g, packed)
    table = pa.ipc.open_file(tmp_path / "a.arrow").read_all()
    header = json.loads(table.schema.metadata[b"gsvis"])["quantized"]
    terms = [term for row in table.to_pylist() for term in row["terms"]]
    values = packed.dequantize()
    low, high = header["decays"]
    bits = header["precision"]
    decays = [low * (high / low) ** (t["decay"] / (2 ** bits["decay"] - 1)) for t in terms]
    np.testing.assert_allclose(decays, values.decays, rtol=1e-6)
    theta = [(t["theta"] + 0.5) * np.pi / 2 ** bits["center"] for t in terms]
    np.testing.assert_allclose(theta, values.centers[:, 0], rtol=1e-6)
    half = 2 ** (bits["intensity"] - 1) - 1
    places = np.array([t["intensities"] for t in terms]) - half
    sizes = 0.1 * np.expm1(np.log1p(header["intensity"] / 0.1) * np.abs(places) / half)
    np.testing.assert_allclose(np.sign(places) * sizes, values.intensities, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("name", sorted(VARIANTS))
def test_a_viewer_that_knows_no_terms_shows_base_colors(tmp_path: Path, name: str) -> None:
    rng = np.random.default_rng(3)
    g, colors = random_scene(rng, 20), random_colors(rng, 20, name)
    save_srbf(tmp_path / "a.arrow", g, colors)
    scene, loaded = load_srbf(tmp_path / "a.arrow")
    assert scene.sh_degree == 0
    shown = 0.5 + SH_C0 * scene.sh0[:, 0].astype(np.float64)
    np.testing.assert_allclose(shown, evaluate(loaded.first(0), g.means, [9.0, 9.0, 9.0]), atol=1e-5)


def test_the_same_scene_makes_the_same_bytes(saved: tuple[Path, Gaussians, SrbfColors]) -> None:
    path, g, colors = saved
    before = path.read_bytes()
    save_srbf(path, g, colors, provenance={"by": "tests", "fit": {"max_terms": 4}})
    assert path.read_bytes() == before


def test_a_failed_write_leaves_what_was_there(
    saved: tuple[Path, Gaussians, SrbfColors], monkeypatch: pytest.MonkeyPatch
) -> None:
    path, g, colors = saved
    before = path.read_bytes()

    def fail(*_: Any) -> Any:
        raise OSError("disk full")
        yield

    monkeypatch.setattr(storage, "_batches", fail)
    with pytest.raises(OSError, match="disk full"):
        save_srbf(path, g, colors)
    assert path.read_bytes() == before
    assert os.listdir(path.parent) == [path.name]


def test_arguments_are_checked(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    g, colors = random_scene(rng, 5), random_colors(rng, 5)
    with pytest.raises(ValueError, match="colors: expected one for each of 4 Gaussians, got 5"):
        save_srbf(tmp_path / "a", g[:4], colors)
    with pytest.raises(ValueError, match="precision: expected None for quantized colors"):
        save_srbf(tmp_path / "a", g, quantize(colors), precision="wire")
    with pytest.raises(ValueError, match="provenance: expected JSON values"):
        save_srbf(tmp_path / "a", g, colors, provenance={"x": float("nan")})
    assert not list(tmp_path.iterdir())


def test_provenance_cannot_pass_for_a_checksum(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    g, colors = random_scene(rng, 3), random_colors(rng, 3)
    provenance = {'{"crc32" : "00000000"}': '{"crc32" : "00000000"}'}
    save_srbf(tmp_path / "a", g, colors, provenance=provenance)
    assert srbf_info(tmp_path / "a").provenance == provenance
    assert same(load_srbf(tmp_path / "a"), (g, colors))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "expected an Arrow file of format gsvis-srbf, got 0 bytes"),
        (b"ply\nformat ascii 1.0\n" + bytes(100), "got a file that begins b'ply"),
        (b"ARROW1\0\0" + bytes(100), "expected ARROW1 at the end"),
        (b"ARROW1\0\0" + bytes(100) + b"ARROW1", "byte 8: expected an Arrow schema"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "other"
    path.write_bytes(content)
    with pytest.raises(FormatError, match=re.escape(message)):
        load_srbf(path)


def test_rows_without_a_value_are_refused(saved: tuple[Path, Gaussians, SrbfColors]) -> None:
    path = saved[0]
    table = pa.ipc.open_file(path).read_all()
    for name, gap in (("opacities", None), ("base", [0.1, None, 0.3]), ("terms", None), ("terms", [None])):
        column = table.column(name).combine_chunks()
        k = table.schema.get_field_index(name)
        values = pa.array([gap, *column.to_pylist()[1:]], column.type)
        with pa.ipc.new_file(str(path), table.schema) as writer:
            writer.write_table(table.set_column(k, table.schema.field(name), values))
        path.write_bytes(rewritten(path.read_bytes(), lambda data: data))
        with pytest.raises(FormatError, match=rf"column '{name}'|valid record batch|gaussians|terms"):
            load_srbf(path)


def test_other_arrow_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "other.arrow"
    for metadata, message in (
        (None, "an Arrow file without them"),
        ({b"gsvis": b'{"format":"else","version":1}'}, "format: expected gsvis-srbf, got 'else'"),
        ({b"gsvis": b"{"}, "expected JSON"),
    ):
        schema = pa.schema([pa.field("x", pa.int8())], metadata=metadata)
        with pa.ipc.new_file(str(path), schema) as writer:
            writer.write_batch(pa.record_batch([pa.array([1], pa.int8())], schema=schema))
        with pytest.raises(FormatError, match=message):
            load_srbf(path)
    with pytest.raises(FileNotFoundError):
        load_srbf(tmp_path / "nothing")


def test_a_newer_version_is_refused_with_a_clear_line(saved: tuple[Path, Gaussians, SrbfColors]) -> None:
    path = saved[0]
    path.write_bytes(rewritten(path.read_bytes(), lambda data: data.replace(b'"version":1', b'"version":2')))
    with pytest.raises(FormatError, match="version: expected at most 1, got 2; update gsvis"):
        srbf_info(path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b'"gaussians":30', b'"gaussians":31', "gaussians: expected 31 as the header says, got 30"),
        (b'"variant":"hsl"', b'"variant":"yuv"', "variant: expected one of"),
        (b'"variant":"hsl"', b'"variant":"rgb"', "column 'terms': expected list"),
        (b'"variant":"hsl"', b'"variant":["a"]', "variant: expected one of"),
        (b"opacities", b"opac\xff\xfeies", "an Arrow schema"),
        (b'"quantized":null', b'"quantized":1234', "quantized: expected an object"),
        (b"opacities", b"opacitiez", "column 'opacities'"),
        (b'"scene":"', b'"scena":"', "scene: expected the hash of a scene, got None"),
    ],
)
def test_headers_that_contradict_the_rows_are_refused(
    saved: tuple[Path, Gaussians, SrbfColors], old: bytes, new: bytes, message: str
) -> None:
    path = saved[0]
    path.write_bytes(rewritten(path.read_bytes(), lambda data: data.replace(old, new)))
    with pytest.raises(FormatError, match=message):
        load_srbf(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"base": 300}, "base: expected values in"),
        ({"intensities": 255}, r"intensities: expected values in \[0, 62\], got 255"),
        ({"decays": (2.0, 1.0)}, "decays"),
        ({"scales": (0.0, 1.0)}, "scales"),
        ({"bits": 17}, "integer from 2 to 16"),
    ],
)
def test_integers_and_ranges_are_checked_on_reading(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: dict[str, Any], message: str
) -> None:
    rng = np.random.default_rng(6)
    g, colors = random_scene(rng, 5), random_colors(rng, 5, "hsl")
    packed = quantize(colors, replace(PRECISIONS["wire"], base=8))
    grids = packed.grids
    if "bits" in change:
        object.__setattr__(grids.precision, "decay", change.pop("bits"))
    for name in ("decays", "scales"):
        if name in change:
            object.__setattr__(grids, name, change.pop(name))
    if "base" in change:
        object.__setattr__(packed.grids.precision, "base", 2)
    if "intensities" in change:
        object.__setattr__(packed, "intensities", np.full_like(packed.intensities, 255))
    save_srbf(tmp_path / "a", g, packed)
    with pytest.raises(FormatError, match=message):
        load_srbf(tmp_path / "a")


def test_a_promise_of_gigabytes_is_refused_before_they_are_allocated(tmp_path: Path) -> None:
    rng = np.random.default_rng(7)
    g, colors = random_scene(rng, 2000), random_colors(rng, 2000)
    path = tmp_path / "a"
    save_srbf(path, g, colors)
    size = np.int64(2000 * 3 * 4).tobytes()  # what the means say they become

    def grown(data: bytes) -> bytes:
        place = data.index(size, data.index(b"ARROW1"))
        return data[:place] + np.int64(1 << 40).tobytes() + data[place + 8 :]

    path.write_bytes(rewritten(path.read_bytes(), grown))
    with pytest.raises(FormatError, match=r"expected at most .* got a promise of 1,099,5"):
        load_srbf(path)


@settings(max_examples=100)
@given(st.data())
def test_damaged_bytes_give_an_error_or_the_same_scene(tmp_path: Path, data: st.DataObject) -> None:
    rng = np.random.default_rng(8)
    g, colors = random_scene(rng, 12), random_colors(rng, 12, "hsl")
    path = tmp_path / "a"
    precision = data.draw(st.sampled_from([None, "wire"]))
    save_srbf(path, g, colors, precision=precision)
    expected, whole = load_srbf(path), bytearray(path.read_bytes())
    edit = data.draw(st.sampled_from(["flip", "set", "cut", "insert"]))
    place = data.draw(st.integers(0, len(whole) - 1))
    if edit == "flip":
        whole[place] ^= 1 << data.draw(st.integers(0, 7))
    elif edit == "set":
        whole[place : place + 4] = data.draw(st.binary(min_size=4, max_size=4))
    elif edit == "cut":
        del whole[place:]
    else:
        whole[place:place] = data.draw(st.binary(min_size=1, max_size=8))
    path.write_bytes(whole)
    try:
        loaded = load_srbf(path)
    except FormatError:
        return
    assert same(loaded, expected)


@settings(max_examples=100)
@given(st.integers(0, 2**32 - 1))
def test_damage_under_a_checksum_that_fits_is_no_worse(tmp_path: Path, seed: int) -> None:
    """Whoever means harm can compute a checksum: still nothing but a `FormatError` or some valid scene."""
    rng = np.random.default_rng(9)
    path = tmp_path / "a"
    save_srbf(path, random_scene(rng, 12), random_colors(rng, 12, "rgb"), precision="wire" if seed % 2 else None)

    def edit(data: bytes) -> bytes:
        changed = bytearray(data)
        picks = np.random.default_rng(seed)
        for place in picks.integers(8, len(data) - 10, picks.integers(1, 4)):
            changed[place] ^= 1 << int(picks.integers(0, 8))
        return bytes(changed)

    path.write_bytes(rewritten(path.read_bytes(), edit))
    try:
        scene, colors = load_srbf(path)
    except FormatError:
        return
    assert len(scene) == len(colors)
    assert np.all(np.isfinite(scene.sh0))


def test_precision_of_ones_own_is_kept(tmp_path: Path) -> None:
    rng = np.random.default_rng(10)
    g, colors = random_scene(rng, 8), random_colors(rng, 8)
    mine = Precision("mine", 9, 9, 9, 9, 9, 9)
    save_srbf(tmp_path / "a", g, colors, precision=mine)
    grids = srbf_info(tmp_path / "a").grids
    assert grids is not None
    assert grids.precision == mine

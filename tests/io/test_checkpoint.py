"""Checkpoints of gsplat and nerfstudio: read as torch reads them, nothing of them run, damage named."""

from __future__ import annotations

import io
import pickle
import warnings
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import gsvis
from gsvis import FormatError, from_gsplat, load_scene
from gsvis.io.checkpoint import load_checkpoint
from gsvis.scene.gaussians import Gaussians

torch = pytest.importorskip("torch")

FIELDS = ("means", "quats", "scales", "opacities", "sh0", "shN")


def splats(n: int = 7, degree: int = 2) -> Any:
    """Raw values as gsplat's trainer starts with them: sh0 and shN are two views of one array."""
    g = torch.Generator().manual_seed(3)
    colors = torch.randn((n, (degree + 1) ** 2, 3), generator=g)
    return torch.nn.ParameterDict(
        {
            "means": torch.nn.Parameter(torch.randn((n, 3), generator=g)),
            "scales": torch.nn.Parameter(torch.randn((n, 3), generator=g) - 3.0),
            "quats": torch.nn.Parameter(torch.rand((n, 4), generator=g) + 0.1),
            "opacities": torch.nn.Parameter(torch.randn((n,), generator=g)),
            "sh0": torch.nn.Parameter(colors[:, :1, :]),
            "shN": torch.nn.Parameter(colors[:, 1:, :]),
        }
    )


def expected(raw: Any) -> Gaussians:
    """What the values mean, by torch."""
    with torch.no_grad():
        activated = {**raw, "scales": torch.exp(raw["scales"]), "opacities": torch.sigmoid(raw["opacities"])}
        return Gaussians(**{name: activated[name].detach().numpy().copy() for name in FIELDS})


def assert_same(a: Gaussians, b: Gaussians) -> None:
    for name in FIELDS:
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=2e-6, atol=1e-7, err_msg=name)


def gsplat_file(path: Path, raw: Any = None) -> Path:
    raw = splats() if raw is None else raw
    pose = torch.nn.Embedding(5, 9)
    torch.save({"step": 6999, "splats": raw.state_dict(), "pose_adjust": pose.state_dict()}, path)
    return path


def nerfstudio_state(raw: Any, prefix: str = "_model.gauss_params.") -> OrderedDict[str, Any]:
    state = {f"{prefix}{name}": raw[name].detach() for name in ("means", "scales", "quats")}
    state[f"{prefix}opacities"] = raw["opacities"].detach()[:, None]
    state[f"{prefix}features_dc"] = raw["sh0"].detach()[:, 0].contiguous()
    state[f"{prefix}features_rest"] = raw["shN"].detach().contiguous()
    state["_model.lpips.net.weight"] = torch.zeros(2, 2)
    state["datamanager.train_camera_optimizer.pose_adjustment"] = torch.zeros(4, 6)
    return OrderedDict(state)


def nerfstudio_file(path: Path, state: Any) -> Path:
    """As the trainer saves: with optimizers, and numpy scalars that torch refuses to load."""
    weight = torch.nn.Parameter(torch.zeros(3))
    adam = torch.optim.Adam([weight])
    weight.sum().backward()
    adam.step()
    rates = {"_last_lr": [np.float64(0.1)], "lr_lambdas": [None]}
    others = {"optimizers": {"means": adam.state_dict()}, "schedulers": {"means": rates}, "scalers": {}}
    torch.save({"step": 29999, "pipeline": state, **others}, path)
    return path


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_a_gsplat_checkpoint_is_read_as_torch_reads_it(tmp_path: Path, degree: int) -> None:
    raw = splats(degree=degree)
    for name in ("ckpt_6999_rank0.pt", "named.otherwise"):
        assert_same(load_scene(gsplat_file(tmp_path / name, raw)), expected(raw))
    by_torch = torch.load(tmp_path / "ckpt_6999_rank0.pt", weights_only=True)["splats"]
    assert_same(from_gsplat(by_torch), expected(raw))


@pytest.mark.parametrize("prefix", ["_model.gauss_params.", "module._model.gauss_params.", "_model."])
def test_a_nerfstudio_checkpoint_is_read_with_all_that_stands_beside_it(tmp_path: Path, prefix: str) -> None:
    raw = splats()
    file = nerfstudio_file(tmp_path / "step-000029999.ckpt", nerfstudio_state(raw, prefix))
    assert_same(load_scene(file), expected(raw))


def test_nerfstudio_without_higher_degrees_keeps_colors_as_logits(tmp_path: Path) -> None:
    raw = splats(degree=0)
    scene = load_scene(nerfstudio_file(tmp_path / "step-1.ckpt", nerfstudio_state(raw)))
    colors = torch.sigmoid(raw["sh0"].detach()[:, 0]).numpy()
    np.testing.assert_allclose(0.5 + 0.28209479177387814 * scene.sh0[:, 0], colors, atol=1e-6)
    assert scene.sh_degree == 0


@pytest.mark.parametrize("kind", ["float16", "bfloat16", "float64"])
def test_other_precisions(tmp_path: Path, kind: str) -> None:
    raw = torch.nn.ParameterDict(
        {k: torch.nn.Parameter(v.detach().to(getattr(torch, kind))) for k, v in splats().items()}
    )
    single = {name: value.detach().float() for name, value in raw.items()}
    assert_same(load_scene(gsplat_file(tmp_path / "a.pt", raw)), expected(single))


def test_the_plain_state_dict_is_read_too(tmp_path: Path) -> None:
    raw = splats()
    torch.save(raw.state_dict(), tmp_path / "splats.pt")
    assert_same(load_scene(tmp_path / "splats.pt"), expected(raw))


def test_from_gsplat_takes_the_parameters_of_a_trainer_and_copies_them() -> None:
    raw = splats()
    before = expected(raw)
    scenes = [
        from_gsplat(raw),
        from_gsplat(raw.state_dict()),
        from_gsplat({k: v.detach().numpy() for k, v in raw.items()}),
    ]
    scenes.append(gsvis.from_gsplat({**raw, "opacities": raw["opacities"][:, None], "extra": "passed over"}))
    with torch.no_grad():
        for value in raw.values():
            value.add_(1.0)
    for scene in scenes:
        assert_same(scene, before)
    without = {name: value for name, value in raw.items() if name != "shN"}
    assert from_gsplat(without).sh_degree == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"means": None},
            "splats: expected means, scales, quats, opacities, sh0, shN, got no means but ",
        ),
        ({"sh0": None, "features": 1, "colors": 1}, "got no sh0 but .*; colors of an appearance module cannot be read"),
        ({"scales": np.zeros((7, 2))}, r"scales: expected shape \(N, 3\), got \(7, 2\)"),
        ({"scales": np.full((7, 3), np.nan)}, "scales: expected finite values"),
        ({"quats": np.full((7, 4), np.inf)}, "quats: expected finite values"),
        ({"opacities": np.zeros((7, 2))}, r"opacities: expected shape \(N,\)"),
        ({"shN": np.zeros((7, 5, 3))}, "expected 1, 4, 9 or 16 coefficients"),
        ({"means": np.zeros((6, 3))}, "expected one length for all"),
    ],
)
def test_what_is_wrong_with_splats_is_named(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    raw = {name: value.detach().numpy() for name, value in splats().items()}
    raw = {name: value for name, value in {**raw, **change}.items() if value is not None}
    with pytest.raises(ValueError, match=message):
        from_gsplat(raw)
    tensors = {name: torch.as_tensor(value) for name, value in raw.items()}
    torch.save({"step": 1, "splats": tensors}, tmp_path / "a.pt")
    with pytest.raises(FormatError, match=r"a\.pt: "):
        load_scene(tmp_path / "a.pt")


def rewritten(file: Path, change: Callable[[str, bytes], bytes], compression: int = zipfile.ZIP_STORED) -> Path:
    """The zip with its records changed."""
    with zipfile.ZipFile(file) as archive:
        records = [(name, archive.read(name)) for name in archive.namelist()]
    with zipfile.ZipFile(file, "w", compression) as archive:
        for name, data in records:
            archive.writestr(name, change(name, data))
    return file


def with_structure(file: Path, pickled: bytes) -> Path:
    return rewritten(file, lambda name, data: pickled if name.endswith("data.pkl") else data)


class Runs:
    """Leaves a mark if what reads it runs it."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return Path.touch, (self.path,)


def test_nothing_in_a_checkpoint_is_run(tmp_path: Path) -> None:
    mark, raw = tmp_path / "mark", splats()
    hostile = {"step": Runs(mark), "splats": raw.state_dict(), "model": torch.nn.Linear(2, 2)}
    torch.save(hostile, tmp_path / "a.pt")
    assert_same(load_scene(tmp_path / "a.pt"), expected(raw))
    file = with_structure(gsplat_file(tmp_path / "b.pt"), pickle.dumps(Runs(mark)))
    with pytest.raises(FormatError, match=r"expected a checkpoint of gsplat .* got a Ignored"):
        load_scene(file)
    assert not mark.exists()


@pytest.mark.parametrize(
    "pickled",
    [
        b"\x80\x02}r\xff\xff\xff\x7f.",  # a memo index of 2^31
        b"\x80\x02}p9999999999999\n.",
        b"\x80\x05\x96\xff\xff\xff\xff\xff\xff\x00\x00.",  # bytearray of 2^48 bytes
        b"\x80\x02c__builtin__\nbytearray\n\x8a\x06\x00\x00\x00\x00\x00\x7f\x85R.",  # bytearray(2^46)
        b"\x80\x02(((((((",
        b"",
        b"no pickle",
        b"\x80\x02X\x01\x00\x00\x00aQ.",  # a reference that is a text
        pickle.dumps({"splats": {"means": 3}}),
        pickle.dumps([1, 2]),
        pickle.dumps(((1, 2), 30000)),
        pickle.dumps({"network": {}}),
    ],
)
def test_other_structures_are_refused_in_one_line(tmp_path: Path, pickled: bytes) -> None:
    file = with_structure(gsplat_file(tmp_path / "a.pt"), pickled)
    with pytest.raises(FormatError, match=r"data\.pkl") as caught:
        load_scene(file)
    assert len(str(caught.value)) < 500


def test_promises_beyond_the_records_are_refused(tmp_path: Path) -> None:
    class Stretched:
        """A tensor of 2^40 rows that all lie on the first."""

        def __init__(self, tensor: Any, size: tuple[int, ...], stride: tuple[int, ...]) -> None:
            self.parts = (tensor.storage(), 0, size, stride, False, OrderedDict())

        def __reduce__(self) -> Any:
            return torch._utils._rebuild_tensor_v2, self.parts

    for size, stride in (((1 << 40, 3), (0, 1)), ((7, 3), (300, 1)), ((1 << 30, 1 << 30), (1, 1))):
        raw = splats().state_dict()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of TypedStorage
            raw["means"] = Stretched(raw["means"], size, stride)
            torch.save({"step": 1, "splats": raw}, tmp_path / "a.pt")
        with pytest.raises(FormatError, match="means: expected values inside the 84 bytes of a/data/"):
            load_scene(tmp_path / "a.pt")
    squeezed = rewritten(gsplat_file(tmp_path / "b.pt"), lambda _, data: data, zipfile.ZIP_DEFLATED)
    with pytest.raises(FormatError, match="expected a record that is not compressed"):
        load_scene(squeezed)
    file = gsplat_file(tmp_path / "c.pt")
    with_structure(file, b"\x80\x02" + b"N0" * 300_000 + b".")
    with pytest.raises(FormatError, match="expected at most 524,288 bytes"):
        load_scene(file)


def test_damage_is_a_format_error_or_changes_nothing(tmp_path: Path) -> None:
    raw = splats()
    whole = gsplat_file(tmp_path / "a.pt", raw).read_bytes()
    rng = np.random.default_rng(0)
    file = tmp_path / "b.pt"
    for cut in rng.integers(0, len(whole), 60).tolist():
        file.write_bytes(whole[:cut])
        with pytest.raises(FormatError):
            load_scene(file)
    read = 0
    for at, bit in zip(rng.integers(0, len(whole), 400).tolist(), rng.integers(0, 8, 400).tolist(), strict=True):
        damaged = bytearray(whole)
        damaged[at] ^= 1 << bit
        file.write_bytes(damaged)
        try:
            scene = load_checkpoint(file)
        except FormatError:
            continue
        read += 1
        assert_same(scene, expected(raw))  # the zip knows a checksum of every record that is read
    assert read < 400


OPERATIONS = (b"R", b"b", b"(", b"t", b"u", b"e", b"}", b"]", b")", b"0", b"2", b"h\x01", b"N", b"Q", b"\x85", b"\x81")


def test_damage_to_the_structure_is_a_format_error(tmp_path: Path) -> None:
    raw = splats()
    file = nerfstudio_file(tmp_path / "a.ckpt", nerfstudio_state(raw))
    with zipfile.ZipFile(file) as archive:
        pickled = next(archive.read(name) for name in archive.namelist() if name.endswith("data.pkl"))
    rng = np.random.default_rng(1)
    refused = 0
    for _ in range(150):
        damaged, at = bytearray(pickled), int(rng.integers(len(pickled)))
        if rng.random() < 0.5:
            damaged[at] ^= 1 << int(rng.integers(8))
        else:
            damaged[at:at] = OPERATIONS[rng.integers(len(OPERATIONS))]
        try:
            load_scene(with_structure(file, bytes(damaged)))
        except FormatError as error:
            refused += 1
            assert len(str(error)) < 1500
    assert refused > 100


def test_formats_of_old_are_named(tmp_path: Path) -> None:
    raw = splats()
    torch.save({"splats": raw.state_dict()}, tmp_path / "old.pt", _use_new_zipfile_serialization=False)
    with pytest.raises(FormatError, match=r"torch before 1\.6; .*torch\.save"):
        load_scene(tmp_path / "old.pt")
    (tmp_path / "plain.pt").write_bytes(pickle.dumps({"splats": 1}))
    with pytest.raises(FormatError, match="pickle"):
        load_scene(tmp_path / "plain.pt")
    with zipfile.ZipFile(tmp_path / "other.pt", "w") as archive:
        archive.writestr("readme.txt", "hello")
    with pytest.raises(FormatError):
        load_scene(tmp_path / "other.pt")


def test_a_rank_of_several_is_read_with_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    gsplat_file(tmp_path / "ckpt_9_rank0.pt")
    load_scene(tmp_path / "ckpt_9_rank0.pt")
    assert not caplog.records
    gsplat_file(tmp_path / "ckpt_9_rank1.pt")
    gsplat_file(tmp_path / "ckpt_19_rank1.pt")
    load_scene(tmp_path / "ckpt_9_rank0.pt")
    assert "holds only the part of rank 0; files of 1 other ranks are beside it" in caplog.text


def test_an_empty_checkpoint_is_an_empty_scene(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="expected at least one Gaussian"):
        load_scene(gsplat_file(tmp_path / "a.pt", splats(0)))


def test_what_a_reader_gets_is_bounded_by_the_file(tmp_path: Path) -> None:
    buffer = io.BytesIO()
    torch.save({"splats": splats().state_dict(), "optimizers": torch.zeros(100_000)}, buffer)
    (tmp_path / "a.pt").write_bytes(buffer.getvalue())
    opened: list[str] = []
    reading = zipfile.ZipFile.read

    def spied(self: zipfile.ZipFile, name: Any, pwd: bytes | None = None) -> bytes:
        opened.append(str(name))
        return reading(self, name, pwd)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(zipfile.ZipFile, "read", spied)
        load_scene(tmp_path / "a.pt")
    with zipfile.ZipFile(tmp_path / "a.pt") as archive:
        assert max(archive.getinfo(name).file_size for name in opened) < 2000  # not the optimizer's 400 kB


def doubled(times: int, close: bytes = pickle.TUPLE2) -> bytes:
    """A tuple that holds the same tuple twice, and so on: 2 ** times leaves in a few bytes each."""
    steps = b"".join(close + pickle.BINPUT + bytes([k]) + (pickle.BINGET + bytes([k])) for k in range(times))
    return pickle.EMPTY_TUPLE + pickle.EMPTY_TUPLE + steps + close


DEEP = pickle.EMPTY_TUPLE + 400_000 * pickle.TUPLE1
LONG = pickle.MARK + 60_000 * pickle.NONE + pickle.TUPLE
IGNORED = b"cposix\nsystem\n"
TENSOR = b"ctorch._utils\n_rebuild_tensor_v2\n"
DEMANDING = {
    "a key that doubles": pickle.EMPTY_DICT + doubled(90) + pickle.NONE + pickle.SETITEM,
    "keys that double": pickle.EMPTY_DICT + pickle.MARK + doubled(90) + pickle.NONE + pickle.SETITEMS,
    "a dict of keys that double": pickle.MARK + doubled(90) + pickle.NONE + pickle.DICT,
    "a set of doubles": pickle.EMPTY_SET + pickle.MARK + doubled(90) + pickle.ADDITEMS,
    "a frozen set of doubles": pickle.MARK + doubled(90) + pickle.FROZENSET,
    "a deep key": pickle.EMPTY_DICT + DEEP + pickle.NONE + pickle.SETITEM,
    "a deep member of a set": pickle.MARK + DEEP + pickle.FROZENSET,
    "a reference that doubles": doubled(90) + pickle.BINPERSID,
    "doubles alone": doubled(90),
    "a dict in doubles": pickle.EMPTY_DICT + pickle.BINUNICODE + b"\x06\0\0\0splats" + doubled(90) + pickle.SETITEM,
    "one tuple in many places": LONG + b"q\0" + 100_000 * b"h\0",
    "tensors of many sides": LONG + b"q\0" + TENSOR + b"q\1"
    + 20_000 * (b"h\1" + b"NK\0h\0h\0" + b"\x86\x86\x86" + pickle.REDUCE + pickle.POP),
    "many calls of one long tuple": LONG + b"q\0" + IGNORED + b"q\1" + 60_000 * (b"h\1h\0" + pickle.REDUCE + b"0"),
    "states of functions": TENSOR + pickle.NONE + b"}" + b"X\x0c\0\0\0__defaults__)s" + pickle.TUPLE2 + pickle.BUILD,
    "a long number as a key, again and again": b"\x8b" + (200_000).to_bytes(4, "little") + b"\1" * 200_000 + b"q\0"
    + b"}q\1" + 30_000 * b"h\0Ns",
}  # fmt: skip


@pytest.mark.parametrize("kind", DEMANDING)
def test_reading_takes_no_more_than_the_bytes_of_a_file(tmp_path: Path, kind: str) -> None:
    from gsvis.io import checkpoint

    before = checkpoint._tensor.__defaults__
    file = with_structure(gsplat_file(tmp_path / "good.pt"), pickle.PROTO + b"\4" + DEMANDING[kind] + pickle.STOP)
    with pytest.raises(FormatError) as caught:
        load_scene(file)
    assert len(str(caught.value)) < 1000
    assert checkpoint._tensor.__defaults__ == before  # no state of a file enters what reads it

"""Write pictures atomically: a PNG, a numbered sequence or an animated GIF, with depth pictures beside them.

Colors of trained scenes are display-referred already: clipped to [0, 1] and written in 8 bits.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from gsvis.errors import FormatError
from gsvis.files.atomic import atomic_folder, atomic_path
from gsvis.files.limits import open_regular
from gsvis.files.output import TEMPORARY, check_folder, output_errors
from gsvis.files.temporary import temporary_folder

__all__ = ["Frame", "Target", "eight_bit", "is_own", "target_of", "write_frames"]

_MARK = "gsvis"  # marks pictures of gsvis, which may be replaced
_SEEN = 1.0 / 255.0  # least alpha of a pixel with a depth
_RANGE = (0.01, 0.99)  # quantiles of the depths of a frame that the colors span


@dataclass(frozen=True, eq=False)
class Frame:
    """The render of one camera.

    Attributes:
        image: (H, W, 3) float32, 0 black, 1 white.
        alpha: (H, W) float32.
        depth: (H, W) float32, expected camera z.
    """

    image: NDArray[np.float32]
    alpha: NDArray[np.float32]
    depth: NDArray[np.float32]


@dataclass(frozen=True)
class Target:
    """Where to write pictures.

    Attributes:
        path: The file or the folder.
        kind: One picture, an animation, or a folder of numbered pictures.
        count: Number of frames.
    """

    path: Path
    kind: Literal["png", "gif", "folder"]
    count: int

    @property
    def files(self) -> list[Path]:
        """Paths of the pictures, in order."""
        if self.kind != "folder":
            return [self.path]
        return [self.path / f"{i:0{self._digits}d}.png" for i in range(self.count)]

    @property
    def depth_files(self) -> list[Path]:
        """Paths of the depth pictures, in the same order."""
        return [path.with_name(f"{path.stem}_depth{path.suffix}") for path in self.files]

    def older(self) -> int:
        """Return how many numbered pictures of an earlier, longer sequence the folder holds."""
        if self.kind != "folder" or not self.path.is_dir():
            return 0
        numbers = (path.stem for path in self.path.glob("*.png") if len(path.stem) >= self._digits)
        return sum(stem.isdecimal() and int(stem) >= self.count for stem in numbers)

    def foreign(self, depth: bool) -> list[Path]:
        """Return the files that would be replaced and that `gsvis render` did not write."""
        paths = [*self.files, *(self.depth_files if depth else [])]
        return [path for path in paths if path.exists() and not is_own(path)]

    @property
    def _digits(self) -> int:
        return max(4, len(str(self.count - 1)))


def target_of(out: str, count: int) -> Target:
    """Return where to write `count` pictures; check it without leaving a file behind.

    Raises:
        ValueError: If the name fits neither a picture, an animation nor a folder, or several cameras would go into
            one picture.
        OSError: If nothing can be written there.
    """
    path = Path(out)
    suffix = path.suffix.lower()
    if path.is_dir() or out.endswith(("/", "\\")) or not suffix:
        check_folder(path)
        return Target(path, "folder", count)
    if suffix not in (".png", ".gif"):
        raise ValueError(
            f"OUT: expected a name that ends in .png or .gif, or a folder such as {path.stem}/, got {out!r}"
        )
    if suffix == ".png" and count > 1:
        raise ValueError(f"OUT: expected a folder, such as {path.stem}/, or a .gif for {count} cameras, got {out!r}")
    check_folder(path.parent)
    return Target(path, "png" if suffix == ".png" else "gif", count)


def write_frames(target: Target, frames: Iterable[Frame], *, depth: bool, fps: float) -> tuple[float, float] | None:
    """Write frames as they arrive; all files appear together after the last frame.

    Args:
        target: Where to write.
        frames: As many frames as `target.count`; only one frame is held in full at a time.
        depth: Whether to write depth pictures too.
        fps: Frames a second of an animation.

    Returns:
        Depths, in scene units, of the first and the last color in all depth pictures; None without depth pictures, or
        if nothing is seen.
    """
    animation: list[Image.Image] = []
    with ExitStack() as stack:
        place = stack.enter_context(_partial_paths(target, depth))
        kept = Path(stack.enter_context(temporary_folder())) if depth else Path()
        near = np.inf
        far = -np.inf
        for i, frame in enumerate(frames):
            picture = Image.fromarray(eight_bit(frame.image))
            if target.kind == "gif":
                animation.append(picture.quantize(256))
            else:
                place(target.files[i]).write_bytes(_png(picture))
            if depth:
                z = np.where(frame.alpha >= _SEEN, frame.depth, 0.0).astype(np.float32)
                with output_errors(kept, remedy=TEMPORARY):  # colors span all frames, so keep depths to the end
                    (kept / f"{i}.npy").write_bytes(_npy(z))
                if z.any():
                    low, high = np.quantile(z[z > 0.0], _RANGE).tolist()
                    near = min(near, low)
                    far = max(far, high)
        if animation:
            _save_animation(place(target.path), animation, fps, "")
        if not depth:
            return None
        span = (near, far) if far > 0.0 else None
        _write_depths(target, [kept / f"{i}.npy" for i in range(target.count)], place, span, fps)
    return span


@contextmanager
def _partial_paths(target: Target, depth: bool) -> Iterator[Callable[[Path], Path]]:
    """Yield a function from the path of a file to the path to write it to until all are complete."""
    if target.kind == "folder":
        with atomic_folder(target.path) as folder:
            yield lambda path: folder / path.name
        return
    with ExitStack() as stack:
        paths = [target.path, *(target.depth_files if depth else [])]
        partial = {path: stack.enter_context(atomic_path(path)) for path in paths}
        yield lambda path: partial[path]


def _write_depths(
    target: Target, kept: list[Path], place: Callable[[Path], Path], span: tuple[float, float] | None, fps: float
) -> None:
    """Write the depth pictures, as one animation or one PNG a frame, with the range of depths in their texts."""
    near, far = span or (0.0, 0.0)
    said = (
        f"expected depth (camera z, scene units) in viridis, linear from near={near:.9g} to far={far:.9g}; black: none"
    )
    texts = {"gsvis:near": f"{near:.9g}", "gsvis:far": f"{far:.9g}", "Description": said}
    pictures = (Image.fromarray(_color_depth(np.load(path), near, far)) for path in kept)
    if target.kind == "gif":
        _save_animation(place(target.depth_files[0]), [each.quantize(256) for each in pictures], fps, said)
        return
    for path, picture in zip(target.depth_files, pictures, strict=True):
        place(path).write_bytes(_png(picture, **texts))


def _save_animation(path: Path, frames: list[Image.Image], fps: float, comment: str) -> None:
    """Write pictures as a GIF that repeats."""
    hundredths = max(2, round(100.0 / fps))  # GIF counts in 1/100 s; browsers slow down frames below 2
    out = io.BytesIO()  # if Pillow writes the file itself, it loses the reason of an error
    frames[0].save(
        out,
        "gif",
        save_all=True,
        append_images=frames[1:],
        duration=10 * hundredths,
        loop=0,
        comment=f"{_MARK} {comment}".strip().encode(),
    )
    path.write_bytes(out.getbuffer())


def _png(picture: Image.Image, **texts: str) -> bytes:
    """Return the bytes of a PNG that names gsvis as its software."""
    info = PngInfo()
    out = io.BytesIO()
    for name, text in {"Software": _MARK, **texts}.items():
        info.add_text(name, text)
    picture.save(out, "png", pnginfo=info)
    return out.getvalue()


def _npy(array: NDArray[np.float32]) -> bytes:
    """Return the bytes of a .npy file; `np.save` to a file loses the reason of an error."""
    out = io.BytesIO()
    np.save(out, array)
    return out.getvalue()


def is_own(path: Path) -> bool:
    """Return whether `gsvis render` wrote a file."""
    try:
        with open_regular(path) as file, Image.open(file) as picture:
            comment = picture.info.get("comment", b"")
            text = comment.decode("utf-8", "replace") if isinstance(comment, bytes) else str(comment)
            return picture.info.get("Software") == _MARK or text.split(" ")[0] == _MARK
    except (FormatError, OSError, ValueError, SyntaxError):
        return False


def eight_bit(image: NDArray[np.floating[Any]]) -> NDArray[np.uint8]:
    """Return values (..., 3), clipped to [0, 1], as 0 to 255."""
    return np.asarray(np.rint(np.clip(image, 0.0, 1.0) * 255.0), np.uint8)


def _color_depth(depth: NDArray[np.float32], near: float, far: float) -> NDArray[np.uint8]:
    """Return (H, W, 3) viridis colors from near to far; black where the depth is 0."""
    from matplotlib import colormaps

    colors = np.asarray(colormaps["viridis"](np.arange(256), bytes=True)[:, :3], np.uint8)
    share = np.clip((depth - near) / max(far - near, 1e-12), 0.0, 1.0)
    colors = colors[np.rint(share * 255.0).astype(np.intp)]
    return np.asarray(colors * (depth > 0.0)[..., None], np.uint8)

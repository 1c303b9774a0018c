"""Photographs come with the cameras that took them, whatever size they are brought to; faults are reported first."""

from __future__ import annotations

import json
import struct
import tracemalloc
import warnings
import zlib
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gsvis.errors import FormatError, SceneError
from gsvis.scene.cameras import Cameras
from gsvis.train.photos import FEWEST_VIEWS, load_photos, photo_bytes
from tests.io.colmap_files import write_mixed
from tests.train.photo_files import HEIGHT, WIDTH, cameras, cloud, pictures, write_photos, write_transforms


@pytest.mark.parametrize("inner", ["", "sparse", "sparse/0", "sparse/0/cameras.bin"])
def test_photographs_come_back_with_cameras_and_points(tmp_path: Path, inner: str) -> None:
    write_photos(tmp_path, points=cloud())
    photos = load_photos(tmp_path / inner)
    np.testing.assert_array_equal(photos.views.images, pictures())
    np.testing.assert_allclose(photos.views.cameras.viewmats, cameras().viewmats, atol=1e-12)
    np.testing.assert_array_equal(photos.views.cameras.Ks, cameras().Ks)
    assert photos.names == cameras().names
    assert photos.points is not None
    assert len(photos.points) == len(cloud())
    assert photos.remarks == ()
    assert repr(photos) == "Photos(PosedImages(10 of 48 x 32), 40 points)"


@pytest.mark.parametrize("sizes", [True, False])
@pytest.mark.parametrize("suffix", [".png", ""])
def test_a_transforms_json_does_as_well(tmp_path: Path, sizes: bool, suffix: str) -> None:
    write_transforms(tmp_path, sizes=sizes, suffix=suffix)
    for path in (tmp_path, tmp_path / "transforms.json"):
        photos = load_photos(path)
        np.testing.assert_array_equal(photos.views.images, pictures())
        np.testing.assert_allclose(photos.views.cameras.viewmats, cameras().viewmats, atol=1e-9)
        np.testing.assert_allclose(photos.views.cameras.Ks, cameras().Ks)
        assert photos.points is None


def test_views_are_sorted_by_name_with_their_images(tmp_path: Path) -> None:
    views = cameras()
    shuffled = np.random.default_rng(0).permutation(10)
    write_photos(tmp_path)
    write_mixed(tmp_path / "sparse" / "0", views[shuffled], [(WIDTH, HEIGHT)] * 10)
    photos = load_photos(tmp_path)
    np.testing.assert_array_equal(photos.views.images, pictures())
    np.testing.assert_allclose(photos.views.cameras.viewmats, views.viewmats, atol=1e-12)


@pytest.mark.parametrize("size", [None, (24, 16)])
def test_bytes_are_those_of_the_images_and_no_pixel_is_read(tmp_path: Path, size: tuple[int, int] | None) -> None:
    write_photos(tmp_path)
    whole = load_photos(tmp_path, size=size).views.images.nbytes
    for path in (tmp_path / "images").iterdir():
        path.write_bytes(path.read_bytes()[:60])  # the header is whole
    assert photo_bytes(tmp_path, size) == whole


def test_shrinking_keeps_every_ray_and_the_light(tmp_path: Path) -> None:
    """A ray that meets the middle of a small pixel meets the same place of the large image."""
    write_photos(tmp_path)
    whole = load_photos(tmp_path).views
    for asked in ({"downscale": 2}, {"size": (24, 16)}, {"size": (19, 17)}):
        small = load_photos(tmp_path, **asked).views
        width, height = asked.get("size", (24, 16))
        assert (small.cameras.width, small.cameras.height) == (width, height)
        point = np.array([0.3, -0.2, 2.0])
        large_at, small_at = ((v.cameras.Ks[0] @ point)[:2] / 2.0 for v in (whole, small))
        np.testing.assert_allclose(small_at / (width, height), large_at / (WIDTH, HEIGHT), atol=1e-12)
        means = [v.images.mean(axis=(1, 2)) for v in (whole, small)]
        np.testing.assert_allclose(means[1], means[0], atol=1.0)
    # A linear ramp stays one: the value at a place of the image is the same in both, so nothing has moved.
    ramp = np.tile(np.linspace(0, 255, WIDTH).round().astype(np.uint8)[None, :, None], (HEIGHT, 1, 3))
    for name in cameras().names:
        Image.fromarray(ramp).save(tmp_path / "images" / name)
    small = load_photos(tmp_path, downscale=2).views.images[0, 8, 4:-4, 0].astype(float)
    places = (np.arange(24) + 0.5) / 24 * WIDTH - 0.5
    np.testing.assert_allclose(small, (places * 255 / (WIDTH - 1))[4:-4], atol=1.0)


def test_images_shrunk_beforehand_get_their_intrinsics_and_a_word(tmp_path: Path) -> None:
    views = cameras()
    write_photos(tmp_path)
    large = Cameras(views.viewmats, views.Ks * [[3.0], [3.0], [1.0]], 3 * WIDTH, 3 * HEIGHT, views.names)
    for sizes in ([(3 * WIDTH, 3 * HEIGHT)] * 10, [(3 * WIDTH + i % 2, 3 * HEIGHT - i % 3) for i in range(10)]):
        write_mixed(tmp_path / "sparse" / "0", large, sizes)
        photos = load_photos(tmp_path)
        assert "1/3 of the size in the model" in photos.remarks[0]
        assert (photos.views.cameras.width, photos.views.cameras.height) == (WIDTH, HEIGHT)
        ratios = np.array([(WIDTH / w, HEIGHT / h, 1.0) for w, h in sizes])
        np.testing.assert_allclose(photos.views.cameras.Ks, large.Ks * ratios[:, :, None])


def test_images_lie_elsewhere(tmp_path: Path) -> None:
    write_photos(tmp_path)
    (tmp_path / "images").rename(tmp_path / "elsewhere")
    with pytest.raises(FormatError, match=r"expected the 10 images it names, got none of them in .*--images"):
        load_photos(tmp_path)
    for images in ("elsewhere", tmp_path / "elsewhere"):
        assert len(load_photos(tmp_path, images=images).views) == 10
    with pytest.raises(FileNotFoundError):
        load_photos(tmp_path, images="nowhere")


def test_orientation_in_exif_is_ignored_as_colmap_does(tmp_path: Path) -> None:
    write_photos(tmp_path)
    exif = Image.Exif()
    exif[0x0112] = 6  # to be turned by 90 degrees
    for name, picture in zip(cameras().names, pictures(), strict=True):
        Image.fromarray(picture).save(tmp_path / "images" / name, exif=exif)
    np.testing.assert_array_equal(load_photos(tmp_path).views.images, pictures())
    for name, picture in zip(cameras().names, pictures(width=HEIGHT, height=WIDTH), strict=True):
        Image.fromarray(picture).save(tmp_path / "images" / name)
    with pytest.raises(FormatError, match=r"got 32 x 48 in 10 of 10; .*EXIF orientation"):
        load_photos(tmp_path)


@pytest.mark.parametrize("mode", ["L", "P", "RGBA", "LA"])
def test_other_modes_become_rgb(tmp_path: Path, mode: str) -> None:
    write_photos(tmp_path)
    image = Image.fromarray(pictures()[3]).convert("L" if mode == "LA" else "RGB").convert(mode)
    if mode in ("RGBA", "LA"):
        image.putalpha(Image.new("L", image.size, 51))
    image.save(tmp_path / "images" / "photo_003.png")
    photos = load_photos(tmp_path)
    got = photos.views.images[3].astype(int)
    want = np.asarray(image.convert("RGB")).astype(int)
    if mode in ("RGBA", "LA"):
        assert "Transparency was blended over black in 1 of 10" in photos.remarks[0]
        np.testing.assert_allclose(got, want * 0.2, atol=1.0)
    else:
        np.testing.assert_array_equal(got, want)
        assert photos.remarks == ()


def test_sizes_that_differ_need_one_to_shrink_to(tmp_path: Path) -> None:
    write_photos(tmp_path)
    sizes = [(WIDTH, HEIGHT)] * 9 + [(40, 32)]
    write_mixed(tmp_path / "sparse" / "0", cameras(), sizes)
    Image.fromarray(pictures()[9, :, :40]).save(tmp_path / "images" / "photo_009.png")
    with pytest.raises(FormatError, match=r"2 sizes: 40 x 32, 48 x 32; .*--width 40 --height 32"):
        load_photos(tmp_path)
    photos = load_photos(tmp_path, size=(40, 32))
    assert len(photos.views) == 10
    np.testing.assert_allclose(photos.views.cameras.Ks[9], cameras().Ks[9])
    np.testing.assert_allclose(photos.views.cameras.Ks[0, 0, 0], cameras().Ks[0, 0, 0] * 40 / 48)


def test_what_is_missing_is_named_up_to_five(tmp_path: Path) -> None:
    write_photos(tmp_path)
    for i in range(7):
        (tmp_path / "images" / f"photo_{i:03d}.png").unlink()
        if i == 1:
            with pytest.raises(FormatError, match=r"got 2 of 10 missing: 'photo_000\.png', 'photo_001\.png'$"):
                load_photos(tmp_path)
    with pytest.raises(FormatError, match=r"got 7 of 10 missing: .*'photo_004\.png' and 2 more$"):
        load_photos(tmp_path)


def test_other_sizes_are_named(tmp_path: Path) -> None:
    write_photos(tmp_path)
    Image.fromarray(pictures(1, 50, 32)[0]).save(tmp_path / "images" / "photo_004.png")
    with pytest.raises(FormatError, match=r"images 'photo_004\.png': expected 48 x 32 as in the model, .*got 50 x 32"):
        load_photos(tmp_path)
    Image.fromarray(pictures(1, 24, 16)[0]).save(tmp_path / "images" / "photo_004.png")
    with pytest.raises(
        FormatError, match=r"images 'photo_004\.png'.* all images smaller by the same whole factor, got 24 x 16"
    ):
        load_photos(tmp_path)


def test_damaged_images_are_refused_by_name(tmp_path: Path) -> None:
    write_photos(tmp_path)
    file = tmp_path / "images" / "photo_004.png"
    whole = file.read_bytes()
    for length in (0, 5, 30, 100, len(whole) - 30):
        file.write_bytes(whole[:length])
        with pytest.raises(FormatError, match=r"photo_004\.png: expected an? "):
            load_photos(tmp_path)
    (tmp_path / "images" / "photo_005.png").write_bytes(whole[:100])
    file.write_bytes(whole[:100])
    with pytest.raises(
        FormatError, match=r"expected complete images, got 2 that cannot be read: 'photo_004.png', 'photo_005"
    ):
        load_photos(tmp_path)
    Image.fromarray(np.zeros((HEIGHT, WIDTH), np.uint16)).save(file)
    with pytest.raises(FormatError, match="expected gray or RGB with 8 bits a channel, got Pillow's mode I;16"):
        load_photos(tmp_path)


def test_headers_are_checked_before_pixels_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_photos(tmp_path)
    (tmp_path / "images" / "photo_009.png").write_bytes(b"no image")
    monkeypatch.setattr("gsvis.train.photos._shrunk", lambda path, size: pytest.fail("read a pixel"))
    with pytest.raises(FormatError, match=r"photo_009\.png: expected an image .*, got something else"):
        load_photos(tmp_path)


def test_models_that_cannot_serve(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        load_photos(tmp_path / "nowhere")
    with pytest.raises(
        FormatError, match=r"expected a COLMAP model .* or a transforms.json, got a folder without either"
    ):
        load_photos(tmp_path)
    (tmp_path / "few").mkdir()
    write_photos(tmp_path / "few", FEWEST_VIEWS - 1)
    with pytest.raises(SceneError, match="expected at least 8 posed images, got 7"):
        load_photos(tmp_path / "few")
    (tmp_path / "bent").mkdir()
    write_photos(tmp_path / "bent")
    for file in (tmp_path / "bent" / "sparse" / "0").iterdir():
        file.unlink()
    (tmp_path / "bent" / "sparse" / "0" / "cameras.txt").write_text("1 OPENCV 48 32 40 40 24 16 0.1 0 0 0\n")
    (tmp_path / "bent" / "sparse" / "0" / "images.txt").write_text("1 1 0 0 0 0 0 0 1 photo_000.png\n\n")
    message = "got OPENCV with distortion 0.1 0 0 0; undistort the images with `colmap image_undistorter`"
    with pytest.raises(FormatError, match=message):
        load_photos(tmp_path / "bent")


def test_names_that_leave_the_folder_are_not_followed(tmp_path: Path) -> None:
    write_transforms(tmp_path)
    file = tmp_path / "transforms.json"
    file.write_text(file.read_text().replace("./images/", "../../images/"))
    assert len(load_photos(tmp_path).views) == 10  # found by their names in `images`
    (tmp_path / "inner").mkdir()
    content = json.loads(file.read_text())
    (tmp_path / "inner" / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(FormatError, match="none of them in"):
        load_photos(tmp_path / "inner")


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"size": (24, 16), "downscale": 2}, "expected one of them"),
        ({"size": (24, 8)}, "size: height: expected an integer of at least 16"),
        ({"size": 24}, "expected \\(width, height\\)"),
        ({"size": (50, 32)}, "size: expected at most 48 x 32, got 50 x 32"),
        ({"downscale": 0.5}, "downscale: expected a factor of at least 1"),
        ({"downscale": float("nan")}, "downscale: expected a factor of at least 1"),
        ({"downscale": 4}, "expected images of at least 16 pixels a side, got 12 x 8"),
    ],
)
def test_sizes_out_of_range_are_refused(tmp_path: Path, asked: dict, message: str) -> None:
    write_photos(tmp_path)
    with pytest.raises(ValueError, match=message):
        load_photos(tmp_path, **asked)


def test_what_would_not_fit_into_memory_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_photos(tmp_path)
    monkeypatch.setattr("os.sysconf", lambda name: 1 if name == "SC_PAGE_SIZE" else 60_000)
    with pytest.raises(ValueError, match=r"fit into half of the memory .*--downscale, or --width and --height"):
        load_photos(tmp_path)
    assert len(load_photos(tmp_path, downscale=2).views) == 10


def test_progress_is_called_and_may_stop_the_work(tmp_path: Path) -> None:
    write_photos(tmp_path)
    lines = []
    load_photos(tmp_path, progress=lambda *words: lines.append(words))
    assert lines == [("photos", i, 10) for i in range(11)]

    def stop(stage: str, done: int, total: int) -> None:
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        load_photos(tmp_path, progress=stop)


@pytest.mark.realdata
@pytest.mark.slow
def test_bonsai_at_the_size_of_the_issue(realdata: Path) -> None:
    photos = load_photos(realdata / "photos" / "bonsai", size=(400, 266))
    assert repr(photos) == "Photos(PosedImages(292 of 400 x 266), 51,939 points)"
    train, test = photos.views.split()
    assert (len(train), len(test)) == (255, 37)
    np.testing.assert_allclose(photos.views.cameras.Ks[0, :2, 2], [200.0, 133.0])


def test_odd_images_are_read_or_refused_without_a_warning(tmp_path: Path) -> None:
    folder = write_photos(tmp_path, 8)
    path = folder / "images" / "photo_003.png"
    data = path.read_bytes()
    odd = b"acTL" + bytes(8)  # an animation of no pictures
    path.write_bytes(data[:33] + struct.pack(">I", 8) + odd + struct.pack(">I", zlib.crc32(odd)) + data[33:])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(load_photos(folder).views) == 8
        header = b"IHDR" + struct.pack(">II", 12_000, 9_000) + data[24:29]
        path.write_bytes(data[:12] + header + struct.pack(">I", zlib.crc32(header)) + data[33:])
        with pytest.raises(FormatError, match="exhaust memory"):
            load_photos(folder)


def test_photographs_that_are_too_small_are_at_fault_themselves(tmp_path: Path) -> None:
    write_transforms(tmp_path)
    content = json.loads((tmp_path / "transforms.json").read_text()) | {"w": 12, "h": 8}
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    for path in (tmp_path / "images").iterdir():
        Image.new("RGB", (12, 8)).save(path)
    with pytest.raises(FormatError, match="expected images of at least 16 pixels a side, got 12 x 8"):
        load_photos(tmp_path)


def test_a_chunk_that_claims_gigabytes_reserves_no_more_than_the_file_has(tmp_path: Path) -> None:
    write_photos(tmp_path, FEWEST_VIEWS)
    path = next(tmp_path.rglob("*.png"))
    data = path.read_bytes()
    at = data.index(b"IDAT") - 4
    path.write_bytes(data[:at] + struct.pack(">I", 1 << 31) + data[at + 4 :])
    tracemalloc.start()
    try:
        with suppress(FormatError):  # Pillow reads it, or says that it is cut
            load_photos(tmp_path)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 64 << 20

"""Image sizes and pixels, compared with arrays written by independent code."""

import os
import struct
import zlib

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from training.color import srgb_from_linear
from training.errors import LodgsError
from training.scenes.image_headers import exif_orientation, image_size
from training.scenes.images import load_image


def write_png(path, pixels: np.ndarray) -> None:
    """Write 8 or 16 bits and 1 to 4 channels as in the PNG specification; Pillow cannot write all of them."""
    height, width, channels = pixels.shape
    kind = {1: 0, 2: 4, 3: 2, 4: 6}[channels]
    rows = pixels.astype(pixels.dtype.newbyteorder(">")).reshape(height, -1)
    data = b"".join(b"\0" + row.tobytes() for row in rows)
    header = struct.pack(">IIBBBBB", width, height, 8 * pixels.itemsize, kind, 0, 0, 0)
    with path.open("wb") as file:
        file.write(b"\x89PNG\r\n\x1a\n")
        for name, body in ((b"IHDR", header), (b"IDAT", zlib.compress(data)), (b"IEND", b"")):
            file.write(struct.pack(">I", len(body)) + name + body)
            file.write(struct.pack(">I", zlib.crc32(name + body)))


def write_exr(path, channels, data_window=None, display_window=None) -> None:
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    if data_window:
        header |= {"dataWindow": data_window, "displayWindow": display_window}
    with OpenEXR.File(header, channels) as file:
        file.write(str(path))


@pytest.fixture
def pixels():
    return np.random.default_rng(0).integers(0, 256, (30, 44, 3)).astype(np.uint8)


def test_half_size_is_exact_box_average(tmp_path, pixels):
    write_png(tmp_path / "a.png", pixels)
    expected = pixels.reshape(15, 2, 22, 2, 3).astype(float).mean(axis=(1, 3)) / 255
    image = load_image(tmp_path / "a.png", 22, 15)
    assert image.dtype == np.float32 and image.shape == (15, 22, 3)
    np.testing.assert_allclose(image, expected, atol=1e-6)


@pytest.mark.parametrize("size", [(44, 30), (43, 29), (31, 17), (13, 7), (1, 1)])
def test_smaller_size_is_area_average(tmp_path, pixels, size):
    """Compare with the average on a grid that both sizes divide."""
    width, height = size
    write_png(tmp_path / "a.png", pixels)
    fine = np.repeat(np.repeat(pixels / 255, height, axis=0), width, axis=1)
    expected = fine.reshape(height, 30, width, 44, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(load_image(tmp_path / "a.png", width, height), expected, atol=1e-6)


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_png_channels(tmp_path, channels):
    """Grey becomes RGB, and alpha is ignored."""
    pixels = np.random.default_rng(1).integers(0, 256, (5, 7, channels)).astype(np.uint8)
    write_png(tmp_path / "a.png", pixels)
    color = pixels[..., :3] if channels > 2 else np.repeat(pixels[..., :1], 3, axis=2)
    assert image_size(tmp_path / "a.png") == (7, 5)
    np.testing.assert_allclose(load_image(tmp_path / "a.png", 7, 5), color / 255, atol=1e-6)


@pytest.mark.parametrize("channels", [1, 3])
def test_png_with_16_bits(tmp_path, channels):
    pixels = np.random.default_rng(1).integers(0, 65536, (5, 7, channels)).astype(np.uint16)
    write_png(tmp_path / "a.png", pixels)
    expected = np.broadcast_to(pixels / 65535, (5, 7, 3))
    np.testing.assert_allclose(load_image(tmp_path / "a.png", 7, 5), expected, atol=1 / 255)


@pytest.mark.parametrize(
    "options", [{}, {"progressive": True}, {"optimize": True}, {"exif": b"Exif\0\0" + bytes(999)}]
)
@pytest.mark.parametrize("mode", ["RGB", "L", "CMYK"])
def test_jpeg(tmp_path, mode, options):
    path = tmp_path / "a.jpeg"
    Image.new(mode, (41, 23), 0).save(path, **options)
    assert image_size(path) == (41, 23)
    assert load_image(path, 41, 23).shape == (23, 41, 3)


def test_jpeg_with_appended_data_is_complete(tmp_path):
    path = tmp_path / "a.jpg"
    Image.new("RGB", (41, 23)).save(path)
    path.write_bytes(path.read_bytes() + b"data appended by a phone" * 99)
    assert image_size(path) == (41, 23)


@pytest.mark.parametrize(
    ("mode", "options"),
    [
        ("RGB", {}),
        ("RGB", {"compression": "tiff_lzw"}),
        ("RGB", {"compression": "tiff_adobe_deflate"}),
        ("L", {}),
        ("RGBA", {}),
    ],
)
def test_tiff(tmp_path, pixels, mode, options):
    Image.fromarray(pixels).convert(mode).save(tmp_path / "a.tif", **options)
    assert image_size(tmp_path / "a.tif") == (44, 30)
    expected = np.asarray(Image.fromarray(pixels).convert("L").convert("RGB")) if mode == "L" else pixels
    np.testing.assert_allclose(load_image(tmp_path / "a.tif", 44, 30), expected / 255, atol=1e-6)


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("suffix", ["jpg", "tif"])
def test_orientation_is_not_applied(tmp_path, pixels, orientation, suffix):
    """COLMAP ignores the orientation, too."""
    for tag, name in ((1, "upright"), (orientation, "rotated")):
        exif = Image.Exif()
        exif[274] = tag
        Image.fromarray(pixels).save(tmp_path / f"{name}.{suffix}", exif=exif)
    upright, rotated = (tmp_path / f"{name}.{suffix}" for name in ("upright", "rotated"))
    assert image_size(rotated) == (44, 30)
    np.testing.assert_array_equal(load_image(rotated, 44, 30), load_image(upright, 44, 30))


@pytest.mark.parametrize("orientation", [1, 6])
def test_big_tiff(tmp_path, pixels, orientation):
    exif = Image.Exif()
    exif[274] = orientation
    Image.fromarray(pixels).save(tmp_path / "a.tif", big_tiff=True, exif=exif)
    assert (tmp_path / "a.tif").read_bytes()[2] == 43, "BigTIFF"
    assert image_size(tmp_path / "a.tif") == (44, 30)
    assert exif_orientation(tmp_path / "a.tif") == orientation
    np.testing.assert_array_equal(load_image(tmp_path / "a.tif", 44, 30), pixels / np.float32(255))


def test_tiff_with_grey_floats(tmp_path, pixels):
    grey = (pixels[..., 0] / 255).astype(np.float32)
    Image.fromarray(grey).save(tmp_path / "a.tif")
    np.testing.assert_array_equal(load_image(tmp_path / "a.tif", 44, 30), np.stack([grey] * 3, axis=-1))


def test_big_endian_tiff(tmp_path):
    """A hand-made TIFF 6.0 of 5x3 grey pixels in one strip, with a 32-bit width and a 16-bit height."""
    tags = [(256, 4, 5), (257, 3, 3 << 16), (258, 3, 8 << 16), (259, 3, 1 << 16), (262, 3, 1 << 16),
            (273, 4, 8), (277, 3, 1 << 16), (278, 3, 3 << 16), (279, 4, 15)]  # fmt: skip
    grey = bytes(range(0, 150, 10))
    data = b"MM\0*" + struct.pack(">I", 24) + grey + b"\0" + struct.pack(">H", len(tags))
    data += b"".join(struct.pack(">HHII", tag, kind, 1, value) for tag, kind, value in tags) + bytes(4)
    (tmp_path / "a.tif").write_bytes(data)
    assert image_size(tmp_path / "a.tif") == (5, 3)
    image = load_image(tmp_path / "a.tif", 5, 3)
    np.testing.assert_allclose(image[..., 1].ravel(), np.arange(0, 150, 10) / 255, atol=1e-6)


def test_16_bit_tiff_with_separate_channels_is_refused(tmp_path):
    """Pillow would read its bytes as pixels."""
    tags = [(256, 4, 1, 5), (257, 4, 1, 3), (258, 3, 3, 134), (259, 4, 1, 1), (262, 4, 1, 2),
            (273, 4, 3, 140), (277, 4, 1, 3), (278, 4, 1, 3), (279, 4, 3, 152), (284, 4, 1, 2)]  # fmt: skip
    data = b"II*\0" + struct.pack("<IH", 8, len(tags)) + b"".join(struct.pack("<HHII", *tag) for tag in tags)
    data += bytes(4) + struct.pack("<3H6I", 16, 16, 16, 164, 194, 224, 30, 30, 30) + bytes(90)
    (tmp_path / "a.tif").write_bytes(data)
    assert image_size(tmp_path / "a.tif") == (5, 3)
    with pytest.raises(LodgsError, match=r"16-bit colours are stored per channel"):
        load_image(tmp_path / "a.tif", 5, 3)


@pytest.mark.parametrize(
    ("mode", "options"),
    [("RGB", {"quality": 100}), ("RGB", {"lossless": True}), ("RGBA", {"lossless": True})],
)
def test_webp(tmp_path, pixels, mode, options):
    """Lossy, lossless and extended files store their size in different ways."""
    image = Image.fromarray(pixels).convert(mode)
    if mode == "RGBA":
        image.putalpha(120)
    image.save(tmp_path / "a.webp", **options)
    assert image_size(tmp_path / "a.webp") == (44, 30)
    error = np.abs(load_image(tmp_path / "a.webp", 44, 30) - pixels / 255)
    assert error.max() <= 1e-6 if "lossless" in options else error.mean() < 0.2


def test_bmp(tmp_path, pixels):
    """COLMAP and Pillow read such photos of industrial cameras."""
    path = tmp_path / "a.bmp"
    Image.fromarray(pixels).save(path)
    assert image_size(path) == (44, 30)
    np.testing.assert_allclose(load_image(path, 44, 30), pixels / 255, atol=1e-6)
    data = bytearray(path.read_bytes())
    data[22:26] = struct.pack("<i", -30)
    path.write_bytes(data)
    assert image_size(path) == (44, 30)
    np.testing.assert_allclose(load_image(path, 44, 30), pixels[::-1] / 255, atol=1e-6)


@pytest.mark.parametrize("share", [0.02, 0.3, 0.5, 0.9, 0.999])
@pytest.mark.parametrize("kind", ["jpg", "png", "webp"])
def test_truncated_file_is_rejected(tmp_path, pixels, kind, share):
    path = tmp_path / f"a.{kind}"
    if kind == "png":
        write_png(path, pixels)
    else:
        # A thumbnail in the header is a complete JPEG with an end marker.
        Image.fromarray(pixels).save(path, exif=b"Exif\0\0\xff\xd8\xff\xd9")
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * share)])
    with pytest.raises(LodgsError, match=r"truncated|not a JPEG") as error:
        image_size(path)
    assert str(path) in error.value.what


def test_other_formats_are_rejected(tmp_path):
    for name, data in {"empty": b"", "text": b"not an image", "gif": b"GIF89a" + bytes(20)}.items():
        (tmp_path / name).write_bytes(data)
        with pytest.raises(LodgsError, match=name):
            image_size(tmp_path / name)
        with pytest.raises(LodgsError, match=name):
            load_image(tmp_path / name, 2, 2)
    with pytest.raises(LodgsError, match="absent"):
        image_size(tmp_path / "absent")


def test_sizes_of_real_photos_match_pillow(shared_scenes):
    paths = sorted(shared_scenes.glob("*/images/*"))[::5]
    assert paths
    for path in paths:
        with Image.open(path) as image:
            assert image_size(path) == image.size


@pytest.mark.parametrize("names", [("R", "G", "B"), ("V.Combined.R", "V.Combined.G", "V.Combined.B"), ("Y",)])
@pytest.mark.parametrize("kind", [np.float32, np.float16])
def test_exr_is_linear_with_exposure(tmp_path, names, kind):
    """Averaging and exposure apply to linear light; alpha and other passes are ignored."""
    random = np.random.default_rng(2)
    channels = {name: random.uniform(0, 1.2, (8, 10)).astype(kind) for name in names}
    color = np.stack([channels[names[i % len(names)]] for i in range(3)], axis=2).astype(float)
    write_exr(
        tmp_path / "a.exr", {**channels, "A": np.zeros((8, 10), kind), "Depth.Z": np.ones((8, 10), kind)}
    )
    assert image_size(tmp_path / "a.exr") == (10, 8)
    half = color.reshape(4, 2, 5, 2, 3).mean(axis=(1, 3))
    for stops in (0.0, 1.0, -2.5):
        image = load_image(tmp_path / "a.exr", 5, 4, exposure=stops)
        np.testing.assert_allclose(image, srgb_from_linear((half * 2.0**stops).clip(0, 1)), atol=1e-5)


@pytest.mark.parametrize("share", [0.01, 0.03, 0.2, 0.5, 0.95, 0.999])
@pytest.mark.parametrize("compression", ["NO", "ZIPS", "ZIP", "PIZ", "DWAB"])
def test_truncated_exr_is_rejected(tmp_path, capfd, compression, share):
    """It is rejected before OpenEXR reads it, which would print to the standard output."""
    path = tmp_path / "a.exr"
    noise = np.random.default_rng(2).uniform(0, 1, (70, 64)).astype(np.float32)
    header = {"compression": getattr(OpenEXR, f"{compression}_COMPRESSION"), "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"R": noise, "G": noise, "B": noise}) as file:
        file.write(str(path))
    assert image_size(path) == (64, 70)
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * share)])
    for read in (image_size, lambda path: load_image(path, 64, 70)):
        with pytest.raises(LodgsError, match="truncated") as error:
            read(path)
        assert str(path) in error.value.what
    assert capfd.readouterr().out == ""


@pytest.mark.parametrize("kind", ["tiledimage", "parts"])
def test_exr_layouts(tmp_path, kind):
    path = tmp_path / "a.exr"
    light = np.random.default_rng(2).uniform(0, 1, (70, 64)).astype(np.float32)
    channels = {"R": light, "G": light, "B": light}
    if kind == "parts":
        depth = OpenEXR.Part({"type": OpenEXR.scanlineimage}, {"Z": light}, "depth")
        color = OpenEXR.Part({"type": OpenEXR.scanlineimage}, channels, "color")
        OpenEXR.File([depth, color]).write(str(path))
    else:
        tiles = OpenEXR.TileDescription()
        tiles.xSize = tiles.ySize = 32
        OpenEXR.File({"type": OpenEXR.tiledimage, "tiles": tiles}, channels).write(str(path))
    assert image_size(path) == (64, 70)
    np.testing.assert_allclose(
        load_image(path, 64, 70)[..., 1], srgb_from_linear(light.clip(0, 1)), atol=1e-5
    )


def test_exr_without_color(tmp_path):
    write_exr(tmp_path / "a.exr", {"Depth.Z": np.ones((8, 10), np.float32)})
    with pytest.raises(LodgsError, match="R, G and B"):
        load_image(tmp_path / "a.exr", 10, 8)


def test_exr_crop_and_overscan(tmp_path):
    """The image is the display window: data outside is dropped, and missing data is black."""
    data = np.ones((4, 5), np.float32)
    window = (np.array([-2, 3], np.int32), np.array([2, 6], np.int32))
    display = (np.array([0, 0], np.int32), np.array([9, 7], np.int32))
    write_exr(tmp_path / "a.exr", {"R": data, "G": data, "B": data}, window, display)
    expected = np.zeros((8, 10, 3))
    expected[3:7, 0:3] = 1
    assert image_size(tmp_path / "a.exr") == (10, 8)
    np.testing.assert_allclose(load_image(tmp_path / "a.exr", 10, 8), expected, atol=1e-6)


def test_damaged_pixels_are_reported(tmp_path, pixels):
    path = tmp_path / "a.jpg"
    Image.fromarray(pixels).save(path)
    path.write_bytes(path.read_bytes()[: os.path.getsize(path) // 2])
    with pytest.raises(LodgsError, match="as an image") as error:
        load_image(path, 10, 10)
    assert str(path) in error.value.what and error.value.remedy

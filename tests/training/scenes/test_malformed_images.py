"""Malformed and huge images: limited memory, and no exceptions other than LodgsError."""

import os
import struct
import tracemalloc
import zlib

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from training.errors import LodgsError
from training.scenes import exr, images
from training.scenes.image_headers import image_size
from training.scenes.images import check_image, load_image


def write_flat_png(path, width: int, height: int, rows: int | None = None) -> None:
    """Write a tiny file of one grey value, with ``rows`` rows regardless of the header's height."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    grey = zlib.compress((b"\0" + bytes([128]) * width) * (height if rows is None else rows))
    body = chunk(b"IHDR", header) + chunk(b"IDAT", grey) + chunk(b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + body)


def write_exr(path, size=(8, 6), **windows) -> None:
    light = np.ones(size[::-1], np.float32)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header | windows, {"R": light, "G": light, "B": light}) as file:
        file.write(str(path))


def window(left: int, top: int, right: int, bottom: int):
    return np.array([left, top], np.int32), np.array([right, bottom], np.int32)


@pytest.mark.parametrize("size", [(999, 777), (150, 3000)])
def test_memory_of_large_images_is_limited(tmp_path, size):
    """Arrays of float32 values and sums for 24 million pixels would take more than a gigabyte."""
    write_flat_png(tmp_path / "a.png", 4000, 6000)
    load_image(tmp_path / "a.png", 1, 1)  # imports
    tracemalloc.start()
    image = load_image(tmp_path / "a.png", *size)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    np.testing.assert_allclose(image, 128 / 255, atol=1e-6)
    assert peak < 200e6


@pytest.mark.parametrize("size", [(44, 30), (22, 15), (43, 29), (13, 7), (60, 50), (1, 1)])
def test_strips_do_not_change_the_result(tmp_path, monkeypatch, size):
    """Results are bit-identical."""
    pixels = np.random.default_rng(0).integers(0, 256, (30, 44, 3)).astype(np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    write_exr(
        tmp_path / "a.exr", (44, 30), dataWindow=window(3, 2, 46, 31), displayWindow=window(0, 0, 49, 39)
    )
    for name in ("a.png", "a.exr"):
        expected = load_image(tmp_path / name, *size)
        with monkeypatch.context() as patched:
            patched.setattr(images, "_STRIP", 100)
            np.testing.assert_array_equal(load_image(tmp_path / name, *size), expected)


def test_large_jpegs_are_reduced_while_decoding(tmp_path, monkeypatch):
    """The reduced image is at least twice as large as requested, and looks the same."""
    red, green = np.meshgrid(np.linspace(20, 220, 640), np.linspace(40, 200, 480))
    pixels = np.stack([red, green, 255 - red], 2).astype(np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.jpg", quality=95)
    expected = load_image(tmp_path / "a.jpg", 32, 24)
    monkeypatch.setattr(images, "_LARGE", 100)
    decoded, pillow_rows = [], images._pillow_rows

    def rows(image, *arguments):
        decoded.append(image.size)
        return pillow_rows(image, *arguments)

    monkeypatch.setattr(images, "_pillow_rows", rows)
    eighth, quarter, full = (80, 60), (160, 120), (640, 480)
    for requested, size in (((32, 24), eighth), ((40, 30), eighth), ((41, 30), quarter), ((400, 300), full)):
        load_image(tmp_path / "a.jpg", *requested)
        assert decoded.pop() == size
    np.testing.assert_allclose(load_image(tmp_path / "a.jpg", 32, 24), expected, atol=0.01)


def test_excessive_sizes_are_rejected_before_decoding(tmp_path):
    """Decoding 65535x65535 pixels of a JPEG would take 9 GB."""
    Image.new("RGB", (64, 48)).save(tmp_path / "a.jpg")
    data = bytearray((tmp_path / "a.jpg").read_bytes())
    offset = data.index(b"\xff\xc0")
    data[offset + 5 : offset + 9] = struct.pack(">HH", 65535, 65535)
    (tmp_path / "a.jpg").write_bytes(data)
    write_flat_png(tmp_path / "a.png", 60000, 60000, rows=1)
    write_exr(tmp_path / "a.exr", displayWindow=window(0, 0, 99_999, 99_999), dataWindow=window(0, 0, 7, 5))
    for name in ("a.jpg", "a.png", "a.exr"):
        with pytest.raises(LodgsError, match="exceed the limit of 178,956,970"):
            image_size(tmp_path / name)
        with pytest.raises(LodgsError, match=f"{name}.*exceeds? (the )?limit"):
            load_image(tmp_path / name, 64, 48)


def test_memory_of_exr_passes_is_limited(tmp_path, monkeypatch):
    write_exr(tmp_path / "a.exr")
    assert image_size(tmp_path / "a.exr") == (8, 6)
    monkeypatch.setattr(exr, "MAX_BYTES", 4 * 3 * 8 * 6)
    assert load_image(tmp_path / "a.exr", 8, 6).shape == (6, 8, 3)
    monkeypatch.setattr(exr, "MAX_BYTES", 4 * 3 * 8 * 6 - 1)
    with pytest.raises(LodgsError, match="GiB of pixels"):
        load_image(tmp_path / "a.exr", 8, 6)


def test_exr_header_cannot_cause_huge_allocations(tmp_path):
    """The header claims an attribute of 4 GB, or a chunk table of 16 GB."""
    write_exr(tmp_path / "a.exr")
    content = (tmp_path / "a.exr").read_bytes()
    offset = content.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0")
    tracemalloc.start()
    for damaged in (
        content[:offset] + struct.pack("<I", 0xFFFFFFF0) + content[offset + 4 :],
        content[: offset + 16] + struct.pack("<i", 0x7FFFFFFF) + content[offset + 20 :],
        content[: offset + 8] + struct.pack("<i", -0x7FFFFFFF) + content[offset + 12 :],
    ):
        (tmp_path / "a.exr").write_bytes(damaged)
        with pytest.raises(LodgsError):
            load_image(tmp_path / "a.exr", 8, 6)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 20e6


@pytest.mark.parametrize("read", [image_size, check_image, lambda path: load_image(path, 4, 4)])
def test_files_that_are_not_images_are_rejected(tmp_path, read):
    os.mkfifo(tmp_path / "fifo")
    Image.new("RGB", (8, 8)).save(tmp_path / "a.gif")
    (tmp_path / "folder").mkdir()
    for name in ("fifo", "a.gif", "folder", "absent", "/dev/zero"):
        with pytest.raises(LodgsError, match=name):
            read(tmp_path / name)


def test_check_image_detects_damaged_pixels(tmp_path):
    """Each format is tested with an intact file and with damaged pixels after an intact header."""
    noise = np.random.default_rng(0).integers(0, 256, (80, 80, 3)).astype(np.uint8)
    for name in ("a.png", "a.jpg"):
        Image.fromarray(noise).save(tmp_path / name)
    light = (noise / np.float32(255)).astype(np.float32)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"R": light[..., 0], "G": light[..., 1], "B": light[..., 2]}) as file:
        file.write(str(tmp_path / "a.exr"))
    for name in ("a.png", "a.jpg", "a.exr"):
        path = tmp_path / name
        size = image_size(path)
        check_image(path)
        data = path.read_bytes()
        if name == "a.jpg":  # without its Huffman tables
            offset = data.index(b"\xff\xc4")
            damaged = data[: offset + 5] + bytes([255]) * 16 + data[offset + 21 :]
        else:
            half = len(data) // 2
            damaged = data[:half] + bytes(200) + data[half + 200 :]
        path.write_bytes(damaged)
        assert image_size(path) == size
        with pytest.raises(LodgsError, match="as an image"):
            check_image(path)

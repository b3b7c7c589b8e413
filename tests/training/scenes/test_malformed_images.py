"""Photographs as strangers make them: any size in little memory, and nothing that is no photograph."""

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
from training.scenes.images import check_image, image_size, load_image


def write_flat_png(path, width: int, height: int, rows: int | None = None) -> None:
    """Grey, one value: next to no bytes. Of so many rows, whatever the header says."""

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


@pytest.mark.parametrize("size", [(1000, 500), (999, 777), (400, 300), (150, 3000)])
def test_large_images_take_little_more_than_their_decoding(tmp_path, size):
    """24 million pixels; as arrays of float32 and of sums they took a gigabyte and more."""
    write_flat_png(tmp_path / "a.png", 4000, 6000)
    load_image(tmp_path / "a.png", 1, 1)  # imports
    tracemalloc.start()
    image = load_image(tmp_path / "a.png", *size)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    np.testing.assert_allclose(image, 128 / 255, atol=1e-6)
    assert most < 200e6


@pytest.mark.parametrize("size", [(44, 30), (22, 15), (43, 29), (13, 7), (60, 50), (1, 1)])
def test_strips_change_nothing(tmp_path, monkeypatch, size):
    """To the bit: what was trained yesterday is trained today."""
    pixels = np.random.default_rng(0).integers(0, 256, (30, 44, 3)).astype(np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    write_exr(
        tmp_path / "a.exr", (44, 30), dataWindow=window(3, 2, 46, 31), displayWindow=window(0, 0, 49, 39)
    )
    for name in ("a.png", "a.exr"):
        whole = load_image(tmp_path / name, *size)
        with monkeypatch.context() as patched:
            patched.setattr(images, "_STRIP", 100)
            np.testing.assert_array_equal(load_image(tmp_path / name, *size), whole)


def test_large_jpegs_are_decoded_no_larger_than_needed(tmp_path, monkeypatch):
    """At an eighth, where that is still twice what is wanted; it looks the same."""
    across, down = np.meshgrid(np.linspace(20, 220, 640), np.linspace(40, 200, 480))
    pixels = np.stack([across, down, 255 - across], 2).astype(np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.jpg", quality=95)
    whole = load_image(tmp_path / "a.jpg", 32, 24)
    monkeypatch.setattr(images, "_LARGE", 100)
    decoded, pillow_rows = [], images._pillow_rows

    def rows(image, *at):
        decoded.append(image.size)
        return pillow_rows(image, *at)

    monkeypatch.setattr(images, "_pillow_rows", rows)
    eighth, quarter, full = (80, 60), (160, 120), (640, 480)
    for wanted, size in (((32, 24), eighth), ((40, 30), eighth), ((41, 30), quarter), ((400, 300), full)):
        load_image(tmp_path / "a.jpg", *wanted)
        assert decoded.pop() == size
    np.testing.assert_allclose(load_image(tmp_path / "a.jpg", 32, 24), whole, atol=0.01)


def test_more_pixels_than_are_read_are_refused_by_the_header(tmp_path):
    """Before anything is decoded: 65535x65535 in a JPEG took 9 GB, a PNG of 60000x60000 ended the run."""
    Image.new("RGB", (64, 48)).save(tmp_path / "a.jpg")
    data = bytearray((tmp_path / "a.jpg").read_bytes())
    at = data.index(b"\xff\xc0")
    data[at + 5 : at + 9] = struct.pack(">HH", 65535, 65535)
    (tmp_path / "a.jpg").write_bytes(data)
    write_flat_png(tmp_path / "a.png", 60000, 60000, rows=1)
    write_exr(tmp_path / "a.exr", displayWindow=window(0, 0, 99_999, 99_999), dataWindow=window(0, 0, 7, 5))
    for name in ("a.jpg", "a.png", "a.exr"):
        with pytest.raises(LodgsError, match="pixels; 178,956,970 are read at most"):
            image_size(tmp_path / name)
        with pytest.raises(LodgsError, match=f"{name}.*(read at most|exceeds limit)"):
            load_image(tmp_path / name, 64, 48)


def test_passes_of_an_exr_have_a_most_together(tmp_path, monkeypatch):
    write_exr(tmp_path / "a.exr")
    assert image_size(tmp_path / "a.exr") == (8, 6)
    monkeypatch.setattr(exr, "MAX_BYTES", 4 * 3 * 8 * 6)
    assert load_image(tmp_path / "a.exr", 8, 6).shape == (6, 8, 3)
    monkeypatch.setattr(exr, "MAX_BYTES", 4 * 3 * 8 * 6 - 1)
    with pytest.raises(LodgsError, match="GiB of pixels"):
        load_image(tmp_path / "a.exr", 8, 6)


def test_an_exr_whose_header_promises_much(tmp_path):
    """An attribute of 4 GB, a table of chunks of 16 GB: nothing of the kind is asked of the memory."""
    write_exr(tmp_path / "a.exr")
    whole = (tmp_path / "a.exr").read_bytes()
    at = whole.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0")
    tracemalloc.start()
    for damaged in (
        whole[:at] + struct.pack("<I", 0xFFFFFFF0) + whole[at + 4 :],
        whole[: at + 16] + struct.pack("<i", 0x7FFFFFFF) + whole[at + 20 :],
        whole[: at + 8] + struct.pack("<i", -0x7FFFFFFF) + whole[at + 12 :],
    ):
        (tmp_path / "a.exr").write_bytes(damaged)
        with pytest.raises(LodgsError):
            load_image(tmp_path / "a.exr", 8, 6)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 20e6


@pytest.mark.parametrize("read", [image_size, check_image, lambda path: load_image(path, 4, 4)])
def test_what_is_no_photograph(tmp_path, read):
    os.mkfifo(tmp_path / "fifo")
    Image.new("RGB", (8, 8)).save(tmp_path / "a.gif")
    (tmp_path / "folder").mkdir()
    for name in ("fifo", "a.gif", "folder", "absent", "/dev/zero"):
        with pytest.raises(LodgsError, match=name):
            read(tmp_path / name)


def test_pixels_are_tried_without_a_size(tmp_path):
    """A header that is right is not enough: of each kind one that is whole, and one with torn pixels."""
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
            at = data.index(b"\xff\xc4")
            torn = data[: at + 5] + bytes([255]) * 16 + data[at + 21 :]
        else:
            half = len(data) // 2
            torn = data[:half] + bytes(200) + data[half + 200 :]
        path.write_bytes(torn)
        assert image_size(path) == size
        with pytest.raises(LodgsError, match="cannot be read as an image"):
            check_image(path)

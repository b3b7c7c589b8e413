"""Image files, linear colours and depth passes."""

import tracemalloc

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from training.errors import LodgsError
from training.render.image import NO_DEPTH, RenderedImage, read_depth, write_image


def rendered(image, alpha=None, **passes) -> RenderedImage:
    alpha = np.ones(image.shape[:2], np.float32) if alpha is None else alpha
    empty = {"depth": np.zeros((0, 0), np.float32), "levels": [], "masks": np.zeros((0, *alpha.shape))}
    return RenderedImage(image.astype(np.float32), alpha, **(empty | passes))


def encode_srgb(linear: np.ndarray) -> np.ndarray:
    """Apply the sRGB transfer function from its definition."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def test_linear_colours_encode_to_the_same_bytes():
    """Tests random values and rounding thresholds, with arithmetic errors of 1e-5."""
    thresholds = (np.arange(255) + 0.5) / 255
    values = np.concatenate([np.random.default_rng(0).uniform(0, 1, 2001), thresholds, thresholds - 1e-9])
    image = rendered(np.repeat(values[None, :, None], 3, 2))
    linear = image.linear()
    for error in (-1e-5, 0, 1e-5):
        codes = np.floor((encode_srgb(linear[..., :3].astype(float)) + error).clip(0, 1) * 255 + 0.5)
        np.testing.assert_array_equal(codes, image.eight_bit())
    assert np.abs(encode_srgb(linear[0, :, 0].astype(float)) - values).max() < 0.03 / 255


def test_strips_do_not_change_the_result(monkeypatch):
    rng = np.random.default_rng(5)
    alpha = rng.uniform(0, 1, (31, 17)).astype(np.float32)
    image = rendered(rng.uniform(0, 1, (31, 17, 3)) * alpha[..., None], alpha)
    expected = image.eight_bit(), image.linear()
    monkeypatch.setattr("training.render.image._STRIP_PIXELS", 50)
    for actual, planes in zip((image.eight_bit(), image.linear()), expected, strict=True):
        assert actual.dtype == planes.dtype
        np.testing.assert_array_equal(actual, planes)


def test_large_images_are_encoded_in_little_memory():
    image = rendered(np.full((2000, 2000, 3), 0.5, np.float32))
    tracemalloc.start()
    image.eight_bit(), image.linear()
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 4e6 * (4 + 16) + 300e6


def test_straight_colours_are_decoded():
    alpha = np.full((1, 2), 0.5, np.float32)
    image = rendered(np.array([[[0.25, 0.1, 0], [0.5, 0.5, 0.5]]]), alpha)
    linear = image.linear()
    assert encode_srgb(linear[0, 0, 0] / linear[0, 0, 3]) == pytest.approx(0.5, abs=1e-4)
    assert linear[0, 1] == pytest.approx((0.5, 0.5, 0.5, 0.5), abs=0.03 / 255)
    assert image.eight_bit()[0, 0].tolist() == [128, 51, 0, 128]


def test_pillow_reads_the_png(tmp_path):
    rng = np.random.default_rng(1)
    for alpha in (None, rng.uniform(0.2, 1, (7, 5)).astype(np.float32)):
        colors = rng.uniform(0, 1, (7, 5, 3)) * (1 if alpha is None else alpha[..., None])
        image = rendered(colors, alpha)
        write_image(tmp_path / "a.png", image)
        with Image.open(tmp_path / "a.png") as file:
            assert file.mode == ("RGB" if alpha is None else "RGBA")
            np.testing.assert_array_equal(np.asarray(file), image.eight_bit())


def test_exr_has_every_pass(tmp_path):
    rng = np.random.default_rng(2)
    masks = rng.uniform(size=(2, 6, 4)).astype(np.float32)
    masks[:, 0, 0] = 0
    depth = rng.uniform(1, 9, (6, 4)).astype(np.float32)
    image = rendered(rng.uniform(size=(6, 4, 3)), depth=depth, levels=[2, 5], masks=masks)
    write_image(tmp_path / "a.exr", image)
    with OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True) as file:
        planes = {name: channel.pixels for name, channel in file.channels().items()}
    np.testing.assert_array_equal(planes["LODGS.Depth.Z"], depth)
    np.testing.assert_array_equal(planes["LODGS.Combined.G"], image.linear()[..., 1])
    np.testing.assert_array_equal(planes["LODGS.Level 5.X"], masks[1])
    assert planes["LODGS.Level.X"][0, 0] == 0
    assert set(np.unique(planes["LODGS.Level.X"])) == {0, 2, 5}


def write_exr(path, *parts):
    """Write parts, each given as a name and planes by channel."""
    header = {"type": OpenEXR.scanlineimage}
    exr_parts = [OpenEXR.Part(header | {"name": name}, planes) for name, planes in parts]
    OpenEXR.File(exr_parts).write(str(path))
    return path


@pytest.mark.parametrize(
    "parts",
    [
        lambda z, zeros: [("", {"ViewLayer.Depth.Z": z, "ViewLayer.Normal.Z": zeros})],
        lambda z, zeros: [("", {"Depth.V": z, "ViewLayer.Combined.Z": zeros})],
        lambda z, zeros: [("", {"Z": z, "R": zeros})],
        lambda z, zeros: [("", {"A.Depth.Z": z, "B.Depth.Z": z + 1})],
        lambda z, zeros: [("ViewLayer.Normal", {"Z": zeros}), ("ViewLayer.Depth", {"Z": z})],
        lambda z, zeros: [("a", {"L.Normal.Z": zeros}), ("b", {"L.Depth.Z": z})],
    ],
)
def test_depth_is_found_by_its_channel(tmp_path, parts):
    z = np.random.default_rng(3).uniform(1, 9, (6, 4)).astype(np.float32)
    path = write_exr(tmp_path / "a.exr", *parts(z, np.zeros_like(z)))
    np.testing.assert_array_equal(read_depth(path, 4, 6, None), z)
    np.testing.assert_array_equal(read_depth(path, 4, 6, (1, 2, 3, 4)), z[2:6, 1:4])
    np.testing.assert_array_equal(read_depth(path, 40, 60, (7, 8, 4, 6)), z)  # size of the window


def test_half_float_infinity_means_no_depth(tmp_path):
    path = write_exr(tmp_path / "a.exr", ("", {"Depth.Z": np.float16([[2, np.inf, np.nan]])}))
    np.testing.assert_array_equal(read_depth(path, 3, 1, None), np.float32([[2, NO_DEPTH, NO_DEPTH]]))


def test_invalid_depths_raise_one_sentence(tmp_path):
    plane = np.ones((6, 4), np.float32)
    (tmp_path / "text.exr").write_text("no image")
    for path, sentence in (
        (tmp_path / "gone.exr", "gone.exr: it does not exist"),
        (tmp_path / "text.exr", "Cannot read text.exr as an EXR"),
        (
            write_exr(tmp_path / "rgb.exr", ("", {"L.Combined.R": plane, "L.Normal.Z": plane})),
            "no Depth pass",
        ),
        (
            write_exr(tmp_path / "small.exr", ("", {"Z": plane})),
            "size is 4x6 pixels, that of the image 40x60",
        ),
    ):
        with pytest.raises(LodgsError, match=sentence):
            read_depth(path, 40, 60, (0, 0, 30, 30))


def test_unsupported_suffixes_are_refused(tmp_path):
    with pytest.raises(LodgsError, match="unsupported image format"):
        write_image(tmp_path / "a.jpg", rendered(np.zeros((2, 2, 3))))
    assert list(tmp_path.iterdir()) == []

"""Pictures as files, and in linear light."""

import tracemalloc

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from training.errors import LodgsError
from training.render.image import NO_DEPTH, RenderedImage, read_depth, write_image


def picture(image, alpha=None, **passes) -> RenderedImage:
    alpha = np.ones(image.shape[:2], np.float32) if alpha is None else alpha
    empty = {"depth": np.zeros((0, 0), np.float32), "levels": [], "masks": np.zeros((0, *alpha.shape))}
    return RenderedImage(image.astype(np.float32), alpha, **(empty | passes))


def coded(linear: np.ndarray) -> np.ndarray:
    """The sRGB transfer function, by its own definition rather than as the inverse of ours."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def test_linear_colours_become_the_same_bytes_whoever_codes_them():
    """Everywhere, and just where rounding turns over; by arithmetic that is off by 1e-5 to either side."""
    borders = (np.arange(255) + 0.5) / 255
    values = np.concatenate([np.random.default_rng(0).uniform(0, 1, 2001), borders, borders - 1e-9])
    shown = picture(np.repeat(values[None, :, None], 3, 2))
    linear = shown.linear()
    for wrong in (-1e-5, 0, 1e-5):
        again = np.floor((coded(linear[..., :3].astype(float)) + wrong).clip(0, 1) * 255 + 0.5)
        np.testing.assert_array_equal(again, shown.eight_bit())
    assert np.abs(coded(linear[0, :, 0].astype(float)) - values).max() < 0.03 / 255


def test_strips_change_nothing(monkeypatch):
    rng = np.random.default_rng(5)
    alpha = rng.uniform(0, 1, (31, 17)).astype(np.float32)
    shown = picture(rng.uniform(0, 1, (31, 17, 3)) * alpha[..., None], alpha)
    whole = shown.eight_bit(), shown.linear()
    monkeypatch.setattr("training.render.image._STRIP", 50)
    for now, before in zip((shown.eight_bit(), shown.linear()), whole, strict=True):
        assert now.dtype == before.dtype
        np.testing.assert_array_equal(now, before)


def test_large_pictures_are_coded_in_little_memory():
    shown = picture(np.full((2000, 2000, 3), 0.5, np.float32))
    tracemalloc.start()
    shown.eight_bit(), shown.linear()
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 4e6 * (4 + 16) + 300e6


def test_colours_are_decoded_under_their_alpha():
    alpha = np.full((1, 2), 0.5, np.float32)
    shown = picture(np.array([[[0.25, 0.1, 0], [0.5, 0.5, 0.5]]]), alpha)
    linear = shown.linear()
    assert coded(linear[0, 0, 0] / linear[0, 0, 3]) == pytest.approx(0.5, abs=1e-4)
    assert linear[0, 1] == pytest.approx((0.5, 0.5, 0.5, 0.5), abs=0.03 / 255)
    assert shown.eight_bit()[0, 0].tolist() == [128, 51, 0, 128]


def test_a_png_is_what_pillow_reads(tmp_path):
    rng = np.random.default_rng(1)
    for alpha in (None, rng.uniform(0.2, 1, (7, 5)).astype(np.float32)):
        image = rng.uniform(0, 1, (7, 5, 3)) * (1 if alpha is None else alpha[..., None])
        shown = picture(image, alpha)
        write_image(tmp_path / "a.png", shown)
        with Image.open(tmp_path / "a.png") as file:
            assert file.mode == ("RGB" if alpha is None else "RGBA")
            np.testing.assert_array_equal(np.asarray(file), shown.eight_bit())


def test_an_exr_has_every_pass(tmp_path):
    rng = np.random.default_rng(2)
    masks = rng.uniform(size=(2, 6, 4)).astype(np.float32)
    masks[:, 0, 0] = 0
    depth = rng.uniform(1, 9, (6, 4)).astype(np.float32)
    shown = picture(rng.uniform(size=(6, 4, 3)), depth=depth, levels=[2, 5], masks=masks)
    write_image(tmp_path / "a.exr", shown)
    with OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True) as file:
        planes = {name: channel.pixels for name, channel in file.channels().items()}
    np.testing.assert_array_equal(planes["LODGS.Depth.Z"], depth)
    np.testing.assert_array_equal(planes["LODGS.Combined.G"], shown.linear()[..., 1])
    np.testing.assert_array_equal(planes["LODGS.Level 5.X"], masks[1])
    assert planes["LODGS.Level.X"][0, 0] == 0
    assert set(np.unique(planes["LODGS.Level.X"])) == {0, 2, 5}


def write_exr(path, *parts):
    """Parts: a name and the planes by channel of each."""
    header = {"type": OpenEXR.scanlineimage}
    made = [OpenEXR.Part(header | {"name": name}, planes) for name, planes in parts]
    OpenEXR.File(made).write(str(path))
    return path


@pytest.mark.parametrize(
    "parts",
    [
        lambda z, other: [("", {"ViewLayer.Depth.Z": z, "ViewLayer.Normal.Z": other})],
        lambda z, other: [("", {"Depth.V": z, "ViewLayer.Combined.Z": other})],
        lambda z, other: [("", {"Z": z, "R": other})],
        lambda z, other: [("", {"A.Depth.Z": z, "B.Depth.Z": z + 1})],
        lambda z, other: [("ViewLayer.Normal", {"Z": other}), ("ViewLayer.Depth", {"Z": z})],
        lambda z, other: [("a", {"L.Normal.Z": other}), ("b", {"L.Depth.Z": z})],
    ],
)
def test_a_depth_is_found_by_its_channel(tmp_path, parts):
    z = np.random.default_rng(3).uniform(1, 9, (6, 4)).astype(np.float32)
    path = write_exr(tmp_path / "a.exr", *parts(z, np.zeros_like(z)))
    np.testing.assert_array_equal(read_depth(path, 4, 6, None), z)
    np.testing.assert_array_equal(read_depth(path, 4, 6, (1, 2, 3, 4)), z[2:6, 1:4])
    np.testing.assert_array_equal(read_depth(path, 40, 60, (7, 8, 4, 6)), z)  # of the window alone


def test_halfs_have_nothing_as_infinity(tmp_path):
    path = write_exr(tmp_path / "a.exr", ("", {"Depth.Z": np.float16([[2, np.inf, np.nan]])}))
    np.testing.assert_array_equal(read_depth(path, 3, 1, None), np.float32([[2, NO_DEPTH, NO_DEPTH]]))


def test_what_is_no_depth_is_told(tmp_path):
    plane = np.ones((6, 4), np.float32)
    (tmp_path / "text.exr").write_text("no picture")
    for path, sentence in (
        (tmp_path / "gone.exr", "There is no mesh depth"),
        (tmp_path / "text.exr", "cannot be read as an EXR"),
        (
            write_exr(tmp_path / "rgb.exr", ("", {"L.Combined.R": plane, "L.Normal.Z": plane})),
            "no Depth pass",
        ),
        (write_exr(tmp_path / "small.exr", ("", {"Z": plane})), "has 4x6 pixels, the picture 40x60"),
    ):
        with pytest.raises(LodgsError, match=sentence):
            read_depth(path, 40, 60, (0, 0, 30, 30))


def test_other_endings_are_refused(tmp_path):
    with pytest.raises(LodgsError, match=r"neither .png nor .exr"):
        write_image(tmp_path / "a.jpg", picture(np.zeros((2, 2, 3))))
    assert list(tmp_path.iterdir()) == []

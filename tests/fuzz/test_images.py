"""Image files of all formats: sizes, pixels and mesh depths."""

from __future__ import annotations

import numpy as np
import OpenEXR
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from tests.fuzz.entry_points import attempt
from tests.fuzz.mutations import corrupted
from training.render.image import read_depth
from training.scenes.image_headers import MAX_PIXELS, exif_orientation, image_size
from training.scenes.images import check_image, load_image


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("images")


@pytest.fixture(scope="module")
def seeds(folder) -> list[bytes]:
    """Return images in all photo formats."""
    noise = np.random.default_rng(0).integers(0, 256, (24, 40, 3)).astype(np.uint8)
    image = Image.fromarray(noise)
    contents = []
    exif = Image.Exif()
    exif[274] = 6
    for name, variant, options in (
        ("a.jpg", image, {}),
        ("b.jpg", image, {"progressive": True, "exif": b"Exif\0\0" + bytes(99)}),
        ("c.jpg", image.convert("CMYK"), {"exif": exif}),
        ("a.png", image, {"exif": exif}),
        ("b.png", image.convert("P"), {}),
        ("c.png", image.convert("I;16"), {}),
        ("d.png", image.convert("LA"), {}),
        ("a.tif", image, {"exif": exif}),
        ("b.tif", image, {"compression": "tiff_lzw", "big_tiff": False}),
        ("a.webp", image, {"exif": exif}),
        ("b.webp", image, {"lossless": True}),
        ("c.webp", image.convert("RGBA"), {}),
    ):
        variant.save(folder / name, **options)
        contents.append((folder / name).read_bytes())
    light = (noise / np.float32(255)).astype(np.float32)
    for compression in ("NO", "ZIP", "PIZ"):
        header = {
            "compression": getattr(OpenEXR, f"{compression}_COMPRESSION"),
            "type": OpenEXR.scanlineimage,
        }
        planes = {"R": light[..., 0], "G": light[..., 1], "B": light[..., 2], "Depth.Z": light[..., 0]}
        with OpenEXR.File(
            header, {name: np.ascontiguousarray(plane) for name, plane in planes.items()}
        ) as file:
            file.write(str(folder / "seed.exr"))
        contents.append((folder / "seed.exr").read_bytes())
    return contents


@pytest.mark.cases(short=150, weight=3)
@given(data=st.data(), size=st.sampled_from([(40, 24), (20, 12), (13, 7), (1, 1)]))
def test_corrupt_images(folder, seeds, data, size):
    content = data.draw(corrupted(seeds))
    path = folder / "tried"
    path.write_bytes(content)
    dimensions = attempt("image size", lambda: image_size(path), content)
    assert dimensions is None or 1 <= dimensions[0] * dimensions[1] <= MAX_PIXELS
    orientation = attempt("EXIF orientation", lambda: exif_orientation(path), content)
    assert orientation in range(1, 9)
    attempt("image", lambda: check_image(path), content)
    pixels = attempt("image", lambda: load_image(path, *size), content)
    if pixels is not None:
        assert pixels.shape == (size[1], size[0], 3) and pixels.min() >= 0 and pixels.max() <= 1


@given(data=st.data(), window=st.sampled_from([None, (3, 2, 10, 8)]))
def test_corrupt_mesh_depths(folder, seeds, data, window):
    content = data.draw(corrupted(seeds[-3:]))
    path = folder / "depth.exr"
    path.write_bytes(content)
    depth = attempt("mesh depth", lambda: read_depth(path, 40, 24, window), content)
    assert depth is None or depth.shape == ((8, 10) if window else (24, 40))

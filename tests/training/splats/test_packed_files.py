"""SOG files whose declared or unpacked size is wrong; layouts follow the formats' documents."""

import io
import json
import zipfile

import numpy as np
import pytest
from PIL import Image

from training.errors import LodgsError
from training.splats.formats import open_as_ply
from training.splats.packed_files import check_sog_file, webp_size


def webp(width: int, height: int, **options) -> bytes:
    file = io.BytesIO()
    Image.new("RGBA", (width, height), (1, 2, 3, 255)).save(file, "WEBP", **options)
    return file.getvalue()


def sog(meta: dict, image: bytes, compression: int = zipfile.ZIP_STORED) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", compression) as archive:
        archive.writestr("meta.json", json.dumps(meta))
        archive.writestr("means_l.webp", image)
    return file.getvalue()


GOOD = {
    "a.sog": sog({"version": 2, "count": 16}, webp(4, 4, lossless=True)),
    "v1.sog": sog({"means": {"shape": [16, 3]}}, webp(4, 4)),
}
BAD = {
    "bomb.sog": sog({"count": 1}, bytes(50_000_000), zipfile.ZIP_DEFLATED),
    "wide.sog": sog({"count": 16}, webp(8192, 2048, lossless=True)),
    "many.sog": sog({"count": 2**40}, webp(4, 4)),
    "count.sog": sog({"count": "x"}, webp(4, 4)),
    "shape.sog": sog({"means": {"shape": []}}, webp(4, 4)),
    "list.sog": sog({"means": []}, webp(4, 4)),
    "image.sog": sog({"count": 16}, b"RIFF"),
    "text.sog": b"PK no archive",
}


@pytest.mark.parametrize("name", GOOD)
def test_complete_files_pass(tmp_path, name):
    (tmp_path / name).write_bytes(GOOD[name])
    check_sog_file(tmp_path / name)


@pytest.mark.parametrize("name", BAD)
def test_files_that_promise_or_unpack_too_much_are_refused(tmp_path, name):
    (tmp_path / name).write_bytes(BAD[name])
    with pytest.raises(LodgsError, match="Cannot read"), open_as_ply(tmp_path / name):
        pass


@pytest.mark.parametrize("options", [{}, {"lossless": True}, {"exif": b"Exif\0\0MM\0*\0\0\0\x08\0\0"}])
def test_webp_size_of_all_layouts(options):
    data = np.frombuffer(webp(300, 17, **options), np.uint8)
    assert webp_size(data[:30].tobytes()) == (300, 17)

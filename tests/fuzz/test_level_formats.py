"""Files of levels by other programs: accepted or rejected with a sentence."""

from __future__ import annotations

import gzip
import json
import shutil
import zipfile

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.fuzz.entry_points import attempt
from tests.fuzz.mutations import corrupted, corrupted_value
from tests.training.splats.level_files import flod
from tests.training.splats.test_formats import random_splats
from tests.training.splats.test_gltf import assembled, read_parts
from tests.training.splats.test_spz import spz, spz4
from training.editing.export import export_levels
from training.splats.bundle import read_bundle
from training.splats.formats import open_as_ply
from training.splats.gltf import write_compressed_glb
from training.splats.gltf_reader import read_glb
from training.splats.levels import Bundle, Level
from training.splats.portable_levels import PortableLevels
from training.splats.sog import encode_sog
from training.splats.spz import pack_spz, read_spz
from training.splats.streamed_levels import STREAMED_FILE, read_streamed_levels, write_streamed_levels
from training.splats.usd import read_usd


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("levels")


@pytest.fixture(scope="module")
def glb(folder):
    export_levels(folder / "good.glb", flod(1))
    return (folder / "good.glb").read_bytes(), *read_parts(folder / "good.glb")


@pytest.fixture(scope="module")
def usd(folder):
    pytest.importorskip("pxr.UsdLod", reason="usd-core is not installed")
    for ending in ("usdc", "usdz"):
        export_levels(folder / f"good.{ending}", flod(1))
    return {ending: (folder / f"good.{ending}").read_bytes() for ending in ("usdc", "usdz")}


@pytest.mark.cases(short=120, weight=1)
@given(data=st.data())
def test_corrupt_glb_files(folder, glb, data):
    content = data.draw(corrupted([glb[0]]))
    (folder / "a.glb").write_bytes(content)
    attempt("glTF", lambda: read_glb(folder / "a.glb", folder / "a.ply"), content)


@pytest.mark.cases(short=60, weight=1)
@given(data=st.data())
def test_corrupt_glb_documents(folder, glb, data):
    document = data.draw(corrupted_value(glb[1]))
    try:
        content = assembled(document, glb[2])
    except (UnicodeEncodeError, ValueError):  # Python writes no such JSON
        return
    (folder / "a.glb").write_bytes(content)
    attempt("glTF document", lambda: read_glb(folder / "a.glb", folder / "a.ply"), document)


@pytest.fixture(scope="module")
def compressed_glb(folder) -> dict:
    """Return the JSON document of splats as SPZ, in one primitive."""
    bundle = Bundle("", [Level(1, random_splats(40, 2))])
    write_compressed_glb(folder / "packed.glb", PortableLevels(bundle))
    return read_parts(folder / "packed.glb")[0]


@pytest.mark.cases(short=100, weight=1)
@given(data=st.data())
def test_corrupt_spz_in_glb(folder, compressed_glb, data):
    """Corrupt the stream, or its content before compression, whose checksum then is right."""
    seeds = [pack_spz(random_splats(40, 2)), spz(40, 1, bytes(40 * (20 + 9))), pack_spz(random_splats(3, 0))]
    if data.draw(st.booleans()):
        content = data.draw(corrupted(seeds))
    else:
        content = gzip.compress(data.draw(corrupted([gzip.decompress(seed) for seed in seeds])), 1)
    document = compressed_glb | {
        "buffers": [{"byteLength": len(content)}],
        "bufferViews": [{"buffer": 0, "byteOffset": 0, "byteLength": len(content)}],
    }
    (folder / "a.glb").write_bytes(assembled(document, content + bytes(-len(content) % 4)))
    (folder / "a.ply").unlink(missing_ok=True)
    attempt("SPZ in glTF", lambda: read_glb(folder / "a.glb", folder / "a.ply"), content)
    if (folder / "a.ply").exists():
        splats = read_bundle(folder / "a.ply").levels[-1].splats
        assert np.isfinite(splats.means).all() and np.isfinite(splats.sh).all()


@pytest.mark.cases(short=120, weight=1)
@given(data=st.data())
def test_corrupt_spz_files(folder, data):
    """Corrupt the stream, or its content before compression, whose checksum then is right."""
    seeds = [spz(40, 1, bytes(40 * (20 + 9))), pack_spz(random_splats(3, 0))]
    if data.draw(st.booleans()):
        content = data.draw(corrupted([*seeds, spz4(40, 1, version=4)]))
    else:
        content = gzip.compress(data.draw(corrupted([gzip.decompress(seed) for seed in seeds])), 1)
    (folder / "a.spz").write_bytes(content)
    attempt("SPZ", lambda: read_spz(folder / "a.spz"), content)


@pytest.fixture(scope="module")
def streamed(folder) -> dict:
    """Return the main file of streamed levels in the folder ``web``."""
    levels = [Level(1, random_splats(30)), Level(2, random_splats(60, 1))]
    levels[1].splats.means[:5] += 100  # the surroundings
    write_streamed_levels(folder / "web", Bundle("flod", levels))
    return json.loads((folder / "web" / STREAMED_FILE).read_text("utf-8"))


@pytest.mark.cases(short=60, weight=0.2)
@given(data=st.data())
def test_corrupt_streamed_levels(folder, streamed, data):
    content = json.dumps(data.draw(corrupted_value(streamed)), skipkeys=True)
    (folder / "web" / STREAMED_FILE).write_text(content, "utf-8", errors="replace")
    _try_streamed(folder, content)


@pytest.mark.cases(short=60, weight=0.2)
@given(data=st.data(), name=st.sampled_from(["meta.json", "means_l.webp", "sh0.webp", "quats.webp"]))
def test_corrupt_sog_files(folder, streamed, data, name):
    (folder / "web" / STREAMED_FILE).write_text(json.dumps(streamed), "utf-8")
    good = encode_sog(random_splats(60, 1))
    content = data.draw(corrupted([good[name]]))
    for file, image in good.items():
        (folder / "web" / "0_0" / file).write_bytes(content if file == name else image)
    _try_streamed(folder, content)


@pytest.mark.cases(short=60, weight=0.5)
@given(data=st.data(), degree=st.sampled_from([0, 2]))
def test_corrupt_sog_archives(folder, data, degree):
    """Corrupt the archive, or one of its files, whose checksum then is right."""
    path = folder / "a.sog"
    files = encode_sog(random_splats(60, degree))
    name = data.draw(st.sampled_from(["", *files]))
    if name == "meta.json":
        values = data.draw(corrupted_value(json.loads(files[name])))
        files[name] = json.dumps(values, skipkeys=True).encode("utf-8", "surrogatepass")
    elif name:
        files[name] = data.draw(corrupted([files[name], *files.values()]))
    with zipfile.ZipFile(path, "w") as archive:
        for member, content in files.items():
            archive.writestr(member, content)
    content = path.read_bytes()
    if not name:
        content = data.draw(corrupted([content]))
        path.write_bytes(content)

    def read() -> None:
        with open_as_ply(path) as ply:
            splats = read_bundle(ply).levels[-1].splats
        assert np.isfinite(splats.means).all() and np.isfinite(splats.sh).all()

    attempt("SOG", read, (name, content))


def _try_streamed(folder, content):
    shutil.rmtree(folder / "read", ignore_errors=True)

    def read():
        read_streamed_levels(folder / "web" / STREAMED_FILE, folder / "read")

    attempt("streamed SOG", read, content)


@pytest.mark.cases(short=4, weight=0.02)
@given(data=st.data(), ending=st.sampled_from(["usdc", "usdz"]))
def test_corrupt_usd_files(folder, usd, data, ending):
    """Each file is read in a process of its own, because usd-core may abort it."""
    content = data.draw(corrupted([usd[ending]]))
    (folder / f"a.{ending}").write_bytes(content)
    attempt("USD", lambda: read_usd(folder / f"a.{ending}", folder / "b.ply"), content)

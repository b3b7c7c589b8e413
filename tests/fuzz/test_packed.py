"""Compressed splat files: accepted or rejected without unpacking much, before another program reads them."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.fuzz.entry_points import attempt
from tests.fuzz.mutations import corrupted
from tests.training.splats.ksplat_files import FILES as KSPLAT
from tests.training.splats.test_compressed_ply import GOOD as COMPRESSED_PLY
from tests.training.splats.test_formats import random_splats
from tests.training.splats.test_packed_files import GOOD
from training.splats.compressed_ply import read_compressed_ply, write_compressed_ply
from training.splats.formats.splat import SplatFile
from training.splats.ksplat import KsplatRows
from training.splats.packed_files import check_sog_file


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("packed")


@pytest.mark.cases(short=120, weight=1)
@given(data=st.data(), name=st.sampled_from(sorted(GOOD)))
def test_corrupt_packed_files(folder, data, name):
    content = data.draw(corrupted([GOOD[name]]))
    (folder / name).write_bytes(content)
    attempt("packed .sog", lambda: check_sog_file(folder / name), (name, content))


@pytest.fixture(scope="module")
def compressed_ply(folder):
    write_compressed_ply(folder / "good.compressed.ply", random_splats(300, 1), {})
    return (folder / "good.compressed.ply").read_bytes()


@pytest.mark.cases(short=120, weight=1)
@given(data=st.data())
def test_corrupt_compressed_ply_files(folder, compressed_ply, data):
    content = data.draw(corrupted([compressed_ply, COMPRESSED_PLY]))
    (folder / "a.ply").write_bytes(content)
    attempt("compressed PLY", lambda: read_compressed_ply(folder / "a.ply")[0].select(slice(None)), content)


@pytest.mark.cases(short=60, weight=1)
@given(data=st.data())
def test_corrupt_splat_files(folder, data):
    content = data.draw(corrupted([bytes(range(256)), b"\xff" * 64]))
    (folder / "a.splat").write_bytes(content)
    attempt(".splat", lambda: SplatFile(folder / "a.splat").select(slice(0, 9)), content)


@pytest.mark.cases(short=200, weight=1)
@given(data=st.data(), file=st.sampled_from(KSPLAT))
def test_corrupt_ksplat_files(folder, data, file):
    content = data.draw(corrupted([file]))
    (folder / "a.ksplat").write_bytes(content)
    attempt(".ksplat", lambda: KsplatRows(folder / "a.ksplat").select(slice(None)), content)

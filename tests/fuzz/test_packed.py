"""Compressed splat files: accepted or rejected without unpacking much, before another program reads them."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.fuzz.entry_points import attempt
from tests.fuzz.mutations import corrupted
from tests.training.splats.test_packed_files import GOOD
from training.splats.formats.splat import SplatFile
from training.splats.packed_files import check_packed_file


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("packed")


@pytest.mark.cases(short=120, weight=1)
@given(data=st.data(), name=st.sampled_from(sorted(GOOD)))
def test_corrupt_packed_files(folder, data, name):
    content = data.draw(corrupted([GOOD[name]]))
    (folder / name).write_bytes(content)
    suffix = name[name.index(".") :]
    attempt(f"packed {suffix}", lambda: check_packed_file(folder / name), (name, content))


@pytest.mark.cases(short=60, weight=1)
@given(data=st.data())
def test_corrupt_splat_files(folder, data):
    content = data.draw(corrupted([bytes(range(256)), b"\xff" * 64]))
    (folder / "a.splat").write_bytes(content)
    attempt(".splat", lambda: SplatFile(folder / "a.splat").select(slice(0, 9)), content)

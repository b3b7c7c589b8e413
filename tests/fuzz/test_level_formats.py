"""Files of levels by other programs: accepted or rejected with a sentence."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.fuzz.entry_points import attempt
from tests.fuzz.mutations import corrupted, corrupted_value
from tests.training.splats.level_files import flod
from tests.training.splats.test_gltf import assembled, read_parts
from training.editing.export import export_levels
from training.splats.gltf import read_glb
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


@pytest.mark.cases(short=4, weight=0.02)
@given(data=st.data(), ending=st.sampled_from(["usdc", "usdz"]))
def test_corrupt_usd_files(folder, usd, data, ending):
    """Each file is read in a process of its own, because usd-core may abort it."""
    content = data.draw(corrupted([usd[ending]]))
    (folder / f"a.{ending}").write_bytes(content)
    attempt("USD", lambda: read_usd(folder / f"a.{ending}", folder / "b.ply"), content)

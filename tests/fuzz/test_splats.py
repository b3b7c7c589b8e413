"""Splats: PLY files of all dialects, bundles, level folders. Accepted splats can be rendered."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.fuzz.entry_points import attempt
from tests.fuzz.mutations import corrupted, corrupted_comments, corrupted_value
from training.cli.info import describe
from training.splats.bundle import read_bundle, write_bundle
from training.splats.coding import Codebook
from training.splats.gaussians import Splats
from training.splats.level_folder import read_folder, write_folder
from training.splats.levels import Bundle, Level
from training.splats.ply import read_ply, write_ply

META = {"camera_center": [0.1, -0.2, 3.4], "view": [[1, 0, 0], [0, 0, 1]], "gamma": 1.5, "antialias": True}
META |= {"up_rotation": [[1, 0, 0], [0, 0, 1], [0, -1, 0]]}


def splats(count: int, degree: int, **extras) -> Splats:
    random = np.random.default_rng(count)
    shapes = ((count, 3), (count, 4), (count, 3), (count,), (count, (degree + 1) ** 2, 3))
    return Splats(*(random.standard_normal(shape, dtype=np.float32) for shape in shapes), extras)


def bundles() -> list[Bundle]:
    """Return bundles with separate levels and extras, cumulative levels, a single level and a table."""
    bands = [Level(number, splats(3 * number, 1), {"s_min": 0.5 / number}) for number in (1, 2, 4)]
    bands[1].splats.extras["unknown"] = np.arange(6, dtype="u1")
    octree = [Level(number, splats(4, 0, lod_bias=np.ones(4, "f4"))) for number in (1, 2)]
    facts = {"d_max": 9.0, "d_max_focal": 500.0}
    decay = [Level(1, splats(9, 2, sigma_d=np.ones(9, "f4")))]
    table = {"chunks": {"x": np.zeros(3, "f4"), "n": np.arange(3, dtype="i2")}}
    return [
        Bundle("flod", bands, "bands", {}, {"gamma": 2.0}, meta=META),
        Bundle("octree", octree, "octree", facts, cumulative=True, meta={"voxel": 0.1}),
        Bundle("clod", decay, "decay", {"reference": 3.0, "tau": 0.01}, tables=table),
    ]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("splats")


@pytest.fixture(scope="module")
def files(folder) -> list[bytes]:
    """Return valid PLY files: bundles, also compressed, plain files, those of other programs, ASCII, and one
    with faces."""
    contents = []
    for bundle in bundles():
        for order in ("finest_first", "stream"):
            write_bundle(folder / "good.ply", bundle, order)
            contents.append((folder / "good.ply").read_bytes())
    for bundle in bundles():
        rest = bundle.levels[0].splats.sh.shape[1] - 1
        codes = {level.number: np.arange(len(level.splats)) % 2 for level in bundle.levels}
        write_bundle(folder / "good.ply", bundle, codebook=Codebook(np.ones((2, rest, 3), "f4"), codes))
        contents.append((folder / "good.ply").read_bytes())
    write_ply(folder / "good.ply", splats(5, 3, filter_3D=np.ones(5, "f4"), id=np.arange(5, dtype="u4")))
    contents.append((folder / "good.ply").read_bytes())
    head, rows = contents[-1].split(b"end_header\n")
    faces = b"element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    contents.append(head + faces + rows + b"\3" + bytes(12))
    write_ply(folder / "good.ply", splats(4, 0))
    head, rows = (folder / "good.ply").read_bytes().split(b"end_header\n")
    table = np.frombuffer(rows, "f4").reshape(4, -1)
    text = "\n".join(" ".join(f"{value:.5g}" for value in row) for row in table)
    contents.append(head.replace(b"binary_little_endian", b"ascii") + b"end_header\n" + text.encode() + b"\n")
    return contents


def use(bundle: Bundle, folder) -> Bundle:
    """Check that all values can be rendered and that the bundle is unchanged after writing it."""
    for level in bundle.levels:
        data = level.splats
        columns = (data.means**2, data.quats**2, np.exp(data.log_scales) ** 2, data.sh**2)
        assert all(np.isfinite(column).all() for column in columns)
        assert not np.isnan(data.opacity_logits).any() and (data.quats**2).sum(axis=1).all()
    if len({level.splats.sh_degree for level in bundle.levels}) == 1:
        write_bundle(folder / "copy.ply", bundle)
        copy = read_bundle(folder / "copy.ply")
        assert [len(level.splats) for level in copy.levels] == [len(level.splats) for level in bundle.levels]
        assert (copy.rule, copy.facts, copy.controls) == (bundle.rule, bundle.facts, bundle.controls)
    return bundle


@pytest.mark.cases(short=100, weight=6)
@given(data=st.data())
def test_corrupt_plys_and_bundles(folder, files, data):
    content = data.draw(corrupted(files))
    path = folder / "a.ply"
    path.write_bytes(content)
    attempt("PLY", lambda: read_ply(path), content)
    attempt("bundle", lambda: use(read_bundle(path), folder), content)
    attempt("describe", lambda: describe(path).encode(), content)


@pytest.mark.cases(short=60, weight=2)
@given(data=st.data())
def test_corrupt_bundle_headers(folder, files, data):
    content = data.draw(st.sampled_from(files[:6]))
    content = data.draw(corrupted_comments(content))
    path = folder / "header.ply"
    path.write_bytes(content)
    attempt("bundle", lambda: use(read_bundle(path), folder), content)


@pytest.mark.cases(short=40, weight=2)
@given(data=st.data(), bundle=st.sampled_from(bundles()))
def test_corrupt_level_folders(folder, data, bundle):
    target = folder / "levels"
    shutil.rmtree(target, ignore_errors=True)
    write_folder(target, bundle)
    files = [file.name for file in sorted(target.glob("*.ply"))]  # including tables.ply
    change = data.draw(st.sampled_from(["manifest.json", "values", "no manifest", *files]))
    manifest = target / "manifest.json"
    if change == "values":
        manifest.write_text(json.dumps(data.draw(corrupted_value(json.loads(manifest.read_text())))))
    elif change == "no manifest":
        manifest.unlink()
        (target / files[-1]).write_bytes(data.draw(corrupted([(target / "lod0.ply").read_bytes()])))
    else:
        (target / change).write_bytes(data.draw(corrupted([(target / change).read_bytes()])))
    attempt("folder of levels", lambda: use(read_folder(target), folder), change)

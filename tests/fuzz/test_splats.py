"""The doors of splats: PLYs of every dialect, bundles, folders of levels. What is taken can be drawn."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.fuzz.doors import attempt
from tests.fuzz.mutations import spoiled, spoiled_value
from training.cli.info import describe
from training.splats.bundle import read_bundle, write_bundle
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
    """One of every form: levels apart with extras, levels that add up, a table, a single level."""
    bands = [Level(number, splats(3 * number, 1), {"s_min": 0.5 / number}) for number in (1, 2, 4)]
    bands[1].splats.extras["odd"] = np.arange(6, dtype="u1")
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
    """Good PLYs: bundles, plain ones, of other programs, in ASCII, with a mesh's faces."""
    found = []
    for bundle in bundles():
        for order in ("finest_first", "stream"):
            write_bundle(folder / "good.ply", bundle, order)
            found.append((folder / "good.ply").read_bytes())
    write_ply(folder / "good.ply", splats(5, 3, filter_3D=np.ones(5, "f4"), id=np.arange(5, dtype="u4")))
    found.append((folder / "good.ply").read_bytes())
    head, rows = found[-1].split(b"end_header\n")
    faces = b"element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    found.append(head + faces + rows + b"\3" + bytes(12))
    write_ply(folder / "good.ply", splats(4, 0))
    head, rows = (folder / "good.ply").read_bytes().split(b"end_header\n")
    table = np.frombuffer(rows, "f4").reshape(4, -1)
    text = "\n".join(" ".join(f"{value:.5g}" for value in row) for row in table)
    found.append(head.replace(b"binary_little_endian", b"ascii") + b"end_header\n" + text.encode() + b"\n")
    return found


def use(bundle: Bundle, folder) -> Bundle:
    """What follows a reading: every value is one that can be drawn, and the bundle can be written."""
    for level in bundle.levels:
        part = level.splats
        columns = (part.means**2, part.quats**2, np.exp(part.log_scales) ** 2, part.sh**2)
        assert all(np.isfinite(column).all() for column in columns)
        assert not np.isnan(part.opacity_logits).any() and (part.quats**2).sum(axis=1).all()
    if len({level.splats.sh_degree for level in bundle.levels}) == 1:
        write_bundle(folder / "again.ply", bundle)
        again = read_bundle(folder / "again.ply")
        assert [len(level.splats) for level in again.levels] == [len(level.splats) for level in bundle.levels]
        assert (again.rule, again.facts, again.controls) == (bundle.rule, bundle.facts, bundle.controls)
    return bundle


@pytest.mark.cases(short=100, weight=6)
@given(data=st.data())
def test_plys_and_bundles(folder, files, data):
    content = data.draw(spoiled(files))
    path = folder / "a.ply"
    path.write_bytes(content)
    attempt("PLY", lambda: read_ply(path), content)
    attempt("bundle", lambda: use(read_bundle(path), folder), content)
    attempt("describe", lambda: describe(path).encode(), content)


@pytest.mark.cases(short=60, weight=2)
@given(data=st.data())
def test_what_bundles_say_of_themselves(folder, files, data):
    content = data.draw(st.sampled_from(files[:6]))
    said = content[: content.index(b"end_header")].split(b"comment lodsplat ")
    place = data.draw(st.integers(1, len(said) - 1))
    comment, *rest = said[place].split(b"\n")
    odd = json.dumps(data.draw(spoiled_value(json.loads(comment)))).encode()
    said[place] = b"\n".join([odd, *rest])
    content = b"comment lodsplat ".join(said) + content[content.index(b"end_header") :]
    path = folder / "said.ply"
    path.write_bytes(content)
    attempt("bundle", lambda: use(read_bundle(path), folder), content)


@pytest.mark.cases(short=40, weight=2)
@given(data=st.data(), which=st.sampled_from(bundles()))
def test_folders_of_levels(folder, data, which):
    there = folder / "levels"
    shutil.rmtree(there, ignore_errors=True)
    write_folder(there, which)
    files = [file.name for file in sorted(there.glob("*.ply"))]  # tables.ply among them
    spoil = data.draw(st.sampled_from(["manifest.json", "values", "gone", *files]))
    manifest = there / "manifest.json"
    if spoil == "values":
        manifest.write_text(json.dumps(data.draw(spoiled_value(json.loads(manifest.read_text())))))
    elif spoil == "gone":
        manifest.unlink()
        (there / files[-1]).write_bytes(data.draw(spoiled([(there / "lod0.ply").read_bytes()])))
    else:
        (there / spoil).write_bytes(data.draw(spoiled([(there / spoil).read_bytes()])))
    attempt("folder of levels", lambda: use(read_folder(there), folder), spoil)

"""Dialects of splat PLYs, written with plyfile and compared with numbers computed by hand."""

import math

import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement

from training.cli.info import describe
from training.errors import LodgsError
from training.rasterize.filter3d import apply_filter3d
from training.render.scene import Instance, SplatSet, draw
from training.scenes.cameras import Camera
from training.splats.bundle import read_bundle, read_header, write_bundle
from training.splats.dialects import comments_from_meta
from training.splats.level_folder import read_folder, write_folder
from training.splats.levels import Bundle, Level
from training.splats.ply import read_ply, write_ply

XYZ = ["x", "y", "z"]
NORMALS = ["nx", "ny", "nz"]
DC = [f"f_dc_{i}" for i in range(3)]
REST = [f"f_rest_{i}" for i in range(45)]
ROT = [f"rot_{i}" for i in range(4)]
OFFSETS = [f"f_offset_{i}" for i in range(3)]


def scales(count):
    return [f"scale_{i}" for i in range(count)]


PLAIN = [*XYZ, *NORMALS, *DC, "opacity", *scales(3), *ROT]
ANYGS = [*XYZ, "level", "extra_level", *OFFSETS, *DC, *REST, "opacity", *scales(6), *ROT]
SPACETIME = [*XYZ, "trbf_center", "trbf_scale", *NORMALS, *[f"motion_{i}" for i in range(9)], *DC, "opacity"]
FLOD = [*XYZ, *NORMALS, *DC, *REST, "opacity", *scales(3), *ROT, "ancestry_lod_0", "ancestry_lod_1"]
SCAFFOLD = [*XYZ, *NORMALS, *[f"f_offset_{i}" for i in range(30)], *[f"f_anchor_feat_{i}" for i in range(32)]]
SCAFFOLD += ["opacity", *scales(6), *ROT]
OCTREE = [*XYZ, "level", "extra_level", "info", *SCAFFOLD[6:]]


@pytest.fixture
def write(tmp_path):
    """Return ``write(columns, values, ...)``, which writes a float PLY; columns without values are random."""

    def make(columns, values=None, *, count=2, comments=(), obj_info=(), name="a.ply", elements=()):
        random = np.random.default_rng(3)
        rows = np.zeros(count, [(column, "f4") for column in columns])
        for column in columns:
            rows[column] = (values or {}).get(column, random.normal(0, 0.5, count))
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        data = PlyData(
            [*elements, PlyElement.describe(rows, "vertex")], comments=list(comments), obj_info=list(obj_info)
        )
        data.write(str(path))
        return path

    return make


def test_columns_that_cloudcompare_renamed(write):
    names = [name if name in (*XYZ, *NORMALS) else f"scalar_{name}" for name in [*PLAIN, "mark"]]
    values = {
        "scalar_f_dc_1": [1, 2],
        "scalar_opacity": [3, 4],
        "scalar_rot_0": [5, 6],
        "scalar_scale_2": [7, 8],
    }
    splats = read_ply(write(names, values | dict.fromkeys(NORMALS, 0)))
    assert splats.sh[:, 0, 1].tolist() == [1, 2] and splats.opacity_logits.tolist() == [3, 4]
    assert splats.quats[:, 0].tolist() == [5, 6] and splats.log_scales[:, 2].tolist() == [7, 8]
    assert list(splats.extras) == ["scalar_mark"], "unknown columns keep their names"


def test_3d_filter_is_applied(write):
    """Scales 0.3, 0.4, 1.2 filtered by 0.4: s'² = 0.25, 0.32, 1.6, at constant mass 0.9 · 0.144."""
    values = {f"scale_{i}": [math.log(s), -1] for i, s in enumerate((0.3, 0.4, 1.2))}
    values |= {"opacity": [math.log(9), 20], "filter_3D": [0.4, 0]} | dict.fromkeys(NORMALS, 0)
    splats = read_ply(write([*PLAIN, "filter_3D"], values))
    expected = np.log([0.5, math.sqrt(0.32), math.sqrt(1.6)])
    np.testing.assert_allclose(splats.log_scales, np.stack([expected, np.full(3, -1.0)]), rtol=1e-6)
    opacity = 1 / (1 + np.exp(-splats.opacity_logits.astype(np.float64)))
    np.testing.assert_allclose(opacity[0], 0.9 * 0.3 * 0.4 * 1.2 / np.sqrt(0.25 * 0.32 * 1.6), rtol=1e-6)
    assert splats.opacity_logits[1] == 20
    assert splats.extras == {} and splats.log_scales.dtype == splats.opacity_logits.dtype == np.float32


def test_3d_filter_is_accurate_for_extreme_values(write):
    """Narrow to wide, opaque to clear splats cover 80 orders of magnitude."""
    s, o, f = (x.ravel() for x in np.meshgrid([-40.0, -3, 5], [-90.0, 0, 15, 200], [0, 1e-12, 0.1, 1e4]))
    values = {"scale_0": s, "scale_1": s, "scale_2": s, "opacity": o, "filter_3D": f}
    splats = read_ply(write([*PLAIN, "filter_3D"], values, count=len(s)))
    wide = 0.5 * np.log(np.exp(2 * s) + f**2)
    np.testing.assert_allclose(splats.log_scales[:, 0], wide, rtol=1e-5, atol=1e-6)
    log_opacity = -np.logaddexp(0, -o) + 3 * (s - wide)
    log_filtered = -np.logaddexp(0, -splats.opacity_logits.astype(np.float64))
    np.testing.assert_allclose(log_filtered, log_opacity, rtol=1e-5, atol=1e-5)
    assert (splats.opacity_logits <= o.astype(np.float32)).all()


def test_3d_filter_matches_the_trainer(write):
    random = np.random.default_rng(1)
    count = 200
    values = {axis: random.uniform(-1, 1, count) for axis in "xy"} | {"z": random.uniform(2, 4, count)}
    values |= {f"scale_{i}": random.normal(-4, 1, count) for i in range(3)}
    values["filter_3D"] = random.uniform(0.01, 0.05, count)
    raw = read_ply(write(PLAIN, {k: v for k, v in values.items() if k in PLAIN}, count=count, name="raw.ply"))
    read = read_ply(write([*PLAIN, "filter_3D"], values, count=count))
    std = torch.from_numpy(values["filter_3D"]).float()
    log_scales, logits = apply_filter3d(
        torch.from_numpy(raw.log_scales), torch.from_numpy(raw.opacity_logits), std
    )
    camera = Camera("a", 48, 40, 40.0, 40.0, 24.0, 20.0, np.eye(4))

    def render(splats):
        image = draw([Instance(SplatSet(splats, backend="reference"))], camera, backend="reference")
        assert image is not None
        return image.image

    unfiltered = render(raw)
    raw.log_scales, raw.opacity_logits = log_scales.numpy(), logits.numpy()
    np.testing.assert_allclose(render(read), render(raw), atol=1e-5)
    assert np.abs(render(read) - unfiltered).max() > 0.05


def test_explicit_anchors_become_splats(write):
    """Octree-AnyGS, explicit: 1, 2, 3 + (0.5, -1, 2) · (2, 0.5, 1) = 2, 1.5, 5."""
    values = {"x": 1, "y": 2, "z": 3, "f_offset_0": 0.5, "f_offset_1": -1, "f_offset_2": 2}
    values |= {f"scale_{i}": math.log(s) for i, s in enumerate((2, 0.5, 1, 0.1, 0.2, 0.3))}
    values |= {"level": [0, 3], "extra_level": [0.02, 0]}
    path = write(ANYGS, values, obj_info=["standard_dist 12.500000", "levels 4.000000"])
    warnings = []
    splats = read_ply(path, warnings.append)
    np.testing.assert_allclose(splats.means, [[2, 1.5, 5]] * 2, rtol=1e-6)
    np.testing.assert_allclose(np.exp(splats.log_scales), [[0.1, 0.2, 0.3]] * 2, rtol=1e-6)
    assert splats.sh_degree == 3 and list(splats.extras) == ["level", "extra_level"]
    assert splats.extras["level"].tolist() == [0, 3]
    assert len(warnings) == 1 and "all levels are drawn together" in warnings[0] and str(path) in warnings[0]
    without_levels = write([name for name in ANYGS if "level" not in name], values, name="b.ply")
    np.testing.assert_array_equal(read_ply(without_levels, warnings.append).means, splats.means)
    assert len(warnings) == 1


@pytest.mark.parametrize("columns", [[*PLAIN, "filter_3D"], ANYGS])
def test_conversion_is_not_applied_twice(write, tmp_path, same, columns):
    splats = read_ply(write(columns))
    write_ply(tmp_path / "b.ply", splats)
    assert same(splats, read_ply(tmp_path / "b.ply"))
    assert same(splats, read_bundle(tmp_path / "a.ply").levels[0].splats)


PACKED = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]


@pytest.mark.parametrize(
    ("columns", "reason", "remedy"),
    [
        (PACKED, "compressed PLY of SuperSplat", "lodgs edit a.ply"),
        (SCAFFOLD, "anchors of Scaffold-GS or Octree-GS", "Train"),
        (OCTREE, "anchors of Scaffold-GS or Octree-GS", "Train"),
        ([*ANYGS, "f_offset_3", "f_offset_4", "f_offset_5"], "several splats each", "Export"),
        ([*PLAIN, *OFFSETS], "several splats each", "Export"),
        (FLOD, "original FLoD program, whose scales lack s_min", "convert4viewer.py"),
        (SPACETIME, "its splats move in time", "one moment"),
        ([*PLAIN, "t", "scale_t"], "its splats move in time", "one moment"),
        ([*PLAIN, "t", "scale_t_0", "rot_r_0"], "its splats move in time", "one moment"),
        ([*XYZ, "red", "green", "blue"], "coloured point cloud or mesh", "3DGS trainer"),
        ([*PLAIN[:-1]], "it has no rot_3", "3DGS trainer"),
    ],
)
def test_unsupported_dialect_is_named(write, columns, reason, remedy):
    path = write(columns)
    for read in (read_ply, read_bundle, read_header):
        with pytest.raises(LodgsError, match=reason) as caught:
            read(path)
        assert str(path) in caught.value.what and remedy in caught.value.remedy


def test_compressed_ply_with_chunks_is_named(write):
    chunk = PlyElement.describe(np.zeros(1, [("min_x", "f4"), ("max_x", "f4")]), "chunk")
    with pytest.raises(LodgsError, match="compressed"):
        read_ply(write(PACKED, elements=[chunk]))


def test_coarsest_flod_level_is_detected_by_its_folder(write):
    with pytest.raises(LodgsError, match="s_min"):
        read_ply(write(PLAIN, name="point_cloud/lod_1_iteration_10000/point_cloud.ply"))
    read_ply(write(PLAIN, name="point_cloud/iteration_30000/point_cloud.ply"))


@pytest.mark.parametrize(
    ("comments", "mip"),
    [
        (["Exported from Brush", "SH degree: 0", "SplatRenderMode: mip"], True),
        (["SplatRenderMode: default"], False),
        (["splatrendermode:  MIP "], True),
        (["SplatRenderMode: unheard-of"], False),
        (["antialiased 1"], True),
        (["antialiased 1", "SplatRenderMode: default"], False),
        (["antialiased by hand"], False),
        ([], False),
    ],
)
def test_2d_filter_is_detected(write, comments, mip):
    path, warnings = write(PLAIN, comments=comments), []
    bundle = read_bundle(path, warnings.append)
    assert bundle.meta == ({"antialias": True} if mip else {}) == read_header(path).meta
    assert bundle.antialias is mip and ("antialias: true" in describe(path)) is mip
    assert warnings == []


def test_2dgs_discs_become_thin_splats(write, tmp_path, same):
    """PlayCanvas' readers also add a third scale that is almost 0."""
    columns = [name for name in PLAIN if name != "scale_2"]
    splats = read_ply(write(columns, {"scale_0": [-1, -4], "scale_1": [-2, -3]}))
    sizes = np.exp(splats.log_scales.astype(np.float64))
    np.testing.assert_allclose(sizes[:, 2], np.exp([-2, -4]) / 1000, rtol=1e-6)
    write_ply(tmp_path / "b.ply", splats)
    same(read_ply(tmp_path / "b.ply"), splats)


def test_2d_filter_survives_every_export(tmp_path, make_splats):
    """The comment stores it for other programs and LODGS."""
    comment = "SplatRenderMode: mip"
    levels = [Level(1, make_splats(2, 0)), Level(2, make_splats(5, 0))]
    bundle = Bundle("lodge", levels, meta={"antialias": True})
    write_bundle(tmp_path / "b.ply", bundle)
    assert comment in PlyData.read(str(tmp_path / "b.ply"))["vertex"].comments
    assert read_bundle(tmp_path / "b.ply").meta == bundle.meta
    write_ply(tmp_path / "p.ply", levels[0].splats, comments_from_meta(bundle.meta))
    assert read_bundle(tmp_path / "p.ply").meta == bundle.meta
    write_folder(tmp_path / "f", bundle)
    assert all(
        comment in PlyData.read(str(tmp_path / "f" / f"lod{i}.ply"))["vertex"].comments for i in (0, 1)
    )
    (tmp_path / "f" / "manifest.json").unlink()
    assert read_folder(tmp_path / "f").meta == bundle.meta
    assert comments_from_meta({}) == []


def test_non_numeric_splats_are_dropped(write):
    count = 9
    values = {name: np.zeros(count) for name in PLAIN} | {"rot_0": np.ones(count), "x": np.arange(count)}
    values["x"] = np.where(np.arange(count) == 0, np.inf, values["x"])
    values["f_dc_1"][1] = values["opacity"][2] = values["rot_2"][3] = np.nan
    values["scale_1"][4] = np.inf
    values["opacity"][5] = np.inf  # opaque
    values["scale_2"][6] = -np.inf  # flat
    values["rot_0"][7] = 0  # unturned
    warnings = []
    splats = read_ply(write(PLAIN, values, count=count), warnings.append)
    assert splats.means[:, 0].tolist() == [5, 6, 7, 8]
    assert splats.quats[2].tolist() == [1, 0, 0, 0]
    assert len(warnings) == 1 and warnings[0].startswith("5 splats of ")


@pytest.mark.parametrize("cumulative", [False, True])
def test_undrawable_splats_of_levels_are_dropped(tmp_path, make_splats, same, cumulative):
    """Cumulative levels count the rows of a file before any is dropped."""
    coarse, fine = make_splats(5, 1), make_splats(7, 1, mark=np.arange(7, dtype="u1"))
    coarse.opacity_logits[2] = coarse.sh[3, 0, 0] = fine.quats[0, 1] = np.nan
    coarse.extras["mark"] = np.arange(5, dtype="u1")
    bundle = Bundle("octree", [Level(1, coarse), Level(2, fine)], cumulative=cumulative)
    write_bundle(tmp_path / "b.ply", bundle)
    write_folder(tmp_path / "f", bundle)
    for read, path in ((read_bundle, tmp_path / "b.ply"), (read_folder, tmp_path / "f")):
        warnings = []
        levels = read(path, warnings.append).levels
        assert same(coarse.select([0, 1, 4]), levels[0].splats)
        assert same(fine.select(slice(1, None)), levels[1].splats)
        assert sorted(text.split(" splats of ")[0] for text in warnings) == ["1", "2"]


def test_splats_too_large_for_single_precision_are_dropped(write):
    """Squares of positions, sizes and rotations, and sums of colours, stay finite."""
    count = 10
    values = {name: np.zeros(count) for name in PLAIN} | {"rot_0": np.ones(count)}
    values["x"] = 10.0 ** np.arange(count)
    values["y"][0] = values["rot_3"][1] = values["f_dc_0"][2] = 1e30
    values["scale_0"][3] = 44.5  # its square is infinite
    values["rot_0"][4] = 1e-30  # its square is zero: the rotation becomes the identity
    values["opacity"][5] = -1e30
    values["f_dc_1"][6] = -1e5
    splats = read_ply(write(PLAIN, values, count=count))
    np.testing.assert_array_equal(splats.means[:, 0], 10.0 ** np.arange(4, count, dtype="f4"))
    assert splats.quats[0].tolist() == [1, 0, 0, 0]
    variance = np.exp(splats.log_scales) ** 2
    assert np.isfinite(variance).all() and np.isfinite(splats.means**2).all()

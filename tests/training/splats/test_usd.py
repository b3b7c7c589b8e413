"""USD files: valid for usd-core, with the distances of the rules, and read back."""

import os
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from tests.training.splats.level_files import UP, assert_equal, camera, flod, read
from tests.training.splats.test_formats import random_splats
from training.editing.export import FileOptions, export_levels
from training.editing.portable import level_distances, portable_levels
from training.errors import LodgsError
from training.files import temporary_folder
from training.lod.rule import resolve_rule
from training.lod.selection import select
from training.scenes.view_tables import make_view_tables
from training.splats import usd as usd_module
from training.splats.levels import Bundle, Level
from training.splats.usd import load_usd

pxr = pytest.importorskip("pxr.UsdLod", reason="usd-core is not installed")


@pytest.fixture
def stage(tmp_path):
    export_levels(tmp_path / "a.usdc", flod())
    return load_usd().Usd.Stage.Open(str(tmp_path / "a.usdc"))


@pytest.mark.parametrize("ending", [".usdc", ".usdz"])
def test_usd_validators_accept_files(tmp_path, ending):
    from pxr import Usd, UsdValidation

    export_levels(tmp_path / f"a{ending}", flod())
    stage = Usd.Stage.Open(str(tmp_path / f"a{ending}"))
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    errors = UsdValidation.ValidationContext(validators).Validate(stage)
    assert len(validators) >= 30 and not [error.GetMessage() for error in errors]
    assert {path.name for path in tmp_path.iterdir()} == {f"a{ending}"}


def test_usd_selects_the_level_of_the_rule(tmp_path):
    """A small scene, so that all its splats are at about one distance: usd-core selects as the rule does."""
    bundle = flod()
    for level in bundle.levels:
        level.splats = replace(level.splats, means=level.splats.means * np.float32(1e-4))
    export_levels(tmp_path / "a.usdc", bundle)
    usd = load_usd()
    stage = usd.Usd.Stage.Open(str(tmp_path / "a.usdc"))
    heuristic = usd.UsdLod.DistanceHeuristic(stage.GetPrimAtPath("/World/SplatDistances"))
    values = resolve_rule("bands").resolve_controls({"first": 1, "last": 3}, [1, 2, 3], bundle.controls)
    for distance in (10, 49, 51, 190, 210, 1000):  # s_min · 500 pixels = 50 and 200
        expected = len(select(bundle, np.array([0, 0, distance], np.float32), 500, values)[0])
        index = heuristic.ComputeLOD(usd.Gf.Vec3d(0, 0, distance), usd.Gf.Matrix4d(1))
        assert len(bundle.levels[2 - round(index)].splats) == expected, distance


def test_octree_levels_fade_where_their_splats_do(tmp_path):
    rule = resolve_rule("octree")
    levels = [Level(number, random_splats(30, 0, number)) for number in (1, 2, 3)]
    bundle = Bundle("octree", levels, "octree", {"d_max": 8.0, "d_max_focal": 1000.0}, cumulative=True)
    expected = [8 * 2.0 ** -(n - 1.75) for n in (2, 3)]  # target level n + 1 - 3/4, without bias
    np.testing.assert_allclose(level_distances(rule, bundle, 1000.0), [*expected, 0], rtol=1e-3)
    export_levels(tmp_path / "a.usdc", bundle)
    usd = load_usd()
    stage = usd.Usd.Stage.Open(str(tmp_path / "a.usdc"))
    heuristic = usd.UsdLod.DistanceHeuristic(stage.GetPrimAtPath("/World/SplatDistances"))
    radius = portable_levels(bundle)[0].sphere()[1]
    np.testing.assert_allclose(
        np.array(heuristic.GetBlendThresholdsAttr().Get()) - radius, expected[::-1], rtol=1e-2
    )
    thresholds = np.array(heuristic.GetThresholdsAttr().Get()) - radius
    np.testing.assert_allclose(thresholds, np.array(expected[::-1]) / 2**0.5, rtol=1e-2)
    reread = read(tmp_path / "a.usdc")
    assert [len(level.splats) for level in reread.levels] == [30, 60, 90] and reread.rule == "chunks"


def test_single_splats_become_nested_levels():
    """CLoD-GS: a level contains the splats with the longest reach, and is used if no others are visible."""
    splats = random_splats(9000, 0)
    rng = np.random.default_rng(0)
    splats.extras["sigma_d"] = rng.uniform(0.1, 2, 9000).astype(np.float32)
    bundle = Bundle("clod", [Level(1, splats)], "decay", {"reference": 10.0, "tau": 0.01})
    levels, notes = portable_levels(bundle)
    assert [len(level.rows) for level in levels.bundle.levels] == [562, 2250, 9000]
    assert "9,000 splats" in notes[0]
    for level, distance in zip(levels.bundle.levels[:-1], levels.distances[:-1], strict=True):
        for factor, more in ((0.99, True), (1.01, False)):
            at = splats.select(slice(None))
            at.means = np.zeros_like(at.means) + np.float32([distance * factor, 0, 0])
            visible = len(
                select(replace(bundle, levels=[Level(1, at)]), np.zeros(3), 500, {"s_v": 1, "at_most": 0})[0]
            )
            assert (visible > len(level.rows)) is more


def test_cameras_match_the_views(stage):
    usd = load_usd()
    prims = [prim for prim in stage.Traverse() if prim.GetTypeName() == "Camera"]
    assert [prim.GetName() for prim in prims] == ["a_b", "a_b_2", "c"]
    assert prims[0].GetDisplayName() == "images/a b.jpg"
    view = camera()
    point = np.array([0.4, 0.2, 1.5])
    x, y, z = (view.world_to_camera @ [*point, 1])[:3]
    pixel = view.fx * x / z + view.cx, view.fy * y / z + view.cy
    frustum = usd.UsdGeom.Camera(prims[0]).GetCamera(usd.Usd.TimeCode.Default()).frustum
    placed = (
        usd.UsdGeom.XformCache()
        .GetLocalToWorldTransform(stage.GetPrimAtPath("/World"))
        .Transform(usd.Gf.Vec3d(*point))
    )
    x, y, _ = (frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()).Transform(placed)
    np.testing.assert_allclose([(x + 1) / 2 * 640, (1 - y) / 2 * 480], pixel, atol=1e-2)


@pytest.mark.parametrize("ending", [".usdc", pytest.param(".usdz", marks=pytest.mark.nightly)])
def test_levels_round_trip(tmp_path, ending):
    bundle = flod(antialias=True)
    export_levels(tmp_path / f"a{ending}", bundle, FileOptions(antialiased=True))
    reread = read(tmp_path / f"a{ending}")
    assert (reread.method, reread.rule, reread.antialias) == ("flod", "bands", True)
    for level, original in zip(reread.levels, bundle.levels, strict=True):
        assert level.facts == original.facts
        assert_equal(level.splats, original.splats)


def test_files_behind_links_are_prepared_beside_their_target(tmp_path, monkeypatch):
    """A rename cannot move them to another disk."""
    folders = []

    def record(parent):
        folders.append(parent)
        return temporary_folder(parent)

    monkeypatch.setattr(usd_module, "temporary_folder", record)
    (tmp_path / "disk").mkdir()
    (tmp_path / "disk" / "b.usdc").touch()
    (tmp_path / "a.usdc").symlink_to(tmp_path / "disk" / "b.usdc")
    export_levels(tmp_path / "a.usdc", flod(0))
    assert folders == [tmp_path / "disk"] and (tmp_path / "a.usdc").is_symlink()
    assert read(tmp_path / "a.usdc").method == "flod"


@pytest.mark.skipif(sys.platform != "linux", reason="other systems refuse such names")
def test_names_that_are_not_utf_8(tmp_path):
    folder = tmp_path / os.fsdecode(b"\xff")
    folder.mkdir()
    with pytest.raises(LodgsError, match="its path is not UTF-8, as USD requires"):
        export_levels(folder / "a.usdc", flod(0))
    bundle = flod(0)
    bundle.tables = make_view_tables([camera(os.fsdecode(b"\xff.jpg"))], 0.05)
    for name in ("a.usdc", "a.glb"):
        export_levels(tmp_path / name, bundle)
        assert read(tmp_path / name).method == "flod"


def test_levels_of_several_degrees_return_with_the_highest(tmp_path):
    levels = [Level(number, random_splats(9, degree)) for number, degree in ((1, 1), (2, 3))]
    export_levels(tmp_path / "a.usdc", Bundle("", levels))
    for level, original in zip(read(tmp_path / "a.usdc").levels, levels, strict=True):
        assert_equal(level.splats, original.splats.padded(3))


def test_truncated_packages_are_reported(tmp_path, monkeypatch):
    """usd-core returns True after it filled the disk."""
    usd = load_usd()
    create = usd.UsdUtils.CreateNewUsdzPackage

    def create_truncated(asset, package):
        assert create(asset, package)
        os.truncate(package, 4096)
        return True

    monkeypatch.setattr(usd.UsdUtils, "CreateNewUsdzPackage", create_truncated)
    with pytest.raises(LodgsError, match=r"Cannot write .*a\.usdz: the package cannot be written"):
        export_levels(tmp_path / "a.usdz", flod(0))
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=0))
    with pytest.raises(LodgsError, match=r"Cannot write .*a\.usdz: No space left"):
        export_levels(tmp_path / "a.usdz", flod(0))
    assert not list(tmp_path.iterdir())


def test_packages_do_not_depend_on_the_time(tmp_path, monkeypatch):
    export_levels(tmp_path / "a.usdz", flod(0))
    write = usd_module._write_stage

    def write_earlier(usd, path, levels):
        write(usd, path, levels)
        os.utime(path, (1e9, 1e9))

    monkeypatch.setattr(usd_module, "_write_stage", write_earlier)
    export_levels(tmp_path / "b.usdz", flod(0))
    assert (tmp_path / "a.usdz").read_bytes() == (tmp_path / "b.usdz").read_bytes()


@pytest.mark.parametrize("edited", [pytest.param(False, marks=pytest.mark.nightly), True])
def test_original_place_survives(tmp_path, edited):
    """UTM coordinates return within a tenth of a millimetre, also after another program moved the scene."""
    origin = [448_250.0, 5_411_900.0, 300.0]
    bundle = flod(origin=origin)
    export_levels(tmp_path / "a.usdc", bundle, FileOptions(original_place=True))
    if edited:
        usd = load_usd()
        stage = usd.Usd.Stage.Open(str(tmp_path / "a.usdc"))
        usd.UsdGeom.Xformable(stage.GetPrimAtPath("/World")).AddTranslateOp(opSuffix="by").Set((1.0, 0, 0))
        stage.GetRootLayer().customLayerData = {}
        stage.GetRootLayer().Save()
        del stage
    reread = read(tmp_path / "a.usdc")
    expected = bundle.levels[2].splats.means.astype(np.float64) + origin
    actual = reread.levels[2].splats.means.astype(np.float64) + reread.origin
    if edited:
        expected = (expected + np.array([1.0, 0, 0])) @ np.array(UP).T
        actual = actual @ reread.up_rotation.T
    np.testing.assert_allclose(actual, expected, atol=1e-4)


def foreign(tmp_path, **attributes):
    """Write a particle field as another program does: y up, two fields, no levels."""
    usd = load_usd()
    stage = usd.Usd.Stage.CreateNew(str(tmp_path / "b.usdc"))
    usd.UsdGeom.SetStageUpAxis(stage, "Y")
    values = {
        "positions": [(0, 1, 0)], "scales": [(0.1, 0.2, 0.3)], "orientations": [(1, 0, 0, 0)],
        "opacities": [0.5], "radiance:sphericalHarmonicsDegree": 0,
        "radiance:sphericalHarmonicsCoefficients": [(1, 2, 3)],
    } | attributes  # fmt: skip
    for name in "ab":
        prim = usd.UsdVol.ParticleField3DGaussianSplat.Define(stage, f"/{name}").GetPrim()
        for key, value in values.items():
            if key == "orientations":
                value = [usd.Gf.Quatf(*quat) for quat in value]
            prim.GetAttribute(key).Set(value)
    stage.GetRootLayer().Save()
    return stage


def test_files_of_other_programs_are_read(tmp_path):
    foreign(tmp_path)
    bundle = read(tmp_path / "b.usdc")
    (level,) = bundle.levels
    assert len(level.splats) == 2 and not bundle.rule
    np.testing.assert_allclose(bundle.up_rotation @ level.splats.means[0], [0, 0, 1])
    np.testing.assert_allclose(np.exp(level.splats.log_scales[0]), [0.1, 0.2, 0.3], rtol=1e-5)
    assert level.splats.sh.tolist()[0] == [[1, 2, 3]] and level.splats.opacity_logits[0] == 0


def test_attributes_without_a_value_for_each_splat_have_the_defaults_of_the_schema(tmp_path):
    foreign(tmp_path, scales=[], orientations=[], opacities=[0.5, 0.7])
    splats = read(tmp_path / "b.usdc").levels[0].splats
    np.testing.assert_allclose(splats.log_scales, 0)
    np.testing.assert_allclose(np.abs(splats.quats), [[1, 0, 0, 0]] * 2)
    np.testing.assert_allclose(splats.opacity_logits, 0)
    foreign(tmp_path, opacities=[])
    assert (read(tmp_path / "b.usdc").levels[0].splats.opacity_logits > 5).all()


@pytest.mark.parametrize("suffix", [".usda", ".usd"])
def test_other_suffixes(tmp_path, suffix):
    foreign(tmp_path).Export(str(tmp_path / f"a{suffix}"))
    assert len(read(tmp_path / f"a{suffix}").levels[0].splats) == 2


def test_first_frame_of_animated_splats(tmp_path):
    """Houdini and Omniverse write time samples without a default value."""
    stage = foreign(tmp_path)
    for prim in stage.Traverse():
        for attribute in prim.GetAuthoredAttributes():
            value = attribute.Get()
            attribute.Clear()
            attribute.Set(value, 1.0)
            attribute.Set(value, 24.0)
    stage.GetRootLayer().Save()
    np.testing.assert_array_equal(read(tmp_path / "b.usdc").levels[0].splats.means, [[0, 1, 0]] * 2)


def test_units_are_converted_to_metres(tmp_path):
    usd = load_usd()
    stage = foreign(tmp_path)
    usd.UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    stage.GetRootLayer().Save()
    splats = read(tmp_path / "b.usdc").levels[0].splats
    np.testing.assert_allclose(splats.means[0], [0, 0.01, 0], rtol=1e-6)
    np.testing.assert_allclose(np.exp(splats.log_scales[0]), [0.001, 0.002, 0.003], rtol=1e-5)


@pytest.mark.parametrize("unit", [0.0, -1.0, float("nan"), float("inf")])
def test_units_without_a_length_are_ignored(tmp_path, unit):
    stage = foreign(tmp_path)
    stage.SetMetadata("metersPerUnit", unit)
    stage.GetRootLayer().Save()
    np.testing.assert_array_equal(read(tmp_path / "b.usdc").levels[0].splats.means[0], [0, 1, 0])


def test_undrawable_splats_are_dropped_with_a_warning(tmp_path):
    foreign(tmp_path, scales=[(0.1, float("nan"), 0.3)])
    warnings = []
    assert not len(read(tmp_path / "b.usdc", warnings.append).levels[0].splats)
    assert len(warnings) == 1 and warnings[0].startswith("2 splats of ")


@pytest.mark.parametrize(
    ("attributes", "reason"),
    [
        ({"radiance:sphericalHarmonicsDegree": 9}, "SH degree is 9"),
        ({"radiance:sphericalHarmonicsDegree": 1}, "/a has 1 coefficients for 1 splats of SH degree 1"),
    ],
)
def test_inconsistent_fields_raise_one_sentence(tmp_path, attributes, reason):
    foreign(tmp_path, **attributes)
    with pytest.raises(LodgsError, match=reason):
        read(tmp_path / "b.usdc")


def test_missing_and_excess_harmonics_follow_the_schema(tmp_path):
    """Fields without coefficients are grey, of degree 0, whatever their degree says (default: 3)."""
    name = "radiance:sphericalHarmonicsCoefficients"
    foreign(tmp_path, **{name: [], "radiance:sphericalHarmonicsDegree": 3})
    assert read(tmp_path / "b.usdc").levels[0].splats.sh.tolist() == [[[0, 0, 0]]] * 2
    foreign(tmp_path, **{name: [(1, 2, 3), (4, 5, 6)]})
    assert read(tmp_path / "b.usdc").levels[0].splats.sh.tolist() == [[[1, 2, 3]]] * 2


def test_fields_of_several_degrees_keep_their_harmonics(tmp_path):
    """The highest degree holds for all; a field of a lower one, or a grey one, has zeros."""
    stage = foreign(tmp_path)
    prim = stage.GetPrimAtPath("/b")
    prim.GetAttribute("radiance:sphericalHarmonicsDegree").Set(1)
    colors = [(1, 2, 3), (4, 0, 0), (0, 5, 0), (0, 0, 6)]
    prim.GetAttribute("radiance:sphericalHarmonicsCoefficients").Set(colors)
    stage.GetRootLayer().Save()
    first, second = read(tmp_path / "b.usdc").levels[0].splats.sh
    assert first.tolist() == [[1, 2, 3], [0, 0, 0], [0, 0, 0], [0, 0, 0]]
    assert second.tolist()[0] == [1, 2, 3]
    np.testing.assert_allclose(np.linalg.norm(second[1:]), np.sqrt(16 + 25 + 36), rtol=1e-5)


FIELD = """def ParticleField3DGaussianSplat "{}" {{
    point3f[] positions = [({}, 0, 0)]
    float3[] radiance:sphericalHarmonicsCoefficients = [(1, 0, 0)]
    int radiance:sphericalHarmonicsDegree = 0
    {}
}}
"""


def write_scene(path, body):
    path.write_text(f'#usda 1.0\n(upAxis = "Z")\n{body}', encoding="utf-8")


def x_positions(path):
    """Return the sorted positions of each level, coarse to fine."""
    return [sorted(level.splats.means[:, 0].tolist()) for level in read(path).levels]


def test_roots_of_levels_and_fields_outside_are_joined(tmp_path):
    scene, root = tmp_path / "a.usda", 'def Xform "{}" (prepend apiSchemas = ["LODRootAPI"]) {{\n{}}}\n'
    fields = [FIELD.format(f"f{x}", x, "") for x in range(7)]
    write_scene(scene, root.format("A", fields[0] + fields[1] + fields[2]))
    assert x_positions(scene) == [[2], [1], [0]]
    parts = root.format("A", "".join(fields[:3])), root.format("B", "".join(fields[3:5])), fields[6]
    write_scene(scene, "".join(parts))
    assert x_positions(scene) == [[2, 4, 6], [1, 4, 6], [0, 3, 6]]


def test_fields_that_renderers_hide_are_left_out(tmp_path):
    hidden = (
        'token visibility = "invisible"',
        *(f'uniform token purpose = "{p}"' for p in ("proxy", "guide")),
    )
    fields = [FIELD.format(f"f{x}", x, line) for x, line in enumerate(["", *hidden])]
    write_scene(tmp_path / "a.usda", "".join(fields))
    assert x_positions(tmp_path / "a.usda") == [[0]]
    write_scene(tmp_path / "a.usda", "".join(fields[1:]))
    assert x_positions(tmp_path / "a.usda") == [[1, 2, 3]]


@pytest.mark.parametrize("instanceable", ["true", "false"])
def test_references_within_a_file_are_followed(tmp_path, instanceable):
    copy = f"""def Xform "B" (
        instanceable = {instanceable}
        prepend references = </A>
    ) {{
        double3 xformOp:translate = (5, 0, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }}"""
    write_scene(tmp_path / "a.usda", f'def Xform "A" {{\n{FIELD.format("f", 1, "")}}}\n{copy}\n')
    assert x_positions(tmp_path / "a.usda") == [[1, 6]]


def test_syntax_errors_name_the_line(tmp_path):
    write_scene(tmp_path / "a.usda", "\n\ndef {")
    with pytest.raises(LodgsError, match=r"it is damaged .*a\.usda:5:1: parse error") as error:
        read(tmp_path / "a.usda")
    assert "Error in" not in error.value.what


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such names")
def test_names_that_are_not_utf8_are_reported(tmp_path):
    path = tmp_path / "a\udcff.usda"
    write_scene(path, FIELD.format("f", 1, ""))
    with pytest.raises(LodgsError, match="not UTF-8") as error:
        read(path)
    assert error.value.remedy == "Rename it."


def test_other_files_are_not_opened(tmp_path):
    stage = foreign(tmp_path)
    stage.GetRootLayer().subLayerPaths.append("../secret.usdc")
    stage.GetRootLayer().Save()
    with pytest.raises(LodgsError, match=r"refers to other files \(../secret.usdc\)"):
        read(tmp_path / "b.usdc")


@pytest.mark.parametrize("reference", ["b.usdc", "middle.usda", "../b.usdc", "/absolute/b.usdc", "gone.usdc"])
def test_layers_of_a_package_refer_only_to_each_other(tmp_path, reference):
    """3DGRUT packs one layer that refers to the splats; ``middle`` leads out of the package."""
    usd = load_usd()
    foreign(tmp_path)
    for name, target in (("main.usda", reference), ("middle.usda", str(tmp_path / "b.usdc"))):
        layer = usd.Sdf.Layer.CreateNew(str(tmp_path / name))
        prim = usd.Sdf.CreatePrimInLayer(layer, "/a")
        prim.specifier = usd.Sdf.SpecifierDef
        prim.referenceList.prependedItems.append(usd.Sdf.Reference(target, "/a"))
        layer.Save()
    package = usd.Sdf.ZipFileWriter.CreateNew(str(tmp_path / "b.usdz"))
    for name in ("main.usda", "middle.usda", "b.usdc"):
        package.AddFile(str(tmp_path / name), name)
    package.Save()
    if reference == "b.usdc":
        assert len(read(tmp_path / "b.usdz").levels[0].splats) == 1
    else:
        with pytest.raises(LodgsError, match="refers to other files"):
            read(tmp_path / "b.usdz")


@pytest.mark.parametrize("part", [0, 3000, *(pytest.param(n, marks=pytest.mark.nightly) for n in (40, -100))])
def test_cut_files_raise_one_sentence(tmp_path, part):
    export_levels(tmp_path / "a.usdc", flod())
    (tmp_path / "b.usdc").write_bytes((tmp_path / "a.usdc").read_bytes()[:part])
    with pytest.raises(LodgsError, match="Cannot read"):
        read(tmp_path / "b.usdc")


def test_blender_process_does_not_load_our_usd(tmp_path):
    code = "import sys, types; sys.modules['bpy'] = types.ModuleType('bpy')\n" \
        "from training.splats.usd import load_usd\n" \
        "try: load_usd()\nexcept Exception as error: print(error, 'pxr' in sys.modules)"  # fmt: skip
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "Blender's own process" in result.stdout and result.stdout.strip().endswith("False"), result


def test_reading_process_ends_with_its_parent(tmp_path):
    foreign(tmp_path)
    command = [sys.executable, "-m", "training.splats.usd_process", tmp_path / "b.usdc", tmp_path / "b.ply"]
    with subprocess.Popen([str(word) for word in command], stdin=subprocess.PIPE) as process:
        process.stdin.close()
        assert process.wait(30) == 1
    assert not (tmp_path / "b.ply").exists()


@pytest.mark.skipif(sys.platform != "linux", reason="other systems do not limit a process's memory")
def test_reading_process_has_little_memory(tmp_path):
    """A file of 300 KB can declare 300 million opacities of 0."""
    (tmp_path / "a.usdc").write_bytes(bytes(300_000))
    program = (
        "import sys, pathlib, numpy; from training.splats.usd_process import limit_memory;"
        "limit_memory(pathlib.Path(sys.argv[1]));"
        "numpy.ones(20_000_000); print('small'); numpy.ones(150_000_000)"
    )
    result = subprocess.run(
        [sys.executable, "-c", program, tmp_path / "a.usdc"], capture_output=True, text=True, check=False
    )
    assert result.stdout == "small\n" and "Unable to allocate" in result.stderr

"""Operators that import and export bundles and plain files. Plyfile and file contents are the reference."""

import json
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import plyfile
import pytest


@pytest.fixture
def bundle(lodgs):
    """Three FLoD-like levels with an extra column, within 20 units of the origin."""
    rng, bundles = np.random.default_rng(3), lodgs("training.splats.bundle")

    def level(number: int, count: int, s_min: float):
        splats = lodgs("training.splats.gaussians").Splats(
            means=rng.uniform(-20, 20, (count, 3)).astype(np.float32),
            quats=rng.standard_normal((count, 4)).astype(np.float32),
            log_scales=rng.normal(-3, 2, (count, 3)).astype(np.float32),
            opacity_logits=rng.normal(0, 5, count).astype(np.float32),
            sh=rng.standard_normal((count, 16, 3)).astype(np.float32),
            extras={"sigma": rng.random(count, np.float32)},
        )
        return bundles.Level(number, splats, {"s_min": s_min})

    meta = {"camera_center": [1.0, 2.0, 3.0], "focal_px": 500.0, "seed": 4}
    levels = [level(1, 200, 0.02), level(2, 500, 0.005), level(3, 1500, 0.0)]
    return bundles.Bundle("flod", levels, "bands", {}, {"gamma": 1.5}, meta=meta)


@pytest.fixture
def file(lodgs, bundle, tmp_path):
    path = tmp_path / "scène 1.ply"
    lodgs("training.splats.bundle").write_bundle(path, bundle)
    return path


def only_root(bpy):
    (root,) = [o for o in bpy.data.objects if o.lodgs.is_root]
    return root


@pytest.mark.parametrize("count", [0, 9])
def test_file_without_splats_to_draw_is_refused(bpy, lodgs, bundle, tmp_path, count):
    splats = bundle.levels[0].splats.select(slice(0, count))
    splats.means[:] = np.nan
    lodgs("training.splats.ply").write_ply(tmp_path / "nan.ply", splats)
    with pytest.raises(RuntimeError, match=r"nan\.ply: it has no splats that can be drawn"):
        bpy.ops.lodgs.import_splats(filepath=str(tmp_path / "nan.ply"))
    assert not bpy.data.objects and not bpy.data.collections


def test_bundle_round_trip_is_identical(bpy, bundle, file, tmp_path):
    assert bpy.ops.lodgs.import_splats(filepath=str(file)) == {"FINISHED"}
    settings = only_root(bpy).lodgs
    assert [(i.number, len(i.object.data.points), json.loads(i.facts)) for i in settings.levels] == [
        (1, 200, {"s_min": 0.02}), (2, 500, {"s_min": 0.005}), (3, 1500, {"s_min": 0.0})
    ]  # fmt: skip
    assert (settings.method, settings.rule, settings.bands.gamma) == ("flod", "bands", 1.5)
    assert tuple(settings.camera_center) == (1, 2, 3)
    assert (settings.mode, settings.single_level) == ("SINGLE", 3)
    assert (settings.bands.first, settings.bands.last) == (1, 3)

    out = tmp_path / "out.ply"
    assert bpy.ops.lodgs.export_bundle(filepath=str(out)) == {"FINISHED"}
    assert out.read_bytes() == file.read_bytes()


def test_five_levels_of_flod_scaffold(bpy, lodgs, bundle, tmp_path):
    sizes, files = [0.2, 0.05, 0.0125, 0.003125, 0.0], lodgs("training.splats.bundle")
    splats = bundle.levels[0].splats
    splats.extras = {}
    levels = [files.Level(number, splats, {"s_min": size}) for number, size in enumerate(sizes, 1)]
    five = files.Bundle("flod_scaffold", levels, "bands", {}, {"gamma": 1.0}, meta=bundle.meta)
    files.write_bundle(tmp_path / "five.ply", five)
    assert bpy.ops.lodgs.import_splats(filepath=str(tmp_path / "five.ply")) == {"FINISHED"}
    settings = only_root(bpy).lodgs
    assert (settings.method, settings.rule, settings.single_level) == ("flod_scaffold", "bands", 5)
    assert [json.loads(item.facts)["s_min"] for item in settings.levels] == sizes
    assert [len(item.object.data.points) for item in settings.levels] == [200] * 5
    for number in range(1, 6):
        settings.single_level = number
        bpy.context.view_layer.update()
        assert [item.object.visible_get() for item in settings.levels] == [n == number for n in range(1, 6)]


def test_first_bundle_sets_the_viewports_to_its_view(bpy, lodgs, bundle, tmp_path):
    """A camera at (1, 0, -5) looks along +z with -y up. In Blender, it looks along +y from y = -5."""
    bundle.meta |= {"view": [[1, 0, -5], [1, 0, 3]], "up_rotation": [[1, 0, 0], [0, 0, 1], [0, -1, 0]]}
    path = tmp_path / "view.ply"
    lodgs("training.splats.bundle").write_bundle(path, bundle)
    views = [area.spaces.active.region_3d for area in bpy.context.screen.areas if area.type == "VIEW_3D"]
    assert views
    assert bpy.ops.lodgs.import_splats(filepath=str(path)) == {"FINISHED"}
    for view in views:
        assert tuple(view.view_location) == pytest.approx((1, 3, 0), abs=1e-5)
        assert view.view_distance == pytest.approx(8)
        direction = view.view_rotation.to_matrix() @ type(view.view_location)((0, 0, -1))
        assert tuple(direction) == pytest.approx((0, 1, 0), abs=1e-5)
        view.view_distance = 1.0
    bpy.ops.lodgs.import_splats(filepath=str(path))
    assert [view.view_distance for view in views] == [1.0] * len(views)


@pytest.mark.parametrize("view", [[[0, 0, 0]], "far", [[0, 0, None], [0, 0, 1]]])
def test_invalid_view_is_rejected(bpy, lodgs, bundle, tmp_path, view):
    bundle.meta |= {"view": view}
    path = tmp_path / "view.ply"
    lodgs("training.splats.bundle").write_bundle(path, bundle)
    with pytest.raises(RuntimeError, match="is inconsistent"):
        bpy.ops.lodgs.import_splats(filepath=str(path))


def test_bundle_survives_saving(bpy, file, tmp_path):
    bpy.ops.lodgs.import_splats(filepath=str(file))
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    bpy.ops.lodgs.export_bundle(filepath=str(tmp_path / "out.ply"))
    assert (tmp_path / "out.ply").read_bytes() == file.read_bytes()


def test_several_dropped_files_import(bpy, lodgs, bundle, tmp_path):
    for level in bundle.levels[:2]:
        lodgs("training.splats.ply").write_ply(tmp_path / f"plain{level.number}.ply", level.splats)
    bpy.ops.lodgs.import_splats(
        "INVOKE_DEFAULT", directory=str(tmp_path), files=[{"name": "plain1.ply"}, {"name": "plain2.ply"}]
    )
    roots = [o for o in bpy.data.objects if o.lodgs.is_root]
    assert sorted(o.name for o in roots) == ["plain1", "plain2"]
    for root in roots:
        (item,) = root.lodgs.levels
        assert (root.lodgs.method, root.lodgs.rule, item.facts) == ("", "", "{}")
    bpy.context.view_layer.objects.active = bpy.data.objects["plain2"]
    bpy.ops.lodgs.export_plain(filepath=str(tmp_path / "out.ply"))
    assert (tmp_path / "out.ply").read_bytes() == (tmp_path / "plain2.ply").read_bytes()


def test_relative_paths_of_scripts_are_those_of_the_file(bpy, lodgs, tmp_path):
    """Path would turn "//" to a backslash on Windows."""
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "file.blend"))
    operator = lodgs("operators.import_splats").LODGS_OT_import_splats
    for options in (
        {"filepath": "//a.ply", "directory": "", "files": []},
        {"filepath": "", "directory": "//", "files": [SimpleNamespace(name="a.ply")]},
    ):
        assert operator.paths(SimpleNamespace(**options)) == [tmp_path / "a.ply"]


def test_foreign_2d_filter_round_trip(bpy, lodgs, bundle, tmp_path):
    splats = bundle.levels[0].splats
    lodgs("training.splats.ply").write_ply(tmp_path / "mip.ply", splats, ["SplatRenderMode: mip"])
    messages = []
    root = lodgs("data.importing").import_splats(bpy.context, tmp_path / "mip.ply", warn=messages.append)
    assert messages == [] and root.lodgs.antialias
    bpy.context.view_layer.objects.active = bpy.data.objects["mip"]
    for source in ("SHOWN", "LEVEL"):
        bpy.ops.lodgs.export_plain(filepath=str(tmp_path / "out.ply"), source=source)
        assert (tmp_path / "out.ply").read_bytes().count(b"\ncomment SplatRenderMode: mip\n") == 1


def test_upright_turns_minus_y_up(bpy, lodgs, file):
    root = lodgs("data.importing").import_splats(bpy.context, file)
    bpy.context.view_layer.update()
    assert np.array(root.lodgs.axes.matrix_world)[:3, :3] @ [0, -1, 0] == pytest.approx([0, 0, 1], abs=1e-6)


def test_upright_uses_the_bundles_rotation(bpy, lodgs, bundle, tmp_path):
    rotation = np.array([[0, 0.6, 0.8], [1, 0, 0], [0, 0.8, -0.6]])
    bundle.meta["up_rotation"] = rotation
    lodgs("training.splats.bundle").write_bundle(tmp_path / "b.ply", bundle)
    root = lodgs("data.importing").import_splats(bpy.context, tmp_path / "b.ply")
    bpy.context.view_layer.update()
    assert np.array(root.lodgs.axes.matrix_world)[:3, :3] == pytest.approx(rotation, abs=1e-6)


def test_one_level_and_visible_splats_are_exported(bpy, lodgs, bundle, file, tmp_path):
    bpy.ops.lodgs.import_splats(filepath=str(file))
    root, out = only_root(bpy), tmp_path / "out.ply"
    bpy.ops.lodgs.export_plain(filepath=str(out), source="LEVEL", level=2)
    vertex = plyfile.PlyData.read(out)["vertex"]
    splats = bundle.levels[1].splats
    assert np.array_equal(np.column_stack([vertex[k] for k in "xyz"]), splats.means)
    assert np.array_equal(vertex["opacity"], splats.opacity_logits)
    assert np.array_equal(vertex["scale_1"], splats.log_scales[:, 1])
    assert np.array_equal(vertex["rot_0"], splats.quats[:, 0])
    assert np.array_equal(vertex["f_rest_15"], splats.sh[:, 1, 1])

    root.lodgs.mode, root.lodgs.camera_choice, root.lodgs.bands.gamma = "SELECTIVE", "TRAINING", 1.0
    bpy.context.view_layer.update()
    bpy.ops.lodgs.export_plain(filepath=str(out), source="SHOWN")
    f = root.lodgs.focal_px
    expected = []
    for level, near, far in zip(
        bundle.levels, [0.02 * f, 0.005 * f, 0], [np.inf, 0.02 * f, 0.005 * f], strict=True
    ):
        distance = np.linalg.norm(level.splats.means.astype(float) - [1, 2, 3], axis=1)
        expected.append(level.splats.select((distance >= near) & (distance < far)))
    assert all(len(part) for part in expected[1:])
    vertex = plyfile.PlyData.read(out)["vertex"]
    assert np.array_equal(vertex["scale_2"], np.concatenate([part.log_scales[:, 2] for part in expected]))
    assert np.array_equal(vertex["f_rest_44"], np.concatenate([part.sh[:, 15, 2] for part in expected]))
    assert lodgs("data.scenes").count_visible(bpy.context, root) == (sum(map(len, expected)), 2200)

    for item in root.lodgs.levels:
        item.show = False
    bpy.context.view_layer.update()
    with pytest.raises(RuntimeError, match="no splats of 'scène 1' are shown"):
        bpy.ops.lodgs.export_plain(filepath=str(tmp_path / "none.ply"))
    assert not (tmp_path / "none.ply").exists()


def test_visible_export_covers_the_scene_only(bpy, lodgs, file, tmp_path):
    """A moved level and a copy of it are drawn, but the export ignores both. Its tooltip says so."""
    bpy.ops.lodgs.import_splats(filepath=str(file))
    root, out = only_root(bpy), [tmp_path / "before.ply", tmp_path / "after.ply"]
    bpy.ops.lodgs.export_plain(filepath=str(out[0]))
    obj = root.lodgs.levels[2].object
    obj.location, obj.rotation_euler, root.scale = (1, 2, 3), (0, 1, 0), (2, 2, 2)
    copy = obj.copy()
    bpy.context.scene.collection.objects.link(copy)
    bpy.context.view_layer.update()
    bpy.ops.lodgs.export_plain(filepath=str(out[1]))
    assert out[0].read_bytes() == out[1].read_bytes()
    placed = bpy.ops.lodgs.export_plain.get_rna_type().properties["placed"]
    assert "COLMAP's coordinates" in placed.description and not placed.default


def test_show_only_level_hides_other_levels(bpy, file):
    bpy.ops.lodgs.import_splats(filepath=str(file))
    settings = only_root(bpy).lodgs
    settings.mode, settings.levels[0].show = "SELECTIVE", False
    bpy.ops.lodgs.show_only_level(level=1)
    bpy.context.view_layer.update()
    assert [i.object.visible_get() for i in settings.levels] == [True, False, False]


def test_deleted_level_is_not_exported(bpy, bundle, file, tmp_path):
    bpy.ops.lodgs.import_splats(filepath=str(file))
    root = only_root(bpy)
    bpy.data.objects.remove(root.lodgs.levels[1].object)
    bpy.ops.lodgs.export_bundle(filepath=str(tmp_path / "out.ply"))
    elements = plyfile.PlyData.read(tmp_path / "out.ply").elements
    assert [e.count for e in elements if "vertex" in e.name] == [1500, 200]
    with pytest.raises(RuntimeError, match="no level 2"):
        bpy.ops.lodgs.export_plain(filepath=str(tmp_path / "x.ply"), source="LEVEL", level=2)


def test_export_folder_writes_levels_and_replaces_on_request(bpy, bundle, file, tmp_path):
    bpy.ops.lodgs.import_splats(filepath=str(file))
    folder = tmp_path / "new" / "levels"
    assert bpy.ops.lodgs.export_folder(directory=str(folder)) == {"FINISHED"}
    for lod, level in enumerate(reversed(bundle.levels)):
        vertex = plyfile.PlyData.read(folder / f"lod{lod}.ply")["vertex"]
        assert np.array_equal(vertex["x"], level.splats.means[:, 0])
    assert len(json.loads((folder / "manifest.json").read_text())["levels"]) == 3
    with pytest.raises(RuntimeError, match="already holds levels"):
        bpy.ops.lodgs.export_folder(directory=str(folder))
    assert bpy.ops.lodgs.export_folder(directory=str(folder), replace=True) == {"FINISHED"}


def test_invalid_files_are_rejected(bpy, file, tmp_path):
    short = tmp_path / "short.ply"
    short.write_bytes(file.read_bytes()[:-100])
    (tmp_path / "text.ply").write_text("hello")
    for name in ("short.ply", "text.ply", "absent.ply"):
        with pytest.raises(RuntimeError, match=name):
            bpy.ops.lodgs.import_splats(filepath=str(tmp_path / name))
    assert not bpy.data.objects and not bpy.data.pointclouds and not bpy.data.collections
    assert not bpy.ops.lodgs.export_bundle.poll()


def test_unwritable_path_is_rejected(bpy, file, tmp_path):
    bpy.ops.lodgs.import_splats(filepath=str(file))
    (tmp_path / "blocked").write_text("a file, not a folder")
    with pytest.raises(RuntimeError, match="Cannot write"):
        bpy.ops.lodgs.export_bundle(filepath=str(tmp_path / "blocked" / "out.ply"))


def test_undo_removes_an_import(bpy, file):
    bpy.ops.ed.undo_push(message="before")
    bpy.ops.lodgs.import_splats("EXEC_DEFAULT", True, filepath=str(file))
    assert len(bpy.data.pointclouds) == 3
    bpy.ops.ed.undo()
    assert not bpy.data.pointclouds and not bpy.data.objects and not bpy.data.node_groups


def test_import_stopped_after_a_file_is_an_undo_step(bpy, lodgs, file):
    """Otherwise the next undo would remove the imported file together with the change before."""
    methods = vars(lodgs("operators.import_splats").LODGS_OT_import_splats)
    names = ("work", "result_text", "status_text", "has_changed_data", "_imported")
    bases = (lodgs("operators.modal").BackgroundOperator,)
    operator = type("Operator", bases, {name: methods[name] for name in names})()
    operator.paths, operator.report = (lambda: [file, file]), (lambda *_: None)
    operator._modal, operator.upright, operator.budget = True, True, 0
    names = ("scene", "view_layer", "collection", "screen", "mode")
    context = MagicMock(**{name: getattr(bpy.context, name) for name in names})
    operator.start_modal(context)
    timer, escape = SimpleNamespace(type="TIMER"), SimpleNamespace(type="ESC")
    assert operator.modal(context, escape) == {"CANCELLED"}, "nothing has changed"
    operator.start_modal(context)
    while not operator.has_changed_data():
        assert operator.modal(context, timer) == {"RUNNING_MODAL"}
    assert operator.modal(context, escape) == {"FINISHED"}


def test_menus_list_import_and_export(bpy):
    for menu in (bpy.types.TOPBAR_MT_file_import, bpy.types.TOPBAR_MT_file_export):
        assert any("lodgs" in f.__module__ for f in menu._dyn_ui_initialize())
    assert bpy.types.LODGS_FH_splats.bl_import_operator == "lodgs.import_splats"


def test_all_properties_have_tooltips(bpy):
    """Operators, their options and scene settings have short names and descriptions."""
    names = [n for n in dir(bpy.ops.lodgs) if not n.startswith("_")]
    types = [getattr(bpy.ops.lodgs, name).get_rna_type() for name in names]
    assert len(types) > 5 and all(rna_type.description for rna_type in types)
    types += [bpy.types.Object.bl_rna.properties["lodgs"].fixed_type]
    for rna_type in types:
        for prop in rna_type.properties:
            is_lodgs = prop.identifier not in {"rna_type", "name", "levels", "training", "files", "directory"}
            if is_lodgs and not prop.is_hidden and "filter" not in prop.identifier:
                assert prop.description, (rna_type.identifier, prop.identifier)
                assert len(prop.name) <= 24, (rna_type.identifier, prop.name)


def test_stepwise_import_can_be_cancelled(bpy, lodgs, bundle, tmp_path):
    """Windows import in steps. Cancelling leaves no data; all steps together equal a direct import."""
    path, scenes, messages = tmp_path / "b.ply", lodgs("data.scenes"), []
    lodgs("training.splats.bundle").write_bundle(path, bundle)
    operator = lodgs("operators.import_splats").LODGS_OT_import_splats

    def data_counts():
        return [len(kind) for kind in (bpy.data.objects, bpy.data.pointclouds, bpy.data.collections)]

    def start_import():
        options = SimpleNamespace(
            paths=lambda: [path], report=lambda kind, text: messages.append(text), budget=0, upright=True,
            _modal=True,
        )  # fmt: skip
        return operator.work(options, bpy.context)

    before, max_levels = data_counts(), 0
    for level in range(4):
        work = start_import()
        while data_counts()[1] - before[1] < level:
            next(work)
        max_levels = max(max_levels, data_counts()[1] - before[1])
        work.close()
        assert data_counts() == before and not lodgs("data.roots").roots(bpy.context.scene)
    assert max_levels == 3 and sum(1 for _ in start_import()) > 3
    (root,) = lodgs("data.roots").roots(bpy.context.scene)
    assert root.name == "b" and [item.object.name for item in root.lodgs.levels] == [
        f"b level {number}" for number in (1, 2, 3)
    ]
    expected = scenes.read_levels(lodgs("data.importing").import_splats(bpy.context, path))
    for level, expected_level in zip(scenes.read_levels(root).levels, expected.levels, strict=True):
        np.testing.assert_array_equal(level.splats.means, expected_level.splats.means)
        np.testing.assert_array_equal(level.splats.extras["sigma"], expected_level.splats.extras["sigma"])
    assert not messages

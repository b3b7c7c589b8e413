"""Files that version 0.1.0 wrote (commit f80e9a5): they open and choose as before."""

import json
from pathlib import Path

import pytest

OLD = Path(__file__).parents[2] / "data" / "version_0_1_0"


def test_a_blend_file_opens_with_the_same_splats_shown(bpy, lodgs):
    bpy.ops.wm.open_mainfile(filepath=str(OLD / "scenes.blend"))
    wanted = json.loads((OLD / "expected_blend.json").read_text())
    roots = {root.name: root for root in lodgs("data.roots").roots(bpy.context.scene)}
    assert roots.keys() == wanted.keys()
    assert {name: root.lodgs.rule for name, root in roots.items()} == {
        "flod": "bands", "octree": "octree", "plain": "",
    }  # fmt: skip
    depsgraph = bpy.context.evaluated_depsgraph_get()
    for name, root in roots.items():
        assert root.lodgs.focal_px == pytest.approx(wanted[name]["focal_px"])
        shown = {
            item.number: len(item.object.evaluated_get(depsgraph).data.points) * item.object.visible_get()
            for item in root.lodgs.levels
        }
        assert shown == {int(number): count for number, count in wanted[name]["levels"].items()}
    bands, octree = roots["flod"].lodgs.bands, roots["octree"].lodgs.octree
    assert (bands.gamma, bands.first, bands.last) == (2.0, 2, 5)
    assert octree.offset == -0.75
    assert not [
        group.name for group in bpy.data.node_groups if "Band" in group.name and group.name != "LODGS Bands"
    ]


def test_scenes_appended_from_one_choose_as_before(bpy, lodgs):
    with bpy.data.libraries.load(str(OLD / "scenes.blend")) as (_, wanted):
        wanted.collections = ["octree"]
    bpy.context.scene.collection.children.link(wanted.collections[0])
    root = lodgs("data.roots").roots(bpy.context.scene)[0]
    assert (root.lodgs.rule, root.lodgs.octree.offset) == ("octree", -0.75)
    assert not [group.name for group in bpy.data.node_groups if group.name.endswith("Octree Level")]


def test_what_is_linked_from_one_stays_and_stops_nothing(bpy, lodgs, capfd):
    with bpy.data.libraries.load(str(OLD / "scenes.blend"), link=True) as (_, wanted):
        wanted.collections = ["octree"]
    bpy.context.scene.collection.children.link(wanted.collections[0])
    bpy.context.view_layer.update()
    lodgs("data.older_files")._on_load()
    root = lodgs("data.roots").roots(bpy.context.scene)[0]
    assert root.lodgs.rule == ""
    assert "Traceback" not in "".join(capfd.readouterr())


def test_what_it_exports_has_a_rule(bpy, lodgs, tmp_path):
    bpy.ops.wm.open_mainfile(filepath=str(OLD / "scenes.blend"))
    for root in lodgs("data.roots").roots(bpy.context.scene):
        bundle = lodgs("data.scenes").read_levels(root)
        before = lodgs("training.splats.bundle").read_bundle(OLD / f"{root.name}.ply")
        assert (bundle.rule, bundle.facts, bundle.cumulative) == (
            before.rule,
            before.facts,
            before.cumulative,
        )
        assert [level.facts for level in bundle.levels] == [level.facts for level in before.levels]


@pytest.fixture
def trainings(bpy):
    """What the training panels of a file of that version are set to, by scene."""

    def read(path):
        bpy.ops.wm.open_mainfile(filepath=str(path))
        return {obj.name: obj.lodgs.training for obj in bpy.data.objects if obj.lodgs.is_root}

    return read


def test_the_training_panel_keeps_what_was_set(lodgs, trainings):
    changes = lodgs("runs.job_settings").changed_parameters
    found = trainings(OLD / "training.blend")
    assert {name: (t.method, t.preset, t.seed, changes(t)) for name, t in found.items()} == {
        "changed": ("octree", "standard", 3, {"levels": 7, "max_splats": 50_000}),
        "some": ("3dgs", "draft", 0, {"max_splats": 4321}),
        "untouched": ("flod", "draft", 0, {}),
        "back": ("flod", "draft", 0, {}),
    }
    found["changed"].method = "flod"  # one value had served all methods
    assert changes(found["changed"]) == {"levels": 7, "footprint": 12.5, "max_splats": 50_000}


def test_what_is_taken_over_stays_as_it_is_changed_then(bpy, lodgs, trainings, tmp_path):
    settings = trainings(OLD / "training.blend")["changed"]
    settings.parameters.use_levels, settings.parameters.max_splats = False, 9
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "now.blend"), check_existing=False)
    assert lodgs("runs.job_settings").changed_parameters(trainings(tmp_path / "now.blend")["changed"]) == {
        "max_splats": 9
    }

"""Node group of LODGE's chunks against values computed by hand."""

import numpy as np
import pytest

from training.lod.rules.chunks import member_columns

NEITHER, FIRST, SECOND, BOTH = range(4)
SETS = np.array([[0, 1, 0, 1], [0, 0, 1, 1]], bool)
"""Membership of four splats in both chunks."""
CHUNKS = {"x": [0, 10], "y": [0, 0], "z": [0, 0], "radius": [10, 10]}


@pytest.fixture
def weights(bpy, lodgs):
    """``weights(camera, **controls)``: return the weights of four splats at the origin.

    The level of these splats is visible below distance 20.
    ``weights.root`` is their scene. It has a transform, and a second level for larger distances.
    """
    from training.splats.levels import Bundle, Level

    scenes = lodgs("data.scenes")
    fine = splats(SETS)
    levels = [Level(1, splats(~SETS), {"d_l": 20.0}), Level(2, fine, {"d_l": 0.0})]
    table = {name: np.float32(values) for name, values in CHUNKS.items()}
    bundle = Bundle("lodge", levels, "chunks", tables={"chunks": table})
    with lodgs("data.importing").new_scene(bpy.context, "town") as root:
        for level in levels:
            scenes.put_level(root, level)
        scenes.set_bundle_facts(root, bundle)
        scenes.set_tables(root, bundle.tables)
    root.location, root.rotation_euler, root.scale = (5, 6, 7), (1, 2, 3), (2, 3, 4)
    root.lodgs.mode, root.lodgs.camera_choice = "SELECTIVE", "TRAINING"

    def compute(camera, **controls):
        for name, value in {"chunks": True, "fade": True, "distance_scale": 1.0, **controls}.items():
            setattr(root.lodgs.controls, name, value)
        root.lodgs.camera_center = camera
        depsgraph = bpy.context.evaluated_depsgraph_get()
        evaluated = root.lodgs.levels[1].object.evaluated_get(depsgraph)
        weights = np.zeros(4, np.float32)
        if len(evaluated.data.points):
            read = lodgs("attributes").read_attribute
            weights[read(evaluated.data, "row")] = read(evaluated.data, "lod_weight")
        query = lodgs("data.selection").evaluated_query(evaluated, depsgraph)
        np.testing.assert_allclose(query.weights(fine.means, fine.extras), weights, atol=1e-6)
        repeated = lodgs("data.selection").evaluated_query(evaluated, depsgraph)
        assert query == repeated and hash(query) == hash(repeated)
        region = query.region()
        assert region is None or (query.visible_in_region(fine.extras) >= (weights > 0)).all()
        return weights.tolist()

    compute.root = root
    return compute


def splats(sets):
    from training.splats.gaussians import Splats

    count = sets.shape[1]
    return Splats(
        means=np.zeros((count, 3), np.float32), quats=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        log_scales=np.zeros((count, 3), np.float32), opacity_logits=np.zeros(count, np.float32),
        sh=np.zeros((count, 1, 3), np.float32),
        extras=member_columns(sets) | {"row": np.arange(count, dtype=np.int32)},
    )  # fmt: skip


def test_sets_are_blended_between_chunk_centres(weights):
    assert weights((0, 0, 0)) == [0, 1, 0, 1]
    assert weights((2.5, 3, 0)) == [0, 0.75, 0.25, 1]
    assert weights((10, 0, 0)) == [0, 0, 1, 1]
    assert weights((-4, 0, 0)) == [0, 1, 0, 1]
    assert weights((2.5, 3, 0), fade=False) == [0, 1, 0, 1]
    assert weights((7.5, 3, 0), fade=False) == [0, 0, 1, 1]


def test_weights_by_distance_outside_the_chunks(weights):
    assert weights((-11.25, 0, 0)) == [0.5, 1, 0.5, 1]  # half a quarter radius outside
    assert weights((-11.25, 0, 0), fade=False) == [1, 1, 1, 1]
    assert weights((-12.5, 0, 0)) == [1, 1, 1, 1]
    assert weights((-12.5, 0, 0), distance_scale=2) == [0, 0, 0, 0]
    assert weights((0, 9, 0), distance_scale=9) == [0, 1, 0, 1]
    assert weights((0, 9, 0), distance_scale=9, chunks=False) == [0, 0, 0, 0]
    assert weights((0, 9, 0), chunks=False) == [1, 1, 1, 1]


def test_single_chunk_fades_to_all_splats(bpy, lodgs, weights):
    chunk = {name: np.float32(values[1:]) for name, values in CHUNKS.items()}
    lodgs("data.scenes").set_tables(weights.root, {"chunks": chunk})
    assert weights((2.5, 0, 0)) == [0, 1, 0, 1]
    assert weights((-1.25, 0, 0)) == [0.5, 1, 0.5, 1]


def test_weights_by_distance_without_a_table(bpy, lodgs, weights):
    (item,) = weights.root.lodgs.tables
    bpy.data.objects.remove(item.object)
    assert weights((2.5, 3, 0)) == [1, 1, 1, 1]
    lodgs("data.scenes").set_tables(weights.root, {"chunks": {}})
    assert weights((2.5, 3, 0)) == [1, 1, 1, 1]


@pytest.mark.parametrize("source", ["CAMERA", "OBJECT", "VIEW", "frozen"])
def test_chunks_are_selected_for_every_camera_source(bpy, weights, source):
    root, position = weights.root, (2.5, 3, 0)
    obj = bpy.data.objects.new("camera", bpy.data.cameras.new("camera") if source == "CAMERA" else None)
    bpy.context.scene.collection.objects.link(obj)
    bpy.context.view_layer.update()
    obj.location = root.lodgs.axes.matrix_world @ obj.location.__class__(position)
    if source == "CAMERA":
        bpy.context.scene.camera = obj
    root.lodgs.camera_object, root.lodgs.stored_position = obj, position
    if source == "frozen":
        root.lodgs.camera_choice, root.lodgs.freeze = "OBJECT", True
        root.lodgs.stored_position = position
        obj.location = (100, 100, 100)
    else:
        root.lodgs.camera_choice = source
        root.lodgs.stored_position = position
    assert weights((100, 0, 0)) == pytest.approx([0, 0.75, 0.25, 1], abs=1e-5)


def test_animated_camera_works_without_handlers(bpy, lodgs, weights, tmp_path):
    """Background renders evaluate only the node groups and drivers of the file."""
    root = weights.root
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    bpy.context.scene.collection.objects.link(camera)
    bpy.context.scene.camera = camera
    bpy.context.view_layer.update()
    for frame, x in ((1, 0.0), (11, 10.0)):
        camera.location = root.lodgs.axes.matrix_world @ camera.location.__class__((x, 0, 0))
        camera.keyframe_insert("location", frame=frame)
    root.lodgs.camera_choice = "CAMERA"
    path, name = str(tmp_path / "a.blend"), root.lodgs.levels[1].object.name
    bpy.ops.wm.save_as_mainfile(filepath=path)
    handlers = [getattr(bpy.app.handlers, kind) for kind in ("depsgraph_update_post", "load_post")]
    functions = [list(kind) for kind in handlers]
    for kind in handlers:
        kind.clear()
    try:
        bpy.ops.wm.open_mainfile(filepath=path)
        visible = []
        for frame in (1, 11):
            bpy.context.scene.frame_set(frame)
            cloud = bpy.data.objects[name].evaluated_get(bpy.context.evaluated_depsgraph_get()).data
            visible.append(lodgs("attributes").read_attribute(cloud, "row").tolist())
    finally:
        for kind, originals in zip(handlers, functions, strict=True):
            kind.extend(originals)
    assert visible == [[FIRST, BOTH], [SECOND, BOTH]]


def test_renders_evaluate_the_group(bpy, lodgs, weights):
    records = []

    class Recorder(bpy.types.RenderEngine):
        bl_idname, bl_label = "LODGS_TEST_RECORDER", "Recorder"

        def render(self, depsgraph):
            cloud = weights.root.lodgs.levels[1].object.evaluated_get(depsgraph).data
            read = lodgs("attributes").read_attribute
            records.append((depsgraph.mode, read(cloud, "row").tolist(), read(cloud, "lod_weight").tolist()))

    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    bpy.context.scene.collection.objects.link(camera)
    bpy.context.scene.camera = camera
    camera.location = weights.root.lodgs.axes.matrix_world @ camera.location.__class__((2.5, 3, 0))
    bpy.context.view_layer.update()
    camera.location = weights.root.lodgs.axes.matrix_world @ camera.location.__class__((2.5, 3, 0))
    weights.root.lodgs.camera_choice = "CAMERA"
    bpy.utils.register_class(Recorder)
    try:
        bpy.context.scene.render.engine = Recorder.bl_idname
        bpy.context.scene.render.resolution_x = bpy.context.scene.render.resolution_y = 8
        bpy.ops.render.render()
    finally:
        bpy.context.scene.render.engine = "LODGS"
        bpy.utils.unregister_class(Recorder)
    ((mode, rows, values),) = records
    assert (mode, rows) == ("RENDER", [FIRST, SECOND, BOTH])
    assert values == pytest.approx([0.75, 0.25, 1], abs=1e-5)

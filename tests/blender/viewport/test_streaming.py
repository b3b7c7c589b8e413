"""Streaming of trees while the camera moves.

The drawn splats are always a complete cut. They are the cut of the full file if the budget allows.
"""

import shutil
import time

import numpy as np
import pytest

from tests.blender.viewport.test_resident import read_store
from tests.training.lod.tree.test_paging import Truth
from tests.training.lod.tree.trees import random_leaves, tree_of, write_in_pages

LEAVES, BUDGET, SIZE = 12_000, 23_500, 96
POSITIONS = [(0, 0, 30), (9, 9, 1), (-9, 8, 1), (8, -9, 2), (0, 0, 30)]


@pytest.fixture(scope="module")
def tree():
    return tree_of(random_leaves(LEAVES, np.random.default_rng(1), degree=1))


@pytest.fixture
def path(tree, tmp_path):
    write_in_pages(tmp_path / "town.ply", tree)
    return tmp_path / "town.ply"


@pytest.fixture
def root(bpy, lodgs, path, monkeypatch):
    """Import the top of a tree; updates have a few pages each."""
    monkeypatch.setattr(lodgs("training.lod.tree.paging"), "PAGES_PER_UPDATE", 4)
    root = lodgs("data.importing").import_splats(bpy.context, path, upright=False, budget=BUDGET)
    yield root
    lodgs("viewport.views").clear()
    lodgs("viewport.sources").close_streams()


@pytest.fixture
def draw_from(bpy, lodgs, frame):
    """``draw_from(root, view, position, pixels, wait)``: image from a position, looking down."""
    from mathutils import Matrix

    views = lodgs("viewport.views")
    views.clear()
    projection = Matrix(((2, 0, 0, 0), (0, 2, 0, 0), (0, 0, -1, -0.1), (0, 0, -1, 0)))

    def draw(root, view, position, pixels=20.0, wait=False, freeze=True):
        root.lodgs.controls.pixels = pixels
        root.lodgs.freeze = freeze
        lodgs("data.selection").store_camera(root, position, 1000.0)
        bpy.context.view_layer.update()
        depsgraph = bpy.context.evaluated_depsgraph_get()
        instances = lodgs("data.shown").splat_instances(depsgraph)
        view_matrix = Matrix.Translation(-np.array(position))
        target = lodgs("viewport.splats").DrawTarget(view_matrix, projection, under_overlays=False)
        return frame(SIZE, lambda: views.draw_splats(view, instances, depsgraph, target, 10**6, wait=wait))

    return draw


def drawn_means(view):
    """Return the means of a viewport's drawn splats from the graphics card."""
    size = -(-(14 + 3 * view.store.higher) // 4)
    rows = np.array(view.instances.read(), np.float32).reshape(-1, 4)[: view.count]
    return read_store(view.store, 4 * size)[rows[:, 0].astype(int), :3]


def test_cuts_are_complete_while_finer_splats_are_loaded(bpy, lodgs, tree, path, root, draw_from):
    sources = lodgs("viewport.sources")
    views, truth = lodgs("viewport.views"), Truth(tree)
    paging = lodgs("training.lod.tree.paging")
    index = paging.TreeFile(path).index()
    view, streamed, numbers, complete = views.ViewState(), 0, [], False
    base_count = sum(len(item.object.data.points) for item in root.lodgs.levels)
    for position in POSITIONS:
        for pixels in (30.0, 8.0):
            until = time.monotonic() + 200
            while time.monotonic() < until:
                previous = sources.stream(root)
                settled = previous is not None and previous.ready and not previous.busy
                draw_from(root, view, position, pixels)
                complete |= 0 < view.count == view.arrangement.count  # the first splats arrive in parts
                if complete:
                    numbers.append(truth.nodes(drawn_means(view)))
                    truth.require_complete(numbers[-1])
                stream = sources.stream(root)
                if settled and not stream.busy and not view.pending and not view.loading:
                    break
                time.sleep(0.005)
            assert stream.ready and base_count + stream.splats <= BUDGET
            if (
                len(paging.page_order(index, np.array(position), 1001 / pixels))
                <= (BUDGET - base_count) // 512
            ):
                streamed += 1
                np.testing.assert_array_equal(np.sort(numbers[-1]), truth.cut(position, pixels))
    assert streamed == len(POSITIONS)
    assert len({len(nodes) for nodes in numbers}) > 10, "all pages arrived at once"


def test_resting_view_redraws_until_loading_ends(lodgs, root, draw_from, monkeypatch):
    """Windows redraw only on request, and loading takes several redraws."""
    sources = lodgs("viewport.sources")
    views, position = lodgs("viewport.views"), POSITIONS[0]
    view, slices = views.ViewState(), 0
    monkeypatch.setattr(lodgs("viewport.view_state"), "LOADING", (0.0, 0.0))
    draw_from(root, view, position, 30.0)
    until = time.monotonic() + 200
    while time.monotonic() < until:
        stream = sources.stream(root)
        if views.wants_redraw(view):
            draw_from(root, view, position, 30.0)
            slices += view.loading is not None
        elif view.pending is None and stream.ready and not stream.busy:
            break
        time.sleep(0.002)
    assert not stream.busy and view.arrived == stream.ready + stream.copied_updates and slices > 3


def test_streamed_image_matches_the_whole_file(bpy, lodgs, path, root, draw_from):
    view = lodgs("viewport.views").ViewState()
    images = [draw_from(root, view, position, 30.0, wait=True) for position in POSITIONS]
    lodgs("viewport.views").clear()
    lodgs("data.removal").remove(root)
    full_root = lodgs("data.importing").import_splats(bpy.context, path, upright=False)
    assert lodgs("data.streams").source_of(full_root) is None
    view = lodgs("viewport.views").ViewState()
    for position, image in zip(POSITIONS, images, strict=True):
        np.testing.assert_allclose(image, draw_from(full_root, view, position, 30.0, wait=True), atol=2e-3)
        assert image[..., 3].max() > 0.1


def test_two_viewports_draw_complete_cuts(bpy, lodgs, tree, root, draw_from, monkeypatch):
    """They upload at once, to a store without room for a second slot of a splat."""
    monkeypatch.setattr(lodgs("viewport.resident"), "MIN_SLOTS", 1)
    monkeypatch.setattr(lodgs("viewport.resident"), "UPLOAD_BATCH", 2000)
    monkeypatch.setattr(lodgs("viewport.view_state"), "LOADING", (0.0, 0.0))
    views, truth = lodgs("viewport.views"), Truth(tree)
    first, second, complete = views.ViewState(), views.ViewState(), set()
    end = time.monotonic() + 200
    for position in POSITIONS:
        rounds = 0
        while rounds < 4 or len(complete) < 2:
            assert time.monotonic() < end
            rounds += 1
            for view in (first, second):
                draw_from(root, view, position, 12.0)
                if 0 < view.count == view.arrangement.count:
                    complete.add(view)
                if view in complete:
                    truth.require_complete(truth.nodes(drawn_means(view)))
            time.sleep(0.002)


def test_missing_files_leave_the_splats_of_the_scene(bpy, lodgs, path, tree, root, draw_from, tmp_path):
    sources = lodgs("viewport.sources")
    views, truth = lodgs("viewport.views"), Truth(tree)
    path.rename(tmp_path / "moved.ply")
    view = views.ViewState()

    def draw():
        until = time.monotonic() + 200
        while time.monotonic() < until:
            previous = sources.stream(root)
            settled = previous is not None and not previous.busy
            draw_from(root, view, POSITIONS[1], 30.0)
            if settled and not view.pending and not view.loading and not sources.stream(root).busy:
                break
            time.sleep(0.01)
        return truth.nodes(drawn_means(view))

    truth.require_complete(draw())
    assert "town.ply" in sources.stream(root).problem and not sources.stream(root).ready
    root.lodgs.stream.file = str(tmp_path / "moved.ply")
    nodes = draw()
    assert not sources.stream(root).problem
    np.testing.assert_array_equal(np.sort(nodes), truth.cut(POSITIONS[1], 30.0))
    shutil.copy(path.with_name("moved.ply"), path)


def test_replaced_file_is_reported(bpy, lodgs, path, root, draw_from):
    bundle = lodgs("training.splats.bundle")
    bundle.write_bundle(path, tree_of(random_leaves(3000, np.random.default_rng(1), degree=1)))
    view = lodgs("viewport.views").ViewState()
    draw_from(root, view, POSITIONS[0], wait=True)
    assert "instead of 23,999" in lodgs("viewport.sources").stream(root).problem
    assert view.count


def test_edited_scenes_are_not_streamed(bpy, lodgs, root):
    streams, shown = lodgs("data.streams"), lodgs("data.shown")

    def sources():
        bpy.context.view_layer.update()
        return [instance.source for instance in shown.splat_instances(bpy.context.evaluated_depsgraph_get())]

    assert len(set(sources())) == 1 and sources()[0] is not None
    coarse, fine = (item.object for item in root.lodgs.levels)
    fine.hide_set(True)
    assert sources() == [None]
    fine.hide_set(False)
    nodes = fine.modifiers.new("mine", "NODES")
    nodes.node_group = bpy.data.node_groups.new("mine", "GeometryNodeTree")
    assert set(sources()) == {None}
    fine.modifiers.remove(nodes)
    assert set(sources()) != {None}
    root.lodgs.mode = "SINGLE"
    assert set(sources()) == {None}
    root.lodgs.mode = "SELECTIVE"
    bpy.data.objects.remove(coarse)
    assert streams.source_of(root) is None


def test_renders_stream_in_frames_whose_mode_is_by_distance(bpy, lodgs, root, measure_renders):
    """Blender evaluates keyframes for a render in copies of the objects."""
    scene, shown = bpy.context.scene, lodgs("data.shown")
    scene.camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(scene.camera)
    for frame, mode in ((1, "SELECTIVE"), (2, "SINGLE")):
        root.lodgs.mode = mode
        root.lodgs.keyframe_insert("mode", frame=frame)

    def is_streamed(depsgraph):
        return any(item.source for item in shown.splat_instances(depsgraph))

    assert measure_renders(is_streamed) == {1: True, 2: False}


def test_saved_scenes_keep_streaming(bpy, lodgs, root, path, tmp_path):
    """Relative paths survive moving both files."""
    streams = lodgs("data.streams")
    assert streams.file_of(root) == path
    (tmp_path / "a").mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    reimported = lodgs("data.importing").import_splats(bpy.context, path, budget=BUDGET)
    assert reimported.lodgs.stream.file == "//town.ply" and streams.file_of(reimported) == path
    bpy.ops.wm.save_mainfile()
    for name in ("scene.blend", "town.ply"):
        shutil.move(tmp_path / name, tmp_path / "a" / name)
    name = reimported.name
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a" / "scene.blend"))
    source = streams.source_of(bpy.data.objects[name])
    assert source.path == tmp_path / "a" / "town.ply" and source.total == 2 * LEAVES - 1
    assert not lodgs("viewport.sources")._streams

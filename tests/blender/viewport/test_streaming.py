"""Trees of splats that are read from their files as the eye moves: what is drawn is a complete cut at any
time, and the whole file's where there is room."""

import shutil
import time

import numpy as np
import pytest

from tests.blender.viewport.test_resident import stored
from tests.training.lod.tree.test_paging import Truth
from tests.training.lod.tree.trees import random_leaves, tree_of, write_in_pages

LEAVES, BUDGET, SIZE = 12_000, 23_500, 96
EYES = [(0, 0, 30), (9, 9, 1), (-9, 8, 1), (8, -9, 2), (0, 0, 30)]


@pytest.fixture(scope="module")
def tree():
    return tree_of(random_leaves(LEAVES, np.random.default_rng(1), degree=1))


@pytest.fixture
def path(tree, tmp_path):
    write_in_pages(tmp_path / "town.ply", tree)
    return tmp_path / "town.ply"


@pytest.fixture
def root(bpy, lodgs, path, monkeypatch):
    """A tree of which the top is here; pages come a few at a time."""
    monkeypatch.setattr(lodgs("training.lod.tree.paging"), "PAGES_PER_UPDATE", 4)
    root = lodgs("data.importing").import_splats(bpy.context, path, upright=False, budget=BUDGET)
    yield root
    lodgs("viewport.views").clear()
    lodgs("viewport.views").close_streams()


@pytest.fixture
def look(bpy, lodgs, frame):
    """``look(root, view, eye, pixels, wait)``: the picture from a place in the root's space, looking down."""
    from mathutils import Matrix

    views = lodgs("viewport.views")
    views.clear()
    projection = Matrix(((2, 0, 0, 0), (0, 2, 0, 0), (0, 0, -1, -0.1), (0, 0, -1, 0)))

    def looked(root, view, eye, pixels=20.0, wait=False, freeze=True):
        root.lodgs.controls.pixels = pixels
        root.lodgs.freeze = freeze
        lodgs("data.selection").hold(root, eye, 1000.0)
        bpy.context.view_layer.update()
        depsgraph = bpy.context.evaluated_depsgraph_get()
        instances = lodgs("data.shown").splat_instances(depsgraph)
        return frame(SIZE, lambda: views.draw_splats(
            view, instances, depsgraph, Matrix.Translation(-np.array(eye)), projection, 10**6, wait=wait,
            under_overlays=False,
        ))  # fmt: skip

    return looked


def on_the_card(view):
    """The means of the splats that a viewport draws, as the graphics card has them."""
    size = -(-(14 + 3 * view.store.higher) // 4)
    rows = np.array(view.instances.read(), np.float32).reshape(-1, 4)[: view.count]
    return stored(view.store, 4 * size)[rows[:, 0].astype(int), :3]


def test_finer_ones_come_and_what_is_drawn_is_complete_at_any_time(bpy, lodgs, tree, path, root, look):
    views, truth = lodgs("viewport.views"), Truth(tree)
    index = lodgs("training.lod.tree.paging").TreeFile(path).index()
    view, streamed, numbers, begun = views.ViewState(), 0, [], False
    held = sum(len(item.object.data.points) for item in root.lodgs.levels)
    for eye in EYES:
        for pixels in (30.0, 8.0):
            until = time.monotonic() + 30
            while time.monotonic() < until:
                before = views.stream(root)
                settled = before is not None and before.ready and not before.busy
                look(root, view, eye, pixels)
                begun |= 0 < view.count == view.arrangement.count  # at first they come bit by bit
                if begun:
                    numbers.append(truth.nodes(on_the_card(view)))
                    truth.require_complete(numbers[-1])
                stream = views.stream(root)
                if settled and not stream.busy and not view.pending and not view.loading:
                    break
                time.sleep(0.005)
            assert stream.ready and held + stream.splats <= BUDGET
            if (index.detail(np.array(eye)) < 1001 / pixels).sum() <= (BUDGET - held) // 512:
                streamed += 1
                np.testing.assert_array_equal(np.sort(numbers[-1]), truth.cut(eye, pixels))
    assert streamed == len(EYES)
    assert len({len(each) for each in numbers}) > 12, "it came at once"


def test_a_view_at_rest_is_redrawn_until_all_has_come(lodgs, root, look, monkeypatch):
    """As in windows, which are drawn again only when that is asked for; what comes takes several redraws."""
    views, eye = lodgs("viewport.views"), EYES[0]
    view, slices = views.ViewState(), 0
    monkeypatch.setattr(views, "LOADING", (0.0, 0.0))
    look(root, view, eye, 30.0)
    until = time.monotonic() + 30
    while time.monotonic() < until:
        stream = views.stream(root)
        if views.wants_redraw(view):
            look(root, view, eye, 30.0)
            slices += view.loading is not None
        elif view.pending is None and stream.ready and not stream.busy:
            break
        time.sleep(0.002)
    assert not stream.busy and view.arrived == stream.ready + stream.taken and slices > 3


def test_it_is_the_picture_of_the_whole_file(bpy, lodgs, path, root, look):
    view = lodgs("viewport.views").ViewState()
    pictures = [look(root, view, eye, 30.0, wait=True) for eye in EYES]
    lodgs("viewport.views").clear()
    lodgs("data.removal").remove(root)
    whole = lodgs("data.importing").import_splats(bpy.context, path, upright=False)
    assert lodgs("data.streams").source_of(whole) is None
    view = lodgs("viewport.views").ViewState()
    for eye, picture in zip(EYES, pictures, strict=True):
        np.testing.assert_allclose(picture, look(whole, view, eye, 30.0, wait=True), atol=2e-3)
        assert picture[..., 3].max() > 0.1


def test_two_viewports_draw_complete_cuts(bpy, lodgs, tree, root, look):
    views, truth = lodgs("viewport.views"), Truth(tree)
    one, other, begun = views.ViewState(), views.ViewState(), set()
    for eye in EYES:
        for _ in range(25):
            for view in (one, other):
                look(root, view, eye, 12.0)
                if 0 < view.count == view.arrangement.count:
                    begun.add(view)
                if view in begun:
                    truth.require_complete(truth.nodes(on_the_card(view)))
            time.sleep(0.002)
    assert len(begun) == 2


def test_a_file_that_is_gone_leaves_what_the_scene_holds(bpy, lodgs, path, tree, root, look, tmp_path):
    views, truth = lodgs("viewport.views"), Truth(tree)
    path.rename(tmp_path / "elsewhere.ply")
    view = views.ViewState()

    def drawn():
        until = time.monotonic() + 20
        while time.monotonic() < until:
            before = views.stream(root)
            settled = before is not None and not before.busy
            look(root, view, EYES[1], 30.0)
            if settled and not view.pending and not view.loading and not views.stream(root).busy:
                break
            time.sleep(0.01)
        return truth.nodes(on_the_card(view))

    found = drawn()
    truth.require_complete(found)
    assert "town.ply" in views.stream(root).problem and not views.stream(root).ready
    root.lodgs.stream.file = str(tmp_path / "elsewhere.ply")
    again = drawn()
    assert not views.stream(root).problem
    np.testing.assert_array_equal(np.sort(again), truth.cut(EYES[1], 30.0))
    shutil.copy(path.with_name("elsewhere.ply"), path)


def test_another_file_in_its_place_is_a_sentence(bpy, lodgs, path, root, look):
    bundle = lodgs("training.splats.bundle")
    bundle.write_bundle(path, tree_of(random_leaves(3000, np.random.default_rng(1), degree=1)))
    view = lodgs("viewport.views").ViewState()
    look(root, view, EYES[0], wait=True)
    assert "is not the file that was imported" in lodgs("viewport.views").stream(root).problem
    assert view.count


def test_what_somebody_has_changed_is_shown_as_it_is(bpy, lodgs, root):
    streams, shown = lodgs("data.streams"), lodgs("data.shown")

    def sources():
        bpy.context.view_layer.update()
        return [each.source for each in shown.splat_instances(bpy.context.evaluated_depsgraph_get())]

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


def test_a_saved_file_goes_on(bpy, lodgs, root, path, tmp_path):
    """By a path beside it, wherever both go."""
    streams = lodgs("data.streams")
    assert streams.file_of(root) == path
    (tmp_path / "a").mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    again = lodgs("data.importing").import_splats(bpy.context, path, budget=BUDGET)
    assert again.lodgs.stream.file == "//town.ply" and streams.file_of(again) == path
    bpy.ops.wm.save_mainfile()
    for name in ("scene.blend", "town.ply"):
        shutil.move(tmp_path / name, tmp_path / "a" / name)
    name = again.name
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a" / "scene.blend"))
    found = bpy.data.objects[name]
    source = streams.source_of(found)
    assert source.path == tmp_path / "a" / "town.ply" and source.total == 2 * LEAVES - 1
    assert not lodgs("viewport.views")._streams

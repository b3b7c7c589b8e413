"""Splats in the memory of the graphics card: only drawn splats are uploaded."""

import time
from types import SimpleNamespace

import numpy as np
import pytest

COUNT = 1500


@pytest.fixture
def scene(bpy, lodgs):
    """Create a root with two levels by distance around the origin, SH degree 1."""
    rng, bundle = np.random.default_rng(4), lodgs("training.splats.bundle")
    with lodgs("data.importing").new_scene(bpy.context, "scene") as root:
        for number, s_min in ((1, 0.01), (2, 0.0)):
            splats = lodgs("training.splats.gaussians").Splats(
                means=rng.uniform(-4, 4, (COUNT, 3)).astype(np.float32),
                quats=rng.normal(size=(COUNT, 4)).astype(np.float32),
                log_scales=rng.normal(-3, 0.5, (COUNT, 3)).astype(np.float32),
                opacity_logits=rng.normal(1, 1, COUNT).astype(np.float32),
                sh=rng.normal(0, 0.4, (COUNT, 4, 3)).astype(np.float32),
            )
            lodgs("data.scenes").set_level(root, bundle.Level(number, splats, {"s_min": s_min}))
        lodgs("data.scenes").set_bundle_facts(root, bundle.Bundle("flod", [], "bands"))
    root.lodgs.mode, root.lodgs.camera_choice = "SELECTIVE", "VIEW"
    return root


@pytest.fixture
def draw_from(bpy, lodgs, frame, scene):
    """``draw_from(view, x, wait)``: image (96, 96, 4) from a camera at x."""
    from mathutils import Matrix

    views, selection = lodgs("viewport.views"), lodgs("data.selection")
    views.clear()
    projection = Matrix(((2, 0, 0, 0), (0, 2, 0, 0), (0, 0, -1, -0.1), (0, 0, -1, 0)))

    def draw(view, x, wait=True):
        selection.store_camera(scene, (x, 0, 0), 600.0)
        bpy.context.view_layer.update()
        depsgraph = bpy.context.evaluated_depsgraph_get()
        instances = lodgs("data.shown").splat_instances(depsgraph)
        view_matrix = Matrix.Translation((-x, 0, -6))
        target = lodgs("viewport.splats").DrawTarget(view_matrix, projection, under_overlays=False)
        return frame(96, lambda: views.draw_splats(view, instances, depsgraph, target, 10**6, wait=wait))

    yield draw
    views.clear()


def read_store(store, width):
    """Return the contents (slots, width) of a store on the graphics card."""
    empty = np.zeros((store.texture_slots, width), np.float32)
    parts = [
        empty
        if texture is None
        else np.array(texture.read(), np.float32).reshape(-1)[: empty.size].reshape(empty.shape)
        for texture in store.textures
    ]
    return np.concatenate(parts)


def test_viewed_attributes_match_read_ones(bpy, lodgs, scene):
    attributes, cloud = lodgs("attributes"), scene.lodgs.levels[0].object.data
    kinds = set()
    for attribute in cloud.attributes:
        read = attributes.read_attribute(cloud, attribute.name)
        if read is not None:
            viewed = attributes.view_attribute(cloud, attribute.name)
            kinds.add(attribute.data_type)
            assert viewed.shape == read.shape and viewed.dtype == read.dtype
            assert viewed.tobytes() == read.tobytes()
            with pytest.raises(ValueError, match="read-only"):
                viewed[0] = 1
    assert {"FLOAT", "FLOAT_VECTOR", "QUATERNION"} <= kinds
    assert attributes.view_attribute(cloud, "no such") is None


def test_drawn_splats_are_uploaded_once(bpy, lodgs, draw_from):
    views, resident = lodgs("viewport.views"), lodgs("viewport.resident")
    view, size, needed = views.ViewState(), 4 * 4 * resident.record_texels(3), set()
    uploaded = resident.bytes_uploaded
    for x in (0.0, 3.0, -3.0):
        draw_from(view, x)
        needed |= set(view.arrangement.splats.tolist())
        assert resident.bytes_uploaded - uploaded == len(needed) * size
    assert view.arrangement.count < len(needed) < 2 * COUNT
    draw_from(view, 0.0)
    draw_from(views.ViewState(), 3.0)
    assert resident.bytes_uploaded - uploaded == len(needed) * size


def test_slots_are_reused(lodgs, frame):
    """A small store keeps requested splats and those of the last step, bit for bit."""
    resident, rng = lodgs("viewport.resident"), np.random.default_rng(2)
    records = rng.normal(size=(5000, 4 * resident.record_texels(8))).astype(np.float32)

    def steps():
        store, last = resident.Store(5000, 2500, 8), np.zeros(0, np.int32)
        for count in (900, 1200, 10, 1200, 1300, 1100):
            requested = rng.choice(5000, count, replace=False).astype(np.int32)
            used = np.zeros(5000, bool)
            used[requested] = used[last] = True
            store.keep(used)
            kept_splats = last[store.slots[last] >= 0]
            missing = store.missing(np.concatenate([requested, requested[:5]]))
            assert set(missing.tolist()).isdisjoint(np.flatnonzero(store.slots >= 0).tolist())
            for piece in np.array_split(missing, 3):
                store.insert(piece, records[piece])
            assert (store.slots[requested] >= 0).all() and (store.slots[kept_splats] >= 0).all()
            owned = np.flatnonzero(store.owners >= 0)
            assert np.array_equal(store.slots[store.owners[owned]], owned)
            assert np.array_equal(
                read_store(store, records.shape[1])[store.slots[requested]], records[requested]
            )
            last = requested

    frame(8, steps)


def test_viewports_share_the_store(lodgs, draw_from, monkeypatch):
    """Each viewport draws the same image as without the other; unused slots are freed."""
    views, resident = lodgs("viewport.views"), lodgs("viewport.resident")
    monkeypatch.setattr(resident, "MIN_SLOTS", 1)
    positions = (-9.0, -3.0, 0.0, 3.0, 9.0, -3.0, 0.0)
    expected_images = []
    for x in positions:
        views.clear()
        expected_images.append(draw_from(views.ViewState(), x))
    views.clear()
    first, second, stores = views.ViewState(), views.ViewState(), set()
    for x, expected in zip(positions, expected_images, strict=True):
        np.testing.assert_array_equal(draw_from(first, x), expected)
        stores.add(first.resident.store)
        np.testing.assert_array_equal(draw_from(second, 0.0), expected_images[2])
    assert len(stores) > 1, "no store was too small"
    assert len(first.resident.reserve([np.arange(10)]).owners) < 100


def test_each_redraw_uploads_a_batch(bpy, lodgs, draw_from, monkeypatch):
    """Parts are drawn only at first; later arrangements are drawn when complete."""
    views, resident = lodgs("viewport.views"), lodgs("viewport.resident")
    monkeypatch.setattr(resident, "UPLOAD_BATCH", 100)
    monkeypatch.setattr(lodgs("viewport.view_state"), "LOADING", (0.0, 0.0))

    def settle(view, x):
        counts, images = [], []
        end = time.monotonic() + 200
        while time.monotonic() < end:
            previous = resident.bytes_uploaded
            images.append(draw_from(view, x, wait=False))
            assert resident.bytes_uploaded - previous <= 100 * 16 * resident.record_texels(3)
            counts.append(view.count)
            if view.arrangement is not None and view.pending is None and view.loading is None:
                return counts, images
            time.sleep(0.01)
        raise AssertionError("uploads do not finish")

    view = views.ViewState()
    counts, _ = settle(view, 0.0)
    assert counts[-1] == view.arrangement.count and len(set(counts)) > 4 and counts == sorted(counts)
    first = view.arrangement
    counts, images = settle(view, 3.0)
    assert set(counts[:-1]) == {first.count} and view.arrangement is not first
    views.clear()
    np.testing.assert_array_equal(images[-1], draw_from(views.ViewState(), 3.0))


@pytest.mark.parametrize(("interval", "batches"), [(0.05, 2), (0.4, 10), (4.0, 10)])
def test_slow_redraws_upload_more(lodgs, draw_from, monkeypatch, interval, batches):
    """A batch takes 0.01 s: 2 fit into 0.02 s. Redraws of 0.08 s and more have up to five times as much."""
    views, resident, state = lodgs("viewport.views"), lodgs("viewport.resident"), lodgs("viewport.view_state")
    monkeypatch.setattr(resident, "UPLOAD_BATCH", 10)
    now, inserted, insert = 0.0, 0, resident.Store.insert
    monkeypatch.setattr(state, "time", SimpleNamespace(monotonic=lambda: now))

    def slow_insert(*arguments):
        nonlocal now, inserted
        now, inserted = now + 0.01001, inserted + 1
        insert(*arguments)

    monkeypatch.setattr(resident.Store, "insert", slow_insert)
    view, end = views.ViewState(), time.monotonic() + 200
    while not inserted:
        assert time.monotonic() < end
        draw_from(view, 0.0, wait=False)
        time.sleep(0.01)
    now, inserted = view.loaded + interval, 0
    draw_from(view, 0.0, wait=False)
    assert inserted == batches


def test_cost_is_measured_for_another_number_of_splats(lodgs, draw_from, monkeypatch):
    """Blending takes half a second of the clock of this test."""
    splats, views = lodgs("viewport.splats"), lodgs("viewport.views")
    view, now = views.ViewState(), 0.0
    monkeypatch.setattr(splats, "time", SimpleNamespace(monotonic=lambda: now))
    blend, draw_splats = splats._blend, views.draw_splats

    def slow_blend(*arguments):
        nonlocal now
        now += 0.5
        blend(*arguments)

    monkeypatch.setattr(splats, "_blend", slow_blend)
    monkeypatch.setattr(views, "draw_splats", lambda *a, **k: draw_splats(*a, **k, timed=True))
    monkeypatch.setattr(splats, "is_compiled", lambda *_: False)
    draw_from(view, 0.0)
    assert view.cost == (0, 0.0), "the first redraw waits for the shader"
    monkeypatch.setattr(splats, "is_compiled", lambda *_: True)
    draw_from(view, 0.0)
    assert view.cost == (view.count, 0.5) and not view.is_cost_outdated()
    view.count = round(0.8 * view.count)
    assert view.is_cost_outdated()
    view.moving = True
    draw_from(view, 0.0)
    assert view.motion_cost == (view.count, 0.5) and not view.is_cost_outdated()
    view.measured -= 1 + lodgs("viewport.view_state").COST_AGE
    assert view.is_cost_outdated()


def test_viewports_that_load_at_once_upload_each_splat_once(lodgs, draw_from, monkeypatch):
    """A second slot of a splat would take the place of one that is drawn."""
    views, resident = lodgs("viewport.views"), lodgs("viewport.resident")
    monkeypatch.setattr(resident, "UPLOAD_BATCH", 100)
    monkeypatch.setattr(lodgs("viewport.view_state"), "LOADING", (0.0, 0.0))
    pair, uploaded = [views.ViewState(), views.ViewState()], resident.bytes_uploaded
    loaded_at_once, end = False, time.monotonic() + 200
    while not all(view.arrangement and not view.loading for view in pair):
        assert time.monotonic() < end
        for view in pair:
            draw_from(view, 0.0, wait=False)
        loaded_at_once |= all(view.missing for view in pair)
        time.sleep(0.002)
    assert loaded_at_once
    count, store = pair[0].arrangement.count, pair[0].store
    assert resident.bytes_uploaded - uploaded == count * 16 * resident.record_texels(3)
    assert np.count_nonzero(store.owners >= 0) == count == pair[0].count == pair[1].count


def test_each_redraw_reads_an_attribute(bpy, lodgs, draw_from, scene, monkeypatch):
    """The old image stays until the pool is complete; another change restarts reading."""
    sources = lodgs("viewport.sources")
    views, view = lodgs("viewport.views"), lodgs("viewport.views").ViewState()
    before, cloud = draw_from(view, 0.0), scene.lodgs.levels[1].object.data
    positions = np.zeros(3 * COUNT, np.float32)
    cloud.attributes["position"].data.foreach_get("vector", positions)

    def change(offset):
        cloud.attributes["position"].data.foreach_set("vector", positions + np.float32(offset))
        cloud.update_tag()
        bpy.context.view_layer.update()

    def redraws(limit=1000):
        reads, count = sources.reads, 0
        while sources.reads == reads and count < limit:
            image, count = draw_from(view, 0.0, wait=False), count + 1
            assert sources.reads > reads or views.wants_redraw(view)
            np.testing.assert_array_equal(image, before)
        return count

    monkeypatch.setattr(lodgs("viewport.view_state"), "LOADING", (0.0, 0.0))
    change(0.1)
    total = redraws()
    assert 6 < total < 100
    change(0.2)
    assert redraws(total - 2) == total - 2
    change(0.3)
    assert redraws() == total, "reading did not restart"
    after = draw_from(view, 0.0)
    views.clear()
    np.testing.assert_array_equal(after, draw_from(views.ViewState(), 0.0))
    assert not np.array_equal(after, before)


@pytest.mark.parametrize("during_loading", [False, True])
def test_old_image_stays_after_an_undo(bpy, lodgs, draw_from, scene, monkeypatch, during_loading):
    """Undo replaces all datablocks; viewports draw the previous splats until the restored ones are ready."""
    view, name = lodgs("viewport.views").ViewState(), scene.name
    bpy.ops.ed.undo_push(message="before")
    expected = draw_from(view, 0.0)
    for item in scene.lodgs.levels:
        item.object.data.attributes["position"].data.foreach_set("vector", np.zeros(3 * COUNT, np.float32))
        item.object.data.update_tag()
    before = draw_from(view, 0.0)
    bpy.ops.ed.undo_push(message="Move")
    assert not np.array_equal(before, expected)
    if during_loading:
        draw_from(view, 3.0, wait=False)
    assert bpy.ops.ed.undo() == {"FINISHED"}
    restored = bpy.data.objects[name]
    monkeypatch.setattr(lodgs("viewport.view_state"), "LOADING", (0.0, 0.0))
    selection, end = lodgs("data.selection"), time.monotonic() + 100
    monkeypatch.setattr(selection, "store_camera", lambda root, *a: None)
    restored.lodgs.stored_position, restored.lodgs.stored_focal = (0, 0, 0), 600.0
    images = []
    while not images or not np.array_equal(images[-1], expected):
        assert time.monotonic() < end
        images.append(draw_from(view, 0.0, wait=False))
        time.sleep(0.001)
    assert len(images) > 4 and min(image[..., 3].sum() for image in images) > 0
    assert all(np.array_equal(image, before) or np.array_equal(image, expected) for image in images)


@pytest.mark.parametrize("name", [None, "rotation", "radiance:sh_2"])
def test_undo_uploads_only_changed_splats(bpy, lodgs, draw_from, scene, monkeypatch, name):
    """Blender reports all points after an undo. Splats stay on the graphics card if they are the same."""
    sources = lodgs("viewport.sources")
    views, resident, changes = lodgs("viewport.views"), lodgs("viewport.resident"), lodgs("data.changes")
    view, cloud_name = views.ViewState(), scene.lodgs.levels[1].object.data.name
    expected = draw_from(view, 0.0)
    bpy.ops.ed.undo_push(message="before")
    bpy.data.objects.new("Unrelated", None)
    if name:
        cloud = bpy.data.pointclouds[cloud_name]
        key = "value" if name == "rotation" else "vector"
        values = np.random.default_rng(1).normal(size=COUNT * (4 if name == "rotation" else 3))
        cloud.attributes[name].data.foreach_set(key, values.astype(np.float32))
        cloud.update_tag()
    changed = draw_from(view, 0.0)
    assert np.array_equal(changed, expected) == (name is None)
    bpy.ops.ed.undo_push(message="Change")
    version, reads, uploaded = (
        changes.version(bpy.data.pointclouds[cloud_name]),
        sources.reads,
        resident.bytes_uploaded,
    )
    assert bpy.ops.ed.undo() == {"FINISHED"}
    monkeypatch.setattr(lodgs("data.selection"), "store_camera", lambda *arguments: None)  # undone as well
    np.testing.assert_array_equal(draw_from(view, 0.0), expected)
    assert changes.version(bpy.data.pointclouds[cloud_name]) != version
    assert (sources.reads > reads) == (resident.bytes_uploaded > uploaded) == (name is not None)


def test_splats_can_be_removed_during_loading(bpy, lodgs, draw_from, scene, monkeypatch):
    views, resident = lodgs("viewport.views"), lodgs("viewport.resident")
    monkeypatch.setattr(resident, "UPLOAD_BATCH", 10)
    monkeypatch.setattr(lodgs("viewport.view_state"), "LOADING", (0.0, 0.0))
    view = views.ViewState()
    end = time.monotonic() + 200
    while view.loading is None:
        assert time.monotonic() < end
        draw_from(view, 0.0, wait=False)
        time.sleep(0.01)
    bpy.data.objects.remove(scene.lodgs.levels[1].object)
    bpy.data.pointclouds.remove(bpy.data.pointclouds["scene level 2"])
    bpy.context.view_layer.update()
    draw_from(view, 0.0)
    assert view.loading is None and (view.arrangement.splats < COUNT).all()


def test_moving_view_selects_before_modifiers_update(bpy, lodgs, draw_from, scene, monkeypatch):
    """Nothing is evaluated while a view moves, and nothing changes when it rests."""
    from mathutils import Matrix

    views, view_camera = lodgs("viewport.views"), lodgs("viewport.view_camera")
    now = time.monotonic()
    monkeypatch.setattr(view_camera, "time", SimpleNamespace(monotonic=lambda: now))
    view, region = views.ViewState(), SimpleNamespace(as_pointer=lambda: 1, width=700)
    scene.location.x = 0.5
    draw_from(view, 0.0)
    version = lodgs("data.changes").version(scene.lodgs.levels[0].object.data)

    def request():
        depsgraph = bpy.context.evaluated_depsgraph_get()
        instances = lodgs("data.shown").splat_instances(depsgraph)
        return views.prepare(view, instances, depsgraph, Matrix(), 10**6, True, True)

    matrix = Matrix.Translation((-3.3, 1, -2))
    projection = Matrix(((2, 0, 0, 0), (0, 2, 0, 0), (0, 0, -1, -0.1), (0, 0, -1, 0)))
    region_view = SimpleNamespace(view_matrix=matrix, window_matrix=projection, view_distance=1.0)
    view_camera.track(region, bpy.context.scene, region_view, splats=True)
    moved = request()
    assert np.allclose(moved.placements[0].query.position, (2.8, -1, 2), atol=1e-6)
    assert moved.placements[0].query.focal_px == 700.0
    assert tuple(scene.lodgs.stored_position) == (0.0, 0.0, 0.0)
    assert view_camera._store_pending() > 0, "the view still moves"
    now += view_camera.REST
    assert (
        view_camera._store_pending() is None and view_camera.current_camera(bpy.context.scene, scene) is None
    )
    bpy.context.view_layer.update()
    assert request() == moved
    assert lodgs("data.changes").version(scene.lodgs.levels[0].object.data) == version
    scene.lodgs.freeze = True
    view_camera.track(region, bpy.context.scene, region_view, splats=True)
    assert view_camera.current_camera(bpy.context.scene, scene) is None
    view_camera.clear()


def test_a_window_of_another_scene_moves_no_view(bpy, lodgs, scene):
    from mathutils import Matrix

    view_camera = lodgs("viewport.view_camera")
    scene.lodgs.camera_choice = "VIEW"
    other = bpy.data.scenes.new("other")

    def track(blender_scene, number):
        view = SimpleNamespace(
            view_matrix=Matrix.Translation((number, 0, 0)), window_matrix=Matrix(), view_distance=1.0
        )
        view_camera.track(SimpleNamespace(as_pointer=lambda: number, width=100), blender_scene, view)

    track(bpy.context.scene, 1)
    track(bpy.context.scene, 2)
    camera = view_camera.current_camera(bpy.context.scene, scene)
    track(other, 3)
    track(bpy.context.scene, 2)
    assert camera is not None and view_camera.current_camera(bpy.context.scene, scene) == camera
    view_camera.clear()

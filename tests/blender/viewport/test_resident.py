"""What is on the graphics card: what viewports draw, and no splat more."""

import time
from types import SimpleNamespace

import numpy as np
import pytest

COUNT = 1500


@pytest.fixture
def scene(bpy, lodgs):
    """The root of two levels by distance around the origin, of harmonics of degree 1."""
    rng, bundle = np.random.default_rng(4), lodgs("training.splats.bundle")
    with lodgs("data.scenes").new_scene(bpy.context, "scene") as root:
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
    root.lodgs.mode, root.lodgs.eye = "SELECTIVE", "VIEW"
    return root


@pytest.fixture
def seen(bpy, lodgs, frame, scene):
    """``seen(view, x, wait)``: the picture for the eye at a place on the x axis, as (96, 96, 4)."""
    from mathutils import Matrix

    views, selection = lodgs("viewport.views"), lodgs("data.selection")
    views.clear()
    projection = Matrix(((2, 0, 0, 0), (0, 2, 0, 0), (0, 0, -1, -0.1), (0, 0, -1, 0)))

    def drawn(view, x, wait=True):
        selection.hold(scene, (x, 0, 0), 600.0)
        bpy.context.view_layer.update()
        depsgraph = bpy.context.evaluated_depsgraph_get()
        instances = lodgs("data.shown").splat_instances(depsgraph)
        look = Matrix.Translation((-x, 0, -6))
        return frame(96, lambda: views.draw_splats(
            view, instances, depsgraph, look, projection, 10**6, wait=wait, under_overlays=False,
        ))  # fmt: skip

    yield drawn
    views.clear()


def stored(store, width):
    """What the graphics card has at each place, (room, width)."""
    nothing = np.zeros((store.part, width), np.float32)
    parts = [
        nothing
        if texture is None
        else np.array(texture.read(), np.float32).reshape(-1)[: nothing.size].reshape(nothing.shape)
        for texture in store.textures
    ]
    return np.concatenate(parts)


def test_a_viewed_attribute_is_the_read_one(bpy, lodgs, scene):
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


def test_only_what_is_drawn_is_uploaded_and_only_once(bpy, lodgs, seen):
    views, resident = lodgs("viewport.views"), lodgs("viewport.resident")
    view, size, needed = views.ViewState(), 4 * 4 * resident.record_texels(3), set()
    uploaded = resident.bytes_uploaded
    for x in (0.0, 3.0, -3.0):
        seen(view, x)
        needed |= set(view.arrangement.splats.tolist())
        assert resident.bytes_uploaded - uploaded == len(needed) * size
    assert view.arrangement.count < len(needed) < 2 * COUNT
    seen(view, 0.0)
    seen(views.ViewState(), 3.0)
    assert resident.bytes_uploaded - uploaded == len(needed) * size


def test_places_change_hands(lodgs, frame):
    """A store with room for few of many: held splats stay, to the bit, and the others that were last."""
    resident, rng = lodgs("viewport.resident"), np.random.default_rng(2)
    records = rng.normal(size=(5000, 4 * resident.record_texels(8))).astype(np.float32)

    def steps():
        store, last = resident.Store(5000, 2500, 8), np.zeros(0, np.int32)
        for count in (900, 1200, 10, 1200, 1300, 1100):
            wanted = rng.choice(5000, count, replace=False).astype(np.int32)
            held = np.zeros(5000, bool)
            held[wanted] = held[last] = True
            store.hold(held)
            stay = last[store.places[last] >= 0]
            missing = store.missing(np.concatenate([wanted, wanted[:5]]))
            assert set(missing.tolist()).isdisjoint(np.flatnonzero(store.places >= 0).tolist())
            for piece in np.array_split(missing, 3):
                store.put(piece, records[piece])
            assert (store.places[wanted] >= 0).all() and (store.places[stay] >= 0).all()
            owned = np.flatnonzero(store.owners >= 0)
            assert np.array_equal(store.places[store.owners[owned]], owned)
            assert np.array_equal(stored(store, records.shape[1])[store.places[wanted]], records[wanted])
            last = wanted

    frame(8, steps)


def test_viewports_share_the_store(lodgs, seen, monkeypatch):
    """Each sees what it would see alone, whoever makes room; what nobody needs is given back."""
    views, resident = lodgs("viewport.views"), lodgs("viewport.resident")
    monkeypatch.setattr(resident, "LEAST", 1)
    places = (-9.0, -3.0, 0.0, 3.0, 9.0, -3.0, 0.0)
    alone = []
    for x in places:
        views.clear()
        alone.append(seen(views.ViewState(), x))
    views.clear()
    one, other, stores = views.ViewState(), views.ViewState(), set()
    for x, expected in zip(places, alone, strict=True):
        np.testing.assert_array_equal(seen(one, x), expected)
        stores.add(one.resident.store)
        np.testing.assert_array_equal(seen(other, 0.0), alone[2])
    assert len(stores) > 1, "no store was too small"
    assert len(one.resident.hold([np.arange(10)]).owners) < 100


def test_a_few_come_at_each_redraw(bpy, lodgs, seen, monkeypatch):
    """Where there is nothing, what has come is drawn; where there is, it stays until all is there."""
    views, resident = lodgs("viewport.views"), lodgs("viewport.resident")
    monkeypatch.setattr(resident, "PIECE", 100)
    monkeypatch.setattr(views, "LOADING", (0.0, 0.0))

    def settle(view, x):
        counts, pictures = [], []
        end = time.monotonic() + 30
        while time.monotonic() < end:
            before = resident.bytes_uploaded
            pictures.append(seen(view, x, wait=False))
            assert resident.bytes_uploaded - before <= 100 * 16 * resident.record_texels(3)
            counts.append(view.count)
            if view.arrangement is not None and view.pending is None and view.loading is None:
                return counts, pictures
            time.sleep(0.01)
        raise AssertionError("it never came")

    view = views.ViewState()
    counts, _ = settle(view, 0.0)
    assert counts[-1] == view.arrangement.count and len(set(counts)) > 4 and counts == sorted(counts)
    first = view.arrangement
    counts, pictures = settle(view, 3.0)
    assert set(counts[:-1]) == {first.count} and view.arrangement is not first
    views.clear()
    np.testing.assert_array_equal(pictures[-1], seen(views.ViewState(), 3.0))


def test_splats_are_read_an_attribute_at_a_time(bpy, lodgs, seen, scene, monkeypatch):
    """What is drawn stays until all that choosing needs has been read; and others begin anew."""
    views, view = lodgs("viewport.views"), lodgs("viewport.views").ViewState()
    before, cloud = seen(view, 0.0), scene.lodgs.levels[1].object.data
    positions = np.zeros(3 * COUNT, np.float32)
    cloud.attributes["position"].data.foreach_get("vector", positions)

    def change(by):
        cloud.attributes["position"].data.foreach_set("vector", positions + np.float32(by))
        cloud.update_tag()
        bpy.context.view_layer.update()

    def redraws(most=1000):
        reads, count = views.reads, 0
        while views.reads == reads and count < most:
            picture, count = seen(view, 0.0, wait=False), count + 1
            assert views.reads > reads or views.wants_redraw(view)
            np.testing.assert_array_equal(picture, before)
        return count

    monkeypatch.setattr(views, "LOADING", (0.0, 0.0))
    change(0.1)
    whole = redraws()
    assert 6 < whole < 100
    change(0.2)
    assert redraws(whole - 2) == whole - 2
    change(0.3)
    assert redraws() == whole, "it went on with what it had of others"
    after = seen(view, 0.0)
    views.clear()
    np.testing.assert_array_equal(after, seen(views.ViewState(), 0.0))
    assert not np.array_equal(after, before)


def test_splats_that_vanish_while_they_are_loaded(bpy, lodgs, seen, scene, monkeypatch):
    views, resident = lodgs("viewport.views"), lodgs("viewport.resident")
    monkeypatch.setattr(resident, "PIECE", 10)
    monkeypatch.setattr(views, "LOADING", (0.0, 0.0))
    view = views.ViewState()
    for _ in range(200):
        seen(view, 0.0, wait=False)
        if view.loading is not None:
            break
        time.sleep(0.01)
    assert view.loading is not None
    bpy.data.objects.remove(scene.lodgs.levels[1].object)
    bpy.data.pointclouds.remove(bpy.data.pointclouds["scene level 2"])
    bpy.context.view_layer.update()
    seen(view, 0.0)
    assert view.loading is None and (view.arrangement.splats < COUNT).all()


def test_the_viewports_own_eye_counts_before_the_modifiers_know_it(bpy, lodgs, seen, scene):
    """So that nothing is evaluated while a view moves; and nothing changes when they do."""
    from mathutils import Matrix

    views, eye = lodgs("viewport.views"), lodgs("viewport.eye")
    view, region = views.ViewState(), SimpleNamespace(as_pointer=lambda: 1, width=700)
    scene.location.x = 0.5
    seen(view, 0.0)
    version = lodgs("data.changes").version(scene.lodgs.levels[0].object.data)

    def request():
        depsgraph = bpy.context.evaluated_depsgraph_get()
        instances = lodgs("data.shown").splat_instances(depsgraph)
        return views.prepare(view, instances, depsgraph, Matrix(), 10**6, True, True)

    matrix = Matrix.Translation((-3.3, 1, -2))
    projection = Matrix(((2, 0, 0, 0), (0, 2, 0, 0), (0, 0, -1, -0.1), (0, 0, -1, 0)))
    looks = SimpleNamespace(view_matrix=matrix, window_matrix=projection, view_distance=1.0)
    eye.on_draw(region, bpy.context.scene, looks, splats=True)
    moved = request()
    assert np.allclose(moved.placements[0].choice.eye, (2.8, -1, 2), atol=1e-6)
    assert moved.placements[0].choice.focal_px == 700.0
    assert tuple(scene.lodgs.held_eye) == (0.0, 0.0, 0.0)
    assert eye._hand_on() > 0, "not while the view moves"
    time.sleep(eye.REST)
    assert eye._hand_on() is None and eye.moved(bpy.context.scene, scene) is None
    bpy.context.view_layer.update()
    assert request() == moved
    assert lodgs("data.changes").version(scene.lodgs.levels[0].object.data) == version
    scene.lodgs.freeze = True
    eye.on_draw(region, bpy.context.scene, looks, splats=True)
    assert eye.moved(bpy.context.scene, scene) is None
    eye.clear()

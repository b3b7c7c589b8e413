"""Which splats viewports draw, in which order and from which eye: against numpy and the modifiers."""

from dataclasses import replace

import numpy as np
import pytest

COUNT = 3000
S_MIN = [0.012, 0.003, 0.0]


@pytest.fixture
def scene_of(bpy, lodgs):
    """``scene_of(facts)``: a splat scene of three levels out to 40 units, by distance, with a camera."""

    def made(facts=None):
        rng, bundles = np.random.default_rng(7), lodgs("training.splats.bundle")
        camera = bpy.data.objects.new("eye", bpy.data.cameras.new("eye"))
        bpy.context.scene.collection.objects.link(camera)
        bpy.context.scene.camera = camera
        with lodgs("data.importing").new_scene(bpy.context, "scene") as root:
            for number, s_min in enumerate(S_MIN, 1):
                direction = rng.standard_normal((COUNT, 3))
                direction /= np.linalg.norm(direction, axis=1, keepdims=True)
                splats = lodgs("training.splats.gaussians").Splats(
                    means=(direction * rng.uniform(0, 40, (COUNT, 1))).astype(np.float32),
                    quats=np.tile(np.float32([1, 0, 0, 0]), (COUNT, 1)),
                    log_scales=rng.normal(-4, 1, (COUNT, 3)).astype(np.float32),
                    opacity_logits=rng.normal(size=COUNT).astype(np.float32),
                    sh=np.zeros((COUNT, 1, 3), np.float32),
                    extras={"lod_bias": rng.uniform(0, 0.5, COUNT).astype(np.float32)},
                )
                level = bundles.Level(number, splats, {} if facts else {"s_min": s_min})
                lodgs("data.scenes").set_level(root, level)
        rule = ("octree", facts, {}, True) if facts else ("bands",)
        lodgs("data.scenes").set_bundle_facts(root, bundles.Bundle("", [], *rule))
        root.lodgs.mode = "SELECTIVE"
        root.location, root.rotation_euler, root.scale = (1, 2, 3), (0.3, 0.2, 0.1), (2, 2, 2)
        bpy.context.view_layer.update()
        return root

    return made


OCTREE = {"d_max": 16.0, "d_max_focal": 700.0}


def shown(bpy, lodgs):
    return lodgs("data.shown").visible_splats(bpy.context.evaluated_depsgraph_get())


def by_rule(bpy, lodgs, item):
    """A level's splats and weights as the viewport finds them: the object's own, by ``selection.choice``."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    own = lodgs("data.shown").read(item.object.data)
    choice = lodgs("data.selection").choice(item.object.evaluated_get(depsgraph), depsgraph)
    columns = {"lod_bias": lodgs("attributes").read_attribute(item.object.data, "lod_bias")}
    weights = np.ones(len(own)) if choice is None else choice.weights(own.means, columns).astype(float)
    return own.means[weights > 0], weights[weights > 0]


@pytest.mark.parametrize("facts", [None, OCTREE])
def test_the_rule_is_what_the_modifiers_leave(bpy, lodgs, scene_of, facts):
    """So no splat needs to be uploaded anew when the eye moves."""
    root = scene_of(facts)
    settings, camera = root.lodgs, bpy.context.scene.camera
    chosen = bpy.data.objects.new("chosen", None)
    bpy.context.scene.collection.objects.link(chosen)
    chosen.location = (0, 9, 1)

    def moved():
        camera.location = (9, -2, 4)

    def other():
        settings.eye, settings.eye_object = "OBJECT", chosen

    def fixed():
        settings.eye, settings.camera_center = "TRAINING", (3, 3, 3)

    def frozen():
        settings.eye, settings.freeze = "CAMERA", True
        camera.location = (-30, 0, 0)

    counts = set()
    for change in (lambda: None, moved, other, fixed, frozen):
        change()
        bpy.context.view_layer.update()
        found = {s.level: a for s, a in shown(bpy, lodgs)}
        for item in settings.levels:
            means, weights = by_rule(bpy, lodgs, item)
            arrays = found[item.number]
            if facts is None:
                assert np.array_equal(arrays.means, means)
                assert arrays.weights is None and (weights == 1).all()
            else:
                assert abs(len(arrays) - len(means)) <= 2  # the last bits of the logarithm at weight 0
                if len(arrays) == len(means):
                    assert np.abs(arrays.weights - weights).max() < 1e-4
        counts.add(tuple(len(a) for a in found.values()))
    assert len(counts) == 4  # frozen, it is as it was before


def pool_of(lodgs, sets):
    """The pool of (means, scales, opacities), and where each set starts."""
    arranging = lodgs("viewport.arranging")
    means, scales, opacities = (np.concatenate(parts).astype(np.float32) for parts in zip(*sets, strict=True))
    starts, areas = np.cumsum([0, *(len(part[0]) for part in sets)]), (scales**2).sum(axis=1)
    return arranging.Pool(means, areas, opacities, {"lod_bias": np.zeros(len(means), np.float32)}), starts


def placed(lodgs, first, count, *, matrix=None, level=1, choice=None, scene=0, tell="OWN"):
    matrix = np.eye(4) if matrix is None else matrix
    return lodgs("viewport.arranging").Placement(first, count, matrix.tobytes(), level, choice, scene, tell)


def choice(lodgs, rule, focal_px, facts, values):
    """A choice by an eye at the origin."""
    pairs = tuple(facts.items()), tuple(values.items())
    return lodgs("training.lod.query").LodQuery(rule, (0.0, 0.0, 0.0), focal_px, *pairs)


def random_set(rng, count):
    return rng.uniform(-1, 1, (count, 3)), np.exp(rng.normal(-3, 1, (count, 3))), rng.uniform(0, 1, count)


def test_all_sets_are_sorted_together_from_back_to_front(bpy, lodgs):
    rng = np.random.default_rng(3)
    sets = [random_set(rng, n) for n in (500, 300)]
    pool, starts = pool_of(lodgs, sets)
    matrices = [np.eye(4), np.eye(4)]
    matrices[1][:3] = rng.normal(size=(3, 4))
    backward = rng.normal(size=3)
    placements = tuple(
        placed(lodgs, int(start), len(part[0]), matrix=matrix, scene=i)
        for i, (start, part, matrix) in enumerate(zip(starts, sets, matrices, strict=False))
    )
    arranging = lodgs("viewport.arranging")
    result = arranging.arrange(pool, arranging.Request(placements, tuple(backward), 10**6))
    assert (result.count, result.left_out) == (800, 0)
    index, weight, place, tell = result.instances[:800].T
    assert sorted(index) == list(range(800))
    assert (weight == 1).all() and (tell == 0).all()
    assert np.array_equal(place, index >= 500)
    world = np.concatenate([p[0] @ m[:3, :3].T + m[:3, 3] for p, m in zip(sets, matrices, strict=True)])
    towards_eye = (world @ backward)[index.astype(int)]
    assert (np.diff(towards_eye) > -1e-5).all()


def test_ascending_is_a_stable_argsort(bpy, lodgs):
    rng = np.random.default_rng(5)
    values = (rng.normal(size=20_000) * 10.0 ** rng.integers(-44, 38, 20_000)).astype(np.float32)
    values[rng.integers(0, 20_000, 3000)] = rng.choice([0.0, -0.0, 1.0, -1.0, np.inf, -np.inf], 3000)
    ascending = lodgs("viewport.arranging").ascending
    for some in (values, values[:0], values[:1], np.repeat(np.float32(-2), 5)):
        assert np.array_equal(ascending(some), np.argsort(some, kind="stable"))


TABLE = (("chunks", tuple((axis, "<f4", np.float32(row).tobytes()) for axis, row in (
    ("x", [0, 0.8, -0.8]), ("y", [0, 0, 0.4]), ("z", [0, 0, 0]), ("radius", [1, 1, 0.7]),
))),)  # fmt: skip
RULES = {
    "bands": ({}, [0.9, 0.5, 0.0], "s_min"), "octree": ({"d_max": 1.5, "d_max_focal": 1.0}, [], ""),
    "chunks": ({}, [0.9, 0.5, 0.0], "d_l"), "decay": ({"reference": 2.0, "tau": 0.01}, [], ""),
    "cut": ({}, [], ""),
}  # fmt: skip


@pytest.mark.parametrize("name", RULES)
def test_what_is_kept_between_arrangements_is_what_is_found_anew(bpy, lodgs, monkeypatch, name):
    """Whatever changes from one to the next: each splat's row as by the rule alone, from back to front. While
    only the view turns or objects move, nothing is chosen anew."""
    rng, arranging = np.random.default_rng(8), lodgs("viewport.arranging")
    sets = [random_set(rng, n) for n in (300, 600, 1200)]
    pool, starts = pool_of(lodgs, sets)
    most_of = {"chunks_0": 8, "sigma_d": 1, "lod_bias": 1, "node_size": 0.04, "parent_size": 0.06}
    for column, most in most_of.items():
        values = rng.uniform(0, most, 2100)
        pool.columns[column] = np.float32(np.floor(values) if column == "chunks_0" else values)
    scene, ends, fact = RULES[name]
    rules = lodgs("training.lod.rule")
    rule, looked_at = rules.rules()[name], []
    levels = [(n, {fact: ends[n - 1]} if fact else {}) for n in (1, 2, 3)]
    choose = arranging.within_budget
    monkeypatch.setattr(arranging, "within_budget", lambda *a: looked_at.append(a) or choose(*a))

    def request(eye, backward, matrix=None, tell="OWN", budget=10**6, **values):
        placements = []
        for level, (start, part) in enumerate(zip(starts, sets, strict=False), 1):
            facts = rules.facts_of(rule, scene, levels, level)
            values = rule.defaults([1, 2, 3]) | values
            by = lodgs("training.lod.query").LodQuery(
                name, eye, 1.0, tuple(facts.items()), tuple(values.items()), TABLE if name == "chunks" else ()
            )
            place = {"matrix": matrix, "level": level, "choice": by, "tell": tell}
            placements.append(placed(lodgs, int(start), len(part[0]), **place))
        return arranging.Request(tuple(placements), backward, budget)

    here, moved = (0.1, 0.05, 0.0), np.eye(4)
    moved[:3, 3] = 3, 1, 2
    asked = [
        (request(here, (1, 0, 0)), True), (request(here, (0, 1, 0)), False),
        (request(here, (0, 1, 0), moved), False), (request((0.2, 0.1, 0), (0, 1, 0)), True),
        (request((0.9, 0.1, 0), (0, 1, 0)), True), (request(here, (0, 1, 0), tell="BANDS"), True),
        (request((-0.9, 0.4, 0), (0, 0, 1)), True), (request((5.0, 4.0, 0), (0, 0, 1)), True),
        (request(here, (1, 0, 0), budget=200), True), (request(here, (1, 0, 0)), True),
    ]  # fmt: skip
    counts = []
    for one, anew in asked:
        before = len(looked_at)
        result = arranging.arrange(pool, one)
        assert len(looked_at) == before + anew
        counts.append(result.count)
        rows = result.instances[: result.count]
        index, weight, number, _ = rows.T
        depth = np.empty(len(rows))
        for i, placement in enumerate(one.placements):
            mine = number == i
            world = pool.means[index[mine].astype(int)] @ placement.world[:3, :3].T + placement.world[:3, 3]
            depth[mine] = world @ one.backward
            if one.budget > 10**5:
                part = slice(placement.first, placement.first + placement.count)
                columns = {each: column[part] for each, column in pool.columns.items()}
                zeros = dict.fromkeys(rule.columns, np.zeros(placement.count, np.float32))
                own = placement.choice.weights(
                    pool.means[part], zeros | columns | {"opacity": pool.opacities[part]}
                )
                found = np.zeros(placement.count, np.float32)
                found[index[mine].astype(int) - placement.first] = weight[mine]
                np.testing.assert_array_equal(found, own)
        assert (np.diff(depth) > -1e-5).all()
        assert result.left_out == 0 if one.budget > 10**5 else result.count <= 200
    assert len(set(counts)) > 3 and 0 < counts[0] < 2100


def test_levels_that_add_up_lose_the_finest_first(bpy, lodgs):
    rng = np.random.default_rng(3)
    sets = [random_set(rng, n) for n in (100, 200, 400, 800)]
    pool, starts = pool_of(lodgs, sets)
    arranging = lodgs("viewport.arranging")
    placements = [
        placed(lodgs, int(start), len(part[0]), level=level)
        for level, (start, part) in enumerate(zip(starts, sets, strict=False), 1)
    ]
    for budget, counts in (
        (1500, (100, 200, 400, 800)),
        (1000, (100, 200, 400, 300)),
        (650, (100, 200, 350, 0)),
        (300, (100, 200, 0, 0)),
        (60, (60, 0, 0, 0)),
    ):
        chosen, left_out = arranging.within_budget(pool, placements, budget)
        assert tuple(len(index) for index, _ in chosen) == counts
        assert left_out == 1500 - sum(counts)
    visible = sets[0][2] * (sets[0][1] ** 2).sum(axis=1)
    assert set(chosen[0][0]) == set(np.argsort(visible)[-60:])


def test_coarser_levels_stand_in_for_the_finest(bpy, lodgs):
    """Where levels replace each other, no hole is left: the next coarser one reaches up to the eye."""
    rng = np.random.default_rng(3)
    sets = [random_set(rng, n) for n in (300, 600, 1200)]
    pool, starts = pool_of(lodgs, sets)
    bands = [(0.9, 1e30), (0.5, 0.9), (0.0, 0.5)]
    s_min, values = [0.9, 0.5, 0.0], {"gamma": 1.0, "first": 1, "last": 3}
    placements = []
    for level, (start, part) in enumerate(zip(starts, sets, strict=False), 1):
        facts = {"level": level, "finer": level + 1, "coarser": level - 1, "levels": 3}
        facts |= {"s_min": s_min[level - 1], "coarser_s_min": s_min[level - 2]}
        by = choice(lodgs, "bands", 1.0, facts, values)
        placements.append(placed(lodgs, int(start), len(part[0]), level=level, choice=by))
    distances = [np.linalg.norm(part[0], axis=1) for part in sets]
    arranging = lodgs("viewport.arranging")
    whole, left_out = arranging.within_budget(pool, placements, 10**6)
    assert left_out == 0
    for (index, _), distance, (near, far) in zip(whole, distances, bands, strict=True):
        assert np.array_equal(index, np.flatnonzero((distance >= near) & (distance < far)))
    total = sum(len(index) for index, _ in whole)
    chosen, _ = arranging.within_budget(pool, placements, total - 1)
    assert len(chosen[2][0]) == 0
    assert np.array_equal(chosen[1][0], np.flatnonzero(distances[1] < 0.9))
    assert np.array_equal(chosen[0][0], whole[0][0])
    chosen, _ = arranging.within_budget(pool, placements, 300)
    assert [len(index) for index, _ in chosen] == [300, 0, 0]


def test_a_budget_finds_its_choice_by_asking_a_few(bpy, lodgs, monkeypatch):
    """The same one as by asking all, of which it asks twice, whatever the number of steps to it."""
    rng, arranging = np.random.default_rng(4), lodgs("viewport.arranging")
    count, asked = 400_000, []
    pool, _ = pool_of(lodgs, [random_set(rng, count)])
    pool.columns.update(
        node_size=np.zeros(count, np.float32), parent_x=np.ones(count, np.float32),
        parent_size=np.float32(rng.uniform(0, 0.01, count)),
    )  # fmt: skip
    by = choice(lodgs, "cut", 1000.0, {"level": 2.0, "levels": 2.0}, {"pixels": 1.0})
    truth, budget = by, 100_000
    while len(pool.chooser(placed(lodgs, 0, count, level=2)).select(truth)[0]) > budget:
        truth = truth.coarser([1, 2])
    assert dict(truth.values)["pixels"] > 2
    choose = arranging._choose
    monkeypatch.setattr(arranging, "_choose", lambda *a: asked.append(a) or choose(*a))
    ((index, _),), left_out = arranging.within_budget(
        pool, [placed(lodgs, 0, count, level=2, choice=by)], budget
    )
    assert np.array_equal(index, pool.chooser(placed(lodgs, 0, count, level=2)).select(truth)[0])
    assert len({placement.choice for _, placement in asked}) <= 3 and left_out > budget


def test_colours_tell_levels_and_distances(bpy, lodgs):
    rng = np.random.default_rng(3)
    arranging = lodgs("viewport.arranging")
    part = random_set(rng, 400)
    pool, _ = pool_of(lodgs, [part])
    facts = {"level": 2, "levels": 4, "d_max": 2.0, "d_max_focal": 1.0}
    by = choice(lodgs, "octree", 1.0, facts, {"offset": 0.0, "fade": 1})
    distance = np.linalg.norm(part[0], axis=1)
    wanted = np.clip(np.log2(2.0 / distance), 0, 3) + 1
    for tell, truth in (("OWN", 0 * wanted), ("LEVELS", 0 * wanted + 2), ("BANDS", np.floor(wanted))):
        placement = placed(lodgs, 0, 400, level=2, choice=by, tell=tell)
        result = arranging.arrange(pool, arranging.Request((placement,), (0, 0, 1), 10**6))
        index, weight, _, told = result.instances[: result.count].T
        index = index.astype(int)
        assert result.count == (wanted > 1.25).sum()
        assert np.allclose(weight, np.clip(2 * wanted - 2.5, 0, 1)[index], atol=1e-4)
        assert np.array_equal(told, truth[index])


def test_colours_tell_how_large_nodes_are(bpy, lodgs):
    """Of a tree each octave has its colour, and the leaves have one."""
    rng, arranging = np.random.default_rng(3), lodgs("viewport.arranging")
    sizes = np.float32(rng.uniform(0.0001, 0.02, 300) ** 1.5 * rng.integers(0, 4, 300).clip(0, 1))
    pool, _ = pool_of(lodgs, [random_set(rng, 300)])
    pool.columns.update(node_size=sizes, parent_size=np.full(300, 3e38, np.float32))
    by = choice(lodgs, "cut", 1.0, {"level": 1.0, "levels": 2.0}, {"pixels": 1.0})
    placement = placed(lodgs, 0, 300, level=1, choice=by, tell="LEVELS")
    result = arranging.arrange(pool, arranging.Request((placement,), (0, 0, 1), 10**6))
    index, _, _, told = result.instances[: result.count].T
    sizes = sizes[index.astype(int)]
    assert result.count > 250 and 0 < (sizes == 0).sum() < 100
    assert np.array_equal(told, np.where(sizes > 0, (1 - np.frexp(sizes)[1]) % 11 + 1, 12))


def test_colours_tell_chunks(bpy, lodgs):
    rng = np.random.default_rng(3)
    arranging = lodgs("viewport.arranging")
    part = random_set(rng, 400)
    pool, _ = pool_of(lodgs, [part])
    centres = rng.normal(size=(5, 3)).astype(np.float32)
    columns = (*zip("xyz", centres.T, strict=True), ("radius", np.ones(5, np.float32)))
    table = tuple((name, "<f4", values.tobytes()) for name, values in columns)
    facts = {"level": 2, "finer": 1 << 30, "coarser": 0, "levels": 2, "d_l": 0, "coarser_d_l": 0}
    values = {"distance_scale": 1.0, "chunks": 0, "fade": 1}
    by = choice(lodgs, "chunks", 1.0, facts, values)
    nearest = np.linalg.norm(part[0][:, None] - centres, axis=2).argmin(axis=1) + 1
    for tables, truth in (((), 0 * nearest), ((("chunks", table),), nearest)):
        placement = placed(lodgs, 0, 400, level=2, choice=replace(by, tables=tables), tell="CHUNKS")
        result = arranging.arrange(pool, arranging.Request((placement,), (0, 0, 1), 10**6))
        assert result.count == 400
        assert np.array_equal(result.instances[:400, 3], truth[result.instances[:400, 0].astype(int)])


def test_freeze_keeps_the_choice_while_the_eye_moves_on(bpy, lodgs, scene_of):
    root = scene_of()
    settings, camera = root.lodgs, bpy.context.scene.camera
    before = [arrays.means for _, arrays in shown(bpy, lodgs)]
    settings.freeze = True
    camera.location, camera.data.lens = (20, 3, 9), 90
    bpy.context.view_layer.update()
    for mine, arrays in zip(before, (a for _, a in shown(bpy, lodgs)), strict=True):
        assert np.array_equal(mine, arrays.means)
    settings.freeze = False
    bpy.context.view_layer.update()
    assert [len(a) for _, a in shown(bpy, lodgs)] != [len(m) for m in before]


def test_the_viewports_eye(bpy, lodgs, scene_of):
    """Distances are from the view that was followed last, by its own focal length; freezing stops it."""
    root = scene_of()
    settings, follow = root.lodgs, lodgs("viewport.eye").follow
    settings.eye = "VIEW"

    def check(eye, focal):
        bpy.context.view_layer.update()
        local = np.linalg.solve(np.array(root.lodgs.axes.matrix_world, float), np.append(eye, 1))[:3]
        borders = [1e30, *(s / settings.bands.gamma * focal for s in S_MIN[:2]), 0]
        for (_, arrays), far, near in zip(shown(bpy, lodgs), borders, borders[1:], strict=False):
            own = lodgs("data.shown").read(root.lodgs.levels[borders.index(far)].object.data).means
            distance = np.linalg.norm(own - local, axis=1)
            assert abs(len(arrays) - ((distance >= near) & (distance < far)).sum()) <= 1

    for eye, focal in (((5, 5, 5), 900.0), ((-9, 0, 2), 2000.0)):
        follow(bpy.context.scene, eye, focal)
        check(eye, focal)
    settings.freeze = True
    follow(bpy.context.scene, (0, 0, 0), 500.0)
    check((-9, 0, 2), 2000.0)
    settings.freeze = False
    follow(bpy.context.scene, (0, 0, 0), 500.0)
    check((0, 0, 0), 500.0)


def test_where_a_view_is(bpy, lodgs, scene_of):
    """The eye and focal length of a camera's own matrices, and of a view without perspective."""
    from mathutils import Matrix

    scene_of()
    camera = bpy.context.scene.camera
    camera.location, camera.data.lens, camera.data.sensor_width = (1, 2, 3), 50, 36
    bpy.context.view_layer.update()
    depsgraph = bpy.context.evaluated_depsgraph_get()
    projection = camera.calc_matrix_camera(depsgraph, x=720, y=480)
    place = lodgs("viewport.eye").place
    eye, focal = place(camera.matrix_world.inverted(), projection, 720, 0)
    assert np.allclose(eye, (1, 2, 3), atol=1e-5) and focal == pytest.approx(50 / 36 * 720, rel=1e-5)
    # 8 units wide in 720 pixels: as large as in perspective at the point 10 units away that it turns about
    flat = Matrix(((2 / 8, 0, 0, 0), (0, 2 / 8, 0, 0), (0, 0, -2 / 40, 0), (0, 0, 0, 1)))
    eye, focal = place(Matrix.Translation((0, 0, -10)), flat, 720, 10)
    assert np.allclose(eye, (0, 0, 10)) and focal / 10 == pytest.approx(720 / 8, rel=1e-5)

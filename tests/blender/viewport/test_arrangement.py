"""Selection and order of viewport splats, and the view as their camera, compared with numpy and modifiers."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

COUNT = 3000
S_MIN = [0.012, 0.003, 0.0]


@pytest.fixture
def make_scene(bpy, lodgs):
    """``make_scene(facts)``: create a scene of three levels by distance, and a camera."""

    def make(facts=None):
        rng, bundles = np.random.default_rng(7), lodgs("training.splats.bundle")
        camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
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

    return make


OCTREE = {"d_max": 16.0, "d_max_focal": 700.0}


def visible_splats(bpy, lodgs):
    return lodgs("data.shown").visible_splats(bpy.context.evaluated_depsgraph_get())


def select_by_rule(bpy, lodgs, item):
    """Return the splat means and weights of a level as viewports select them."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    splats = lodgs("data.shown").read(item.object.data)
    query = lodgs("data.selection").evaluated_query(item.object.evaluated_get(depsgraph), depsgraph)
    columns = {"lod_bias": lodgs("attributes").read_attribute(item.object.data, "lod_bias")}
    weights = np.ones(len(splats)) if query is None else query.weights(splats.means, columns).astype(float)
    return splats.means[weights > 0], weights[weights > 0]


@pytest.mark.parametrize("facts", [None, OCTREE])
def test_rule_selects_the_splats_of_the_modifiers(bpy, lodgs, make_scene, facts):
    """Camera motion therefore needs no upload of splats."""
    root = make_scene(facts)
    settings, camera = root.lodgs, bpy.context.scene.camera
    target = bpy.data.objects.new("target", None)
    bpy.context.scene.collection.objects.link(target)
    target.location = (0, 9, 1)

    def move_camera():
        camera.location = (9, -2, 4)

    def use_object():
        settings.camera_choice, settings.camera_object = "OBJECT", target

    def use_training_center():
        settings.camera_choice, settings.camera_center = "TRAINING", (3, 3, 3)

    def freeze():
        settings.camera_choice, settings.freeze = "CAMERA", True
        camera.location = (-30, 0, 0)

    counts = set()
    for change in (lambda: None, move_camera, use_object, use_training_center, freeze):
        change()
        bpy.context.view_layer.update()
        visible = {s.level: a for s, a in visible_splats(bpy, lodgs)}
        for item in settings.levels:
            means, weights = select_by_rule(bpy, lodgs, item)
            arrays = visible[item.number]
            if facts is None:
                assert np.array_equal(arrays.means, means)
                assert arrays.weights is None and (weights == 1).all()
            else:
                assert abs(len(arrays) - len(means)) <= 2  # rounding of the logarithm at weight 0
                if len(arrays) == len(means):
                    assert np.abs(arrays.weights - weights).max() < 1e-4
        counts.add(tuple(len(a) for a in visible.values()))
    assert len(counts) == 4  # freezing changes nothing


def make_pool(lodgs, sets):
    """Return the pool of sets of (means, scales, opacities), and the first row of each set."""
    arrangement = lodgs("viewport.arrangement")
    means, scales, opacities = (np.concatenate(parts).astype(np.float32) for parts in zip(*sets, strict=True))
    starts, areas = np.cumsum([0, *(len(part[0]) for part in sets)]), (scales**2).sum(axis=1)
    return arrangement.Pool(means, areas, opacities, {"lod_bias": np.zeros(len(means), np.float32)}), starts


def make_placement(lodgs, first, count, *, matrix=None, level=1, query=None, scene=0, colors="OWN"):
    matrix = np.eye(4) if matrix is None else matrix
    return lodgs("viewport.arrangement").Placement(
        first, count, matrix.tobytes(), level, query, scene, colors
    )


def make_query(lodgs, rule, focal_px, facts, values):
    """Return a query for a camera at the origin."""
    pairs = tuple(facts.items()), tuple(values.items())
    return lodgs("training.lod.query").LodQuery(rule, (0.0, 0.0, 0.0), focal_px, *pairs)


def random_set(rng, count):
    return rng.uniform(-1, 1, (count, 3)), np.exp(rng.normal(-3, 1, (count, 3))), rng.uniform(0, 1, count)


def test_sets_are_sorted_together_from_back_to_front(bpy, lodgs):
    rng = np.random.default_rng(3)
    sets = [random_set(rng, n) for n in (500, 300)]
    pool, starts = make_pool(lodgs, sets)
    matrices = [np.eye(4), np.eye(4)]
    matrices[1][:3] = rng.normal(size=(3, 4))
    backward = rng.normal(size=3)
    placements = tuple(
        make_placement(lodgs, int(start), len(part[0]), matrix=matrix, scene=i)
        for i, (start, part, matrix) in enumerate(zip(starts, sets, matrices, strict=False))
    )
    arrangement = lodgs("viewport.arrangement")
    result = arrangement.arrange(pool, arrangement.Request(placements, tuple(backward), 10**6))
    assert (result.count, result.excluded) == (800, 0)
    index, weight, set_number, color_level = result.instances[:800].T
    assert sorted(index) == list(range(800))
    assert (weight == 1).all() and (color_level == 0).all()
    assert np.array_equal(set_number, index >= 500)
    world = np.concatenate([p[0] @ m[:3, :3].T + m[:3, 3] for p, m in zip(sets, matrices, strict=True)])
    towards_camera = (world @ backward)[index.astype(int)]
    assert (np.diff(towards_camera) > -1e-5).all()


def test_stable_argsort_matches_numpy(bpy, lodgs):
    rng = np.random.default_rng(5)
    values = (rng.normal(size=20_000) * 10.0 ** rng.integers(-44, 38, 20_000)).astype(np.float32)
    values[rng.integers(0, 20_000, 3000)] = rng.choice([0.0, -0.0, 1.0, -1.0, np.inf, -np.inf], 3000)
    stable_argsort = lodgs("viewport.arrangement").stable_argsort
    for case in (values, values[:0], values[:1], np.repeat(np.float32(-2), 5)):
        assert np.array_equal(stable_argsort(case), np.argsort(case, kind="stable"))


TABLE = (("chunks", tuple((axis, "<f4", np.float32(row).tobytes()) for axis, row in (
    ("x", [0, 0.8, -0.8]), ("y", [0, 0, 0.4]), ("z", [0, 0, 0]), ("radius", [1, 1, 0.7]),
))),)  # fmt: skip
RULES = {
    "bands": ({}, [0.9, 0.5, 0.0], "s_min"), "octree": ({"d_max": 1.5, "d_max_focal": 1.0}, [], ""),
    "chunks": ({}, [0.9, 0.5, 0.0], "d_l"), "decay": ({"reference": 2.0, "tau": 0.01}, [], ""),
    "cut": ({}, [], ""),
}  # fmt: skip


@pytest.mark.parametrize("name", RULES)
def test_cached_selections_match_the_rule(bpy, lodgs, monkeypatch, name):
    """Weights match the rule after any change; view rotation and object motion only sort."""
    rng, arrangement = np.random.default_rng(8), lodgs("viewport.arrangement")
    sets = [random_set(rng, n) for n in (300, 600, 1200)]
    pool, starts = make_pool(lodgs, sets)
    column_ends = {"chunks_0": 8, "sigma_d": 1, "lod_bias": 1, "node_size": 0.04, "parent_size": 0.06}
    for column, end in column_ends.items():
        values = rng.uniform(0, end, 2100)
        pool.columns[column] = np.float32(np.floor(values) if column == "chunks_0" else values)
    scene, ends, fact = RULES[name]
    rules = lodgs("training.lod.rule")
    rule, selections = rules.rules()[name], []
    levels = [(n, {fact: ends[n - 1]} if fact else {}) for n in (1, 2, 3)]
    select = arrangement.select_within_budget
    monkeypatch.setattr(arrangement, "select_within_budget", lambda *a: selections.append(a) or select(*a))

    def request(position, backward, matrix=None, colors="OWN", budget=10**6, **values):
        placements = []
        for level, (start, part) in enumerate(zip(starts, sets, strict=False), 1):
            facts = rules.collect_facts(rule, scene, levels, level)
            values = rule.defaults([1, 2, 3]) | values
            query = lodgs("training.lod.query").LodQuery(
                name,
                position,
                1.0,
                tuple(facts.items()),
                tuple(values.items()),
                TABLE if name == "chunks" else (),
            )
            options = {"matrix": matrix, "level": level, "query": query, "colors": colors}
            placements.append(make_placement(lodgs, int(start), len(part[0]), **options))
        return arrangement.Request(tuple(placements), backward, budget)

    origin, moved = (0.1, 0.05, 0.0), np.eye(4)
    moved[:3, 3] = 3, 1, 2
    steps = [
        (request(origin, (1, 0, 0)), True), (request(origin, (0, 1, 0)), False),
        (request(origin, (0, 1, 0), moved), False), (request((0.2, 0.1, 0), (0, 1, 0)), True),
        (request((0.9, 0.1, 0), (0, 1, 0)), True), (request(origin, (0, 1, 0), colors="BANDS"), True),
        (request((-0.9, 0.4, 0), (0, 0, 1)), True), (request((5.0, 4.0, 0), (0, 0, 1)), True),
        (request(origin, (1, 0, 0), budget=200), True), (request(origin, (1, 0, 0)), True),
    ]  # fmt: skip
    counts = []
    for step, selects in steps:
        previous = len(selections)
        result = arrangement.arrange(pool, step)
        assert len(selections) == previous + selects
        counts.append(result.count)
        rows = result.instances[: result.count]
        index, weight, number, _ = rows.T
        depth = np.empty(len(rows))
        for i, placement in enumerate(step.placements):
            rows_of_set = number == i
            world = (
                pool.means[index[rows_of_set].astype(int)] @ placement.world[:3, :3].T
                + placement.world[:3, 3]
            )
            depth[rows_of_set] = world @ step.backward
            if step.budget > 10**5:
                part = slice(placement.first, placement.first + placement.count)
                columns = {key: column[part] for key, column in pool.columns.items()}
                zeros = dict.fromkeys(rule.columns, np.zeros(placement.count, np.float32))
                expected = placement.query.weights(
                    pool.means[part], zeros | columns | {"opacity": pool.opacities[part]}
                )
                drawn = np.zeros(placement.count, np.float32)
                drawn[index[rows_of_set].astype(int) - placement.first] = weight[rows_of_set]
                np.testing.assert_array_equal(drawn, expected)
        assert (np.diff(depth) > -1e-5).all()
        assert result.excluded == 0 if step.budget > 10**5 else result.count <= 200
    assert len(set(counts)) > 3 and 0 < counts[0] < 2100


def test_budget_excludes_the_finest_additive_level_first(bpy, lodgs):
    rng = np.random.default_rng(3)
    sets = [random_set(rng, n) for n in (100, 200, 400, 800)]
    pool, starts = make_pool(lodgs, sets)
    arrangement = lodgs("viewport.arrangement")
    placements = [
        make_placement(lodgs, int(start), len(part[0]), level=level)
        for level, (start, part) in enumerate(zip(starts, sets, strict=False), 1)
    ]
    for budget, counts in (
        (1500, (100, 200, 400, 800)),
        (1000, (100, 200, 400, 300)),
        (650, (100, 200, 350, 0)),
        (300, (100, 200, 0, 0)),
        (60, (60, 0, 0, 0)),
    ):
        selections, excluded = arrangement.select_within_budget(pool, placements, budget)
        assert tuple(len(index) for index, _ in selections) == counts
        assert excluded == 1500 - sum(counts)
    visible = sets[0][2] * (sets[0][1] ** 2).sum(axis=1)
    assert set(selections[0][0]) == set(np.argsort(visible)[-60:])


def test_budget_keeps_the_splats_that_are_largest_in_the_image(bpy, lodgs):
    """Two sets with different transforms share a budget; the view is near the second one."""
    rng = np.random.default_rng(5)
    sets = [random_set(rng, n) for n in (400, 600)]
    pool, starts = make_pool(lodgs, sets)
    arrangement = lodgs("viewport.arrangement")
    matrices = [np.diag([3.0, 3, 3, 1]), np.eye(4)]
    matrices[1][:3, 3] = 20, 0, 0
    placements = [
        make_placement(lodgs, int(start), len(part[0]), matrix=matrix, scene=int(start))
        for start, part, matrix in zip(starts, sets, matrices, strict=False)
    ]
    position = (22.0, 1.0, 0.0)
    request = arrangement.Request(tuple(placements), (0, 0, 1), 300, position)
    result = arrangement.arrange(pool, request)
    values = []
    for (means, scales, opacities, *_), matrix, scale in zip(sets, matrices, (3, 1), strict=True):
        distance = np.linalg.norm(means @ matrix[:3, :3].T + matrix[:3, 3] - position, axis=1)
        size = scale**2 * (scales.astype(float) ** 2).sum(1)
        values.append(opacities * size / np.maximum(distance**2, size))
    expected = np.argsort(np.concatenate(values))[-300:]
    assert len(set(result.splats) ^ set(expected)) <= 2 and result.excluded == 700  # rounding
    moved = arrangement.arrange(pool, replace(request, position=(0.0, 0.0, 5.0)))
    assert len(set(moved.splats) - set(expected)) > 30


def test_moving_views_sort_the_splats_that_they_draw(bpy, lodgs):
    """They are those that a resting view prepares for the next motion, also of two transformed sets."""
    rng = np.random.default_rng(6)
    sets = [random_set(rng, n) for n in (3000, 2000)]
    pool, starts = make_pool(lodgs, sets)
    arrangement = lodgs("viewport.arrangement")
    matrices = [np.diag([3.0, 3, 3, 1]), np.eye(4)]
    matrices[1][:3, 3] = 20, 0, 0
    placements = tuple(
        make_placement(lodgs, int(start), len(part[0]), matrix=matrix, scene=int(start))
        for start, part, matrix in zip(starts, sets, matrices, strict=False)
    )
    request = arrangement.Request(placements, (0.6, 0.0, 0.8), 10**6, motion=(500, (1.0, 2.0, 9.0)))
    resting = arrangement.arrange(pool, request)
    moving = arrangement.arrange(pool, replace(request, moving=True))
    assert len(resting.instances) == 5000 and 400 < len(moving.instances) < 600
    assert np.array_equal(moving.instances, resting.motion)
    assert set(moving.splats) == set(resting.splats) == set(range(5000)), "all stay uploaded"
    kept = np.isin(resting.instances[:, 0], moving.instances[:, 0])
    assert np.array_equal(resting.instances[kept, 0], moving.instances[:, 0]), "from back to front"
    few = arrangement.arrange(pool, replace(request, motion=(6000, (1.0, 2.0, 9.0)), moving=True))
    assert np.array_equal(few.instances, resting.instances) and few.motion is None


def test_budget_replaces_the_finest_level_by_coarser_ones(bpy, lodgs):
    """Levels that replace each other leave no hole: the next coarser one reaches the camera."""
    rng = np.random.default_rng(3)
    sets = [random_set(rng, n) for n in (300, 600, 1200)]
    pool, starts = make_pool(lodgs, sets)
    bands = [(0.9, 1e30), (0.5, 0.9), (0.0, 0.5)]
    s_min, values = [0.9, 0.5, 0.0], {"gamma": 1.0, "first": 1, "last": 3}
    placements = []
    for level, (start, part) in enumerate(zip(starts, sets, strict=False), 1):
        facts = {"level": level, "finer": level + 1, "coarser": level - 1, "levels": 3}
        facts |= {"s_min": s_min[level - 1], "coarser_s_min": s_min[level - 2]}
        query = make_query(lodgs, "bands", 1.0, facts, values)
        placements.append(make_placement(lodgs, int(start), len(part[0]), level=level, query=query))
    distances = [np.linalg.norm(part[0], axis=1) for part in sets]
    arrangement = lodgs("viewport.arrangement")
    full, excluded = arrangement.select_within_budget(pool, placements, 10**6)
    assert excluded == 0
    for (index, _), distance, (near, far) in zip(full, distances, bands, strict=True):
        assert np.array_equal(index, np.flatnonzero((distance >= near) & (distance < far)))
    total = sum(len(index) for index, _ in full)
    selections, _ = arrangement.select_within_budget(pool, placements, total - 1)
    assert len(selections[2][0]) == 0
    assert np.array_equal(selections[1][0], np.flatnonzero(distances[1] < 0.9))
    assert np.array_equal(selections[0][0], full[0][0])
    selections, _ = arrangement.select_within_budget(pool, placements, 300)
    assert [len(index) for index, _ in selections] == [300, 0, 0]


def test_slight_motion_keeps_the_detail_of_a_budget(bpy, lodgs):
    """A camera that moves by 1 % to and fro, where the budget flips the detail, flips it once."""
    rng, arrangement = np.random.default_rng(5), lodgs("viewport.arrangement")
    count = 20_000
    pool, _ = make_pool(lodgs, [random_set(rng, count)])
    pool.columns.update(
        node_size=np.zeros(count, np.float32), parent_x=np.zeros(count, np.float32),
        parent_size=np.float32(rng.uniform(0, 0.01, count)),
    )  # fmt: skip
    query = make_query(lodgs, "cut", 1000.0, {"level": 2.0, "levels": 2.0}, {"pixels": 1.0})

    def request(distance, coarsened=None):
        moved = replace(query, position=(0.0, 0.0, distance))
        placements = (make_placement(lodgs, 0, count, level=2, query=moved),)
        position, coarsened = (0.0, 0.0, distance), coarsened or Counter()
        return arrangement.Request(placements, (0, 0, 1), 5_000, position, coarsened)

    far, near = 3.0, 1.5  # the nearer camera needs more coarsening
    steps = [arrangement.arrange(pool, request(d)).coarsened[0] for d in (far, near)]
    assert steps[0] < steps[1]
    while far - near > 1e-6:
        middle = (near + far) / 2
        far, near = (
            (middle, near)
            if arrangement.arrange(pool, request(middle)).coarsened[0] == steps[0]
            else (far, middle)
        )
    walk = [far * factor for factor in (1.005, 0.995) * 10]
    stateless = [arrangement.arrange(pool, request(d)).coarsened[0] for d in walk]
    assert np.count_nonzero(np.diff(stateless)) == 19
    coarsened, counts = Counter(), []
    for distance in walk:
        result = arrangement.arrange(pool, request(distance, coarsened))
        coarsened = result.coarsened
        counts.append((coarsened[0], result.count <= 5_000))
    assert np.count_nonzero(np.diff([steps for steps, _ in counts])) == 1 and all(fits for _, fits in counts)
    assert arrangement.arrange(pool, request(2 * far, coarsened)).coarsened[0] <= steps[0]


def test_budget_coarsens_queries_with_estimates(bpy, lodgs, monkeypatch):
    """Estimates lead to the same query as exact counts, with at most three exact queries."""
    rng, arrangement = np.random.default_rng(4), lodgs("viewport.arrangement")
    count, exact_queries = 400_000, []
    pool, _ = make_pool(lodgs, [random_set(rng, count)])
    pool.columns.update(
        node_size=np.zeros(count, np.float32), parent_x=np.ones(count, np.float32),
        parent_size=np.float32(rng.uniform(0, 0.01, count)),
    )  # fmt: skip
    query = make_query(lodgs, "cut", 1000.0, {"level": 2.0, "levels": 2.0}, {"pixels": 1.0})
    truth, budget = query, 100_000
    while len(pool.selector(make_placement(lodgs, 0, count, level=2)).select(truth)[0]) > budget:
        truth = truth.coarser([1, 2])
    assert dict(truth.values)["pixels"] > 2
    select = arrangement._select
    monkeypatch.setattr(arrangement, "_select", lambda *a: exact_queries.append(a) or select(*a))
    ((index, _),), excluded = arrangement.select_within_budget(
        pool, [make_placement(lodgs, 0, count, level=2, query=query)], budget
    )
    assert np.array_equal(index, pool.selector(make_placement(lodgs, 0, count, level=2)).select(truth)[0])
    assert len({placement.query for _, placement in exact_queries}) <= 3 and excluded > budget


def test_colours_show_levels_and_distance_bands(bpy, lodgs):
    rng = np.random.default_rng(3)
    arrangement = lodgs("viewport.arrangement")
    part = random_set(rng, 400)
    pool, _ = make_pool(lodgs, [part])
    facts = {"level": 2, "levels": 4, "d_max": 2.0, "d_max_focal": 1.0}
    query = make_query(lodgs, "octree", 1.0, facts, {"offset": 0.0, "fade": 1})
    distance = np.linalg.norm(part[0], axis=1)
    target = np.clip(np.log2(2.0 / distance), 0, 3) + 1
    for colors, truth in (("OWN", 0 * target), ("LEVELS", 0 * target + 2), ("BANDS", np.floor(target))):
        placement = make_placement(lodgs, 0, 400, level=2, query=query, colors=colors)
        result = arrangement.arrange(pool, arrangement.Request((placement,), (0, 0, 1), 10**6))
        index, weight, _, color_level = result.instances[: result.count].T
        index = index.astype(int)
        assert result.count == (target > 1.25).sum()
        assert np.allclose(weight, np.clip(2 * target - 2.5, 0, 1)[index], atol=1e-4)
        assert np.array_equal(color_level, truth[index])


def test_colours_show_node_sizes(bpy, lodgs):
    """Each octave of node sizes has a colour, and leaves have another."""
    rng, arrangement = np.random.default_rng(3), lodgs("viewport.arrangement")
    sizes = np.float32(rng.uniform(0.0001, 0.02, 300) ** 1.5 * rng.integers(0, 4, 300).clip(0, 1))
    pool, _ = make_pool(lodgs, [random_set(rng, 300)])
    pool.columns.update(node_size=sizes, parent_size=np.full(300, 3e38, np.float32))
    query = make_query(lodgs, "cut", 1.0, {"level": 1.0, "levels": 2.0}, {"pixels": 1.0})
    placement = make_placement(lodgs, 0, 300, level=1, query=query, colors="LEVELS")
    result = arrangement.arrange(pool, arrangement.Request((placement,), (0, 0, 1), 10**6))
    index, _, _, color_level = result.instances[: result.count].T
    sizes = sizes[index.astype(int)]
    assert result.count > 250 and 0 < (sizes == 0).sum() < 100
    assert np.array_equal(color_level, np.where(sizes > 0, (1 - np.frexp(sizes)[1]) % 11 + 1, 12))


def test_colours_show_chunks(bpy, lodgs):
    rng = np.random.default_rng(3)
    arrangement = lodgs("viewport.arrangement")
    part = random_set(rng, 400)
    pool, _ = make_pool(lodgs, [part])
    centres = rng.normal(size=(5, 3)).astype(np.float32)
    columns = (*zip("xyz", centres.T, strict=True), ("radius", np.ones(5, np.float32)))
    table = tuple((name, "<f4", values.tobytes()) for name, values in columns)
    facts = {"level": 2, "finer": 1 << 30, "coarser": 0, "levels": 2, "d_l": 0, "coarser_d_l": 0}
    values = {"distance_scale": 1.0, "chunks": 0, "fade": 1}
    query = make_query(lodgs, "chunks", 1.0, facts, values)
    nearest = np.linalg.norm(part[0][:, None] - centres, axis=2).argmin(axis=1) + 1
    for tables, truth in (((), 0 * nearest), ((("chunks", table),), nearest)):
        placement = make_placement(
            lodgs, 0, 400, level=2, query=replace(query, tables=tables), colors="CHUNKS"
        )
        result = arrangement.arrange(pool, arrangement.Request((placement,), (0, 0, 1), 10**6))
        assert result.count == 400
        assert np.array_equal(result.instances[:400, 3], truth[result.instances[:400, 0].astype(int)])


def test_freeze_keeps_the_selection_while_the_camera_moves(bpy, lodgs, make_scene):
    root = make_scene()
    settings, camera = root.lodgs, bpy.context.scene.camera
    frozen_means = [arrays.means for _, arrays in visible_splats(bpy, lodgs)]
    settings.freeze = True
    camera.location, camera.data.lens = (20, 3, 9), 90
    bpy.context.view_layer.update()
    for means, arrays in zip(frozen_means, (a for _, a in visible_splats(bpy, lodgs)), strict=True):
        assert np.array_equal(means, arrays.means)
    settings.freeze = False
    bpy.context.view_layer.update()
    assert [len(a) for _, a in visible_splats(bpy, lodgs)] != [len(m) for m in frozen_means]


def test_view_as_camera_selects_by_stored_views(bpy, lodgs, make_scene):
    """Distances refer to the last stored view and its focal length; freezing stops updates."""
    root = make_scene()
    settings, store_view = root.lodgs, lodgs("viewport.view_camera").store_view
    settings.camera_choice = "VIEW"

    def check(position, focal):
        bpy.context.view_layer.update()
        local = np.linalg.solve(np.array(root.lodgs.axes.matrix_world, float), np.append(position, 1))[:3]
        borders = [1e30, *(s / settings.bands.gamma * focal for s in S_MIN[:2]), 0]
        for (_, arrays), far, near in zip(visible_splats(bpy, lodgs), borders, borders[1:], strict=False):
            means = lodgs("data.shown").read(root.lodgs.levels[borders.index(far)].object.data).means
            distance = np.linalg.norm(means - local, axis=1)
            assert abs(len(arrays) - ((distance >= near) & (distance < far)).sum()) <= 1

    for position, focal in (((5, 5, 5), 900.0), ((-9, 0, 2), 2000.0)):
        store_view(bpy.context.scene, position, focal)
        check(position, focal)
    settings.freeze = True
    store_view(bpy.context.scene, (0, 0, 0), 500.0)
    check((-9, 0, 2), 2000.0)
    settings.freeze = False
    store_view(bpy.context.scene, (0, 0, 0), 500.0)
    check((0, 0, 0), 500.0)


def test_camera_of_perspective_and_orthographic_views(bpy, lodgs, make_scene):
    """Position and focal length match a camera's matrices, and an orthographic view."""
    from mathutils import Matrix

    make_scene()
    camera = bpy.context.scene.camera
    camera.location, camera.data.lens, camera.data.sensor_width = (1, 2, 3), 50, 36
    bpy.context.view_layer.update()
    depsgraph = bpy.context.evaluated_depsgraph_get()
    projection = camera.calc_matrix_camera(depsgraph, x=720, y=480)
    camera_of_view = lodgs("viewport.view_camera").camera_of_view
    position, focal = camera_of_view(camera.matrix_world.inverted(), projection, 720, 0)
    assert np.allclose(position, (1, 2, 3), atol=1e-5) and focal == pytest.approx(50 / 36 * 720, rel=1e-5)
    # 8 units in 720 pixels: the scale of a perspective view at the orbit point, 10 units away
    flat = Matrix(((2 / 8, 0, 0, 0), (0, 2 / 8, 0, 0), (0, 0, -2 / 40, 0), (0, 0, 0, 1)))
    position, focal = camera_of_view(Matrix.Translation((0, 0, -10)), flat, 720, 10)
    assert np.allclose(position, (0, 0, 10)) and focal / 10 == pytest.approx(720 / 8, rel=1e-5)

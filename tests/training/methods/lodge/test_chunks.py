"""Tests of LODGE's chunks: Eq. 5, sets against references, and a run with chunks."""

import numpy as np

from training.lod.rules.chunks import RULE, in_chunk
from training.lod.selection import BundleSelector, resolve_controls
from training.methods import create, method_info
from training.methods.lodge import chunks
from training.methods.lodge.composite import IndexedLevel
from training.optimize.parameters import override
from training.rasterize import Gaussians
from training.scenes.cameras import Camera, look_at
from training.splats.gaussians import Splats
from training.splats.levels import Bundle
from training.splats.morton import spatial_order

NAMES = ("means", "quats", "log_scales", "opacity_logits", "sh")


def create_level(means, log_scale=-3.0) -> IndexedLevel:
    count = len(means)
    return IndexedLevel.of(
        Gaussians.of(
            Splats(
                np.float32(means), np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
                np.full((count, 3), log_scale, np.float32), np.full(count, 5, np.float32),
                np.zeros((count, 1, 3), np.float32),
            )
        )
    )  # fmt: skip


def test_chunk_count():
    """Eq. 5: 4 / d_1 * 6, as the farthest camera is at distance 6 from the mean; at most one per camera."""
    centers = np.array([[x, 0, 0] for x in np.linspace(-6, 6, 31)])
    assert chunks.chunk_count(centers, 2.0) == 12
    assert chunks.chunk_count(centers, 2.1) == 12  # 11.4
    assert chunks.chunk_count(centers, 0.1) == 31
    assert chunks.chunk_count(np.tile(centers, (20, 1)), 0.01) == 96


def test_chunk_centres_and_radii():
    """Two clusters and a distant camera: centres are means, radii reach the next centre."""
    positions = np.array([[0, 0, 0], [2, 0, 0], [10, 0, 0], [12, 0, 0], [40, 0, 0]], float)
    centres, radii = chunks.place_chunks(positions, 3, 0)
    order = np.argsort(centres[:, 0])
    np.testing.assert_allclose(centres[order, 0], [1, 11, 40])
    np.testing.assert_allclose(radii[order], [10, 10, 29])
    first, reach = chunks.place_chunks(positions, 1, 0)
    np.testing.assert_allclose(first, [[12.8, 0, 0]])
    np.testing.assert_allclose(reach, [27.2])  # to the farthest camera


def test_chunk_radius_increases_distances():
    """Splats at unit intervals along a line from the centre; d_l of 4 and 8, and a radius of 3."""
    line = create_level([[x, 0, 0] for x in range(20)])
    actual = chunks.chunk_rows({3: line, 2: line, 1: line}, {3: 0.0, 2: 4.0, 1: 8.0}, np.zeros(3), 3.0)
    assert [actual[n].tolist() for n in (3, 2, 1)] == [[*range(7)], [*range(7, 11)], [*range(11, 20)]]


def test_hidden_splats_are_not_in_a_set():
    """An opaque wall hides splats from cameras of every orientation."""
    y, z = (item.reshape(-1) for item in np.meshgrid(np.linspace(-3, 3, 61), np.linspace(-3, 3, 61)))
    wall = np.stack([0 * y + 2, y, z], axis=1)
    hidden, visible = [[2.5, 0, 0], [2.4, 0.3, 0.1]], [[1.5, 0, 0], [-2, 0, 0]]
    level = create_level(np.concatenate([wall, hidden, visible]), log_scale=np.log(0.12))
    camera = Camera(
        "", 64, 64, 60.0, 60.0, 32.0, 32.0, look_at(np.zeros(3), np.array([1.0, 0, 0]), (0, 0, 1))
    )
    rows = {1: np.arange(len(wall) + 4, dtype=np.int32)}
    actual = chunks.prune_invisible({1: level}, rows, [camera], 0.005, 0.1, "cpu")[1]
    count = len(wall)
    assert not {count, count + 1} & set(actual) and count + 2 in actual
    assert count + 3 not in actual  # behind the camera
    turned = chunks.turn_cameras([camera] * 8, np.random.default_rng(0))
    assert len(turned) == 32 and all(np.allclose(view.center, 0) for view in turned)
    actual = chunks.prune_invisible({1: level}, rows, [camera, *turned], 0.005, 0.1, "cpu")[1]
    assert not {count, count + 1} & set(actual) and {count + 2, count + 3} <= set(actual)


def make(data, **values):
    parameters = {
        "steps": 8, "densify_until": 0.4, "prune_interval": 6, "tune_steps": 2, "margin": 0.0, "chunks": 3,
        "distances": [1.6, 0.8, 0.0], **values,
    }  # fmt: skip
    return create("lodge", data, override(method_info("lodge").preset("draft"), parameters), 0, "cpu")


def trained(lodge, begin=0, until=None):
    step, levels = begin, []
    while step < (until or lodge.steps):
        lodge.train_step(step)
        levels += lodge.levels_after(step)
        step += 1
    return levels


def test_last_steps_compute_chunks_and_return_all_levels(data):
    lodge = make(data)
    assert lodge.steps == 8 + 2 * 2 * 2  # the steps of chunks are added once chunks exist
    levels = trained(lodge)
    assert lodge.steps == 16 + 3 and lodge.stage(17) == "chunk 2 of 3"
    assert [level.number for level in levels] == [3, 2, 1, 1, 2, 3]
    table = lodge.tables()["chunks"]
    assert {len(column) for column in table.values()} == {3} and list(table) == ["x", "y", "z", "radius"]
    for initial, final in zip(levels[:3], levels[:2:-1], strict=True):
        assert initial.number == final.number and list(final.splats.extras) == ["chunks_0"]
        assert all(np.array_equal(getattr(initial.splats, n), getattr(final.splats, n)) for n in NAMES)
    finest = levels[0].splats.means
    np.testing.assert_array_equal(spatial_order(finest), np.arange(len(finest)))
    drawn = [in_chunk(level.splats.extras, 1) for level in levels[3:]]
    assert 0 < sum(item.sum() for item in drawn) < sum(map(len, drawn))


def test_sets_without_visibility_follow_distances(data):
    lodge = make(data, visible_weight=0.0)
    levels = trained(lodge)[3:]
    table = lodge.tables()["chunks"]
    centre, radius = np.array([table[axis][2] for axis in "xyz"]), table["radius"][2]
    ends = {1: (1.6, np.inf), 2: (0.8, 1.6), 3: (0.0, 0.8)}
    for level in levels:
        near, far = (end * data.median_depth + (radius if end else 0) for end in ends[level.number])
        distances = np.linalg.norm(level.splats.means - centre, axis=1)
        np.testing.assert_array_equal(
            in_chunk(level.splats.extras, 2), (distances >= near) & (distances < far)
        )


def test_small_scenes_have_no_chunks_by_default(data):
    lodge = make(data, chunks=0)
    assert [level.number for level in trained(lodge)] == [3, 2, 1] and lodge.tables() == {}
    assert trained(make(data, chunks=1))[-1].splats.extras == {}


def test_published_preset_makes_as_few_chunks_as_equation_5_gives(data):
    """4 / d_1 times the distance of the farthest camera from the mean, below the 8 of other presets."""
    assert method_info("lodge").preset("paper").min_chunks == 2
    lodge = make(data, chunks=0, min_chunks=2)
    trained(lodge, until=9)
    centers = np.array([camera.center for camera in data.train])
    reach = np.linalg.norm(centers - centers.mean(0), axis=1).max()
    assert len(lodge.centers) == np.ceil(4 / (0.8 * data.median_depth) * reach) < 8


def test_loaded_splats_belong_to_the_sets_of_near_chunks(data):
    lodge = make(data)
    bundle = Bundle("lodge", trained(lodge)[3:], "chunks", tables=lodge.tables())
    selector, values = BundleSelector(bundle), resolve_controls(bundle, {})
    between = (lodge.centers[0] + 0.4 * (lodge.centers[1] - lodge.centers[0])).astype(float)
    chunks_near = RULE.region(between, values, bundle.tables)
    assert chunks_near is not None and len(chunks_near) == 2
    bits = sum(1 << chunk for chunk in chunks_near)
    members = [level.splats.extras["chunks_0"].astype(int) & bits != 0 for level in bundle.levels]
    assert selector.loaded(between, values) == sum(item.sum() for item in members)
    total = sum(len(level.splats) for level in bundle.levels)
    assert selector.loaded(between, {**values, "chunks": 0}) == total


def test_resume_in_chunks_is_bit_identical(data, check_resumed):
    check_resumed(lambda: make(data), 15, 16, 17, 18)

"""Tests of building trees: moments of the leaves, opacity without holes, termination for extreme input."""

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from scipy.spatial.transform import Rotation
from scipy.special import expit, logit

from training.errors import LodgsError
from training.methods.tree.build import ERROR_SCALE, MAX_SPREAD, build
from training.optimize.merging import COLOR_WEIGHT, MAX_OPACITY, optical_depth
from training.rasterize import Gaussians, rasterize
from training.scenes.cameras import Camera
from training.splats.gaussians import SH_C0, Splats, splat_area


def scene(count, seed=0, opacity=0.6):
    rng = np.random.default_rng(seed)
    return Splats(
        rng.normal(0, 3, (count, 3)).astype(np.float32),
        rng.normal(size=(count, 4)).astype(np.float32),
        rng.normal(-3, 0.6, (count, 3)).astype(np.float32),
        np.full(count, logit(opacity), np.float32),
        rng.normal(0, 0.3, (count, 4, 3)).astype(np.float32),
        {"other": np.zeros(count, np.float32)},
    )


def covariances(splats):
    rotations = Rotation.from_quat(splats.quats[:, [1, 2, 3, 0]].astype(float)).as_matrix()
    scales = np.exp(splats.log_scales.astype(float))
    return np.einsum("nij,nj,nkj->nik", rotations, scales**2, rotations)


def leaves_below(tree, node):
    """Yield the leaves below a node."""
    if node < tree.leaves:
        return [node]
    return [leaf for child in tree.children[node - tree.leaves] for leaf in leaves_below(tree, child)]


@pytest.mark.parametrize("count", [2, 3, 17, 600])
def test_nodes_have_moments_of_their_leaves(count):
    nodes, tree = build(scene(count))
    assert len(nodes) == len(tree) == 2 * count - 1 and tree.leaves == count
    assert sorted(leaves_below(tree, len(tree) - 1)) == list(range(count))
    means, spreads = nodes.means.astype(float), covariances(nodes)
    weights = optical_depth(expit(nodes.opacity_logits.astype(float))) * splat_area(nodes.log_scales)
    for node in range(count, len(tree), 1 + count // 40):
        leaves = leaves_below(tree, node)
        shares = weights[leaves] / weights[leaves].sum()
        mean = shares @ means[leaves]
        np.testing.assert_allclose(means[node], mean, atol=1e-4)
        offsets = means[leaves] - mean
        expected = np.einsum("n,nij->ij", shares, spreads[leaves] + offsets[:, :, None] * offsets[:, None])
        ratio = np.trace(spreads[node]) / np.trace(expected)
        assert 0.999 < ratio < MAX_SPREAD * 1.001
        np.testing.assert_allclose(spreads[node] / ratio, expected, atol=1e-3 * np.trace(expected))
        color = np.einsum("n,nkc->kc", shares, nodes.sh[leaves])
        np.testing.assert_allclose(nodes.sh[node], color, atol=1e-4)
        if expit(nodes.opacity_logits[node]) < MAX_OPACITY * 0.999:  # optical depth is preserved
            assert weights[node] == pytest.approx(weights[leaves].sum(), rel=1e-3) and ratio < 1.001


def test_opacities_stay_below_one():
    stacked = scene(500, opacity=0.98)
    stacked.means[:] *= np.float32(0.01)
    nodes, tree = build(stacked)
    opacities = expit(nodes.opacity_logits.astype(float))
    assert opacities.max() <= MAX_OPACITY * 1.00001 and opacities[tree.leaves :].min() > 0.9


@pytest.mark.parametrize("opacity", [0.02, 0.5, 0.9, 0.99])
def test_optical_depth_is_integral_of_absorption(opacity):
    depth, _ = quad(lambda r: -np.log(1 - opacity * np.exp(-r * r / 2)) * r, 0, 12)
    assert optical_depth(np.array([opacity]))[0] == pytest.approx(depth, rel=1e-5)


def test_merged_coincident_splats_keep_optical_depth():
    two = scene(2, opacity=0.3)
    for column in (two.means, two.quats, two.log_scales):
        column[1] = column[0]
    nodes, _ = build(two)
    # opacity is 1 - 0.7² in the centre and relatively more outside; one splat of 0.55 has the same depth
    assert expit(nodes.opacity_logits[2]) == pytest.approx(0.55, abs=0.01)
    np.testing.assert_allclose(covariances(nodes)[2], covariances(nodes)[0], rtol=1e-4)


def test_wall_has_no_holes_at_any_cut():
    """Discs on a grid keep opacity and colour in the image for every cut."""
    side = 64
    grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, side)] * 2), axis=-1).reshape(-1, 2)
    step = 2 / (side - 1)
    wall = Splats(
        np.concatenate([grid, np.zeros((side**2, 1))], axis=1).astype(np.float32),
        np.tile(np.float32([1, 0, 0, 0]), (side**2, 1)),
        np.tile(np.log([step, step, step / 10]), (side**2, 1)).astype(np.float32),
        np.full(side**2, logit(0.9), np.float32),
        np.full((side**2, 1, 3), 0.8, np.float32),
    )
    nodes, tree = build(wall)
    pose = np.eye(4)
    pose[2, 3] = 3
    camera = Camera("a", 48, 48, 100.0, 100.0, 24.0, 24.0, pose)  # the wall fills the image
    sizes = tree.sizes(nodes.means, nodes.log_scales)
    parents = np.append(sizes, np.inf)[tree.parents]
    for size in (2 * step, 4 * step, 8 * step):
        rows = np.flatnonzero((sizes <= size) & (parents > size))
        assert len(rows) < 2 * (2 / size) ** 2
        gaussians = Gaussians.of(nodes.select(rows))
        drawn = rasterize(gaussians, camera, backend="cpu")
        assert float(drawn.alpha.min()) > 0.8 and float(drawn.alpha.mean()) > 0.9
        torch.testing.assert_close(
            drawn.image, drawn.alpha[..., None] * (0.5 + 0.28209 * 0.8) * torch.ones(3)
        )


@pytest.mark.parametrize("by_error", [False, True])
def test_equal_splats_and_chains_give_flat_trees(by_error):
    """Test equal splats, and a row with shrinking gaps, in which each splat is nearest to the next one."""
    equal = scene(1000)
    for column in (equal.means, equal.quats, equal.log_scales, equal.sh):
        column[:] = column[0]
    chain = scene(300)
    chain.means[:] = 0
    chain.means[:, 0] = np.float32(1.2) ** -np.arange(300)
    chain.quats[:], chain.log_scales[:] = chain.quats[0], -20
    for splats in (equal, chain):
        nodes, tree = build(splats, by_error)
        assert len(tree.layers) <= 60
        assert all(np.isfinite(getattr(nodes, name)).all() for name in ("means", "quats", "log_scales", "sh"))


@pytest.mark.parametrize("by_error", [False, True])
def test_extreme_splats_build_a_tree(by_error):
    splats = scene(40)
    splats.log_scales[0], splats.log_scales[1], splats.log_scales[2, 0] = -80, 25, -80
    splats.opacity_logits[3], splats.opacity_logits[4] = -100, 100
    splats.means[5] = 1e9
    nodes, _ = build(splats, by_error)
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh"):
        assert np.isfinite(getattr(nodes, name)[40:]).all()


def test_size_by_error_follows_from_area_and_colour():
    """Two flat discs of radius s at distance d merge to an ellipse of s by sqrt(s² + d² / 4)."""
    s, d, opacity, colors = 0.5, 0.8, 0.6, np.array([0.2, 0.5])
    discs = Splats(
        np.float32([[0, 0, 0], [d, 0, 0]]),
        np.tile(np.float32([1, 0, 0, 0]), (2, 1)),
        np.tile(np.log([s, s, 1e-6]), (2, 1)).astype(np.float32),
        np.full(2, logit(opacity), np.float32),
        np.tile(((colors - 0.5) / SH_C0)[:, None, None], (1, 1, 3)).astype(np.float32),
    )
    nodes, tree = build(discs, by_error=True)
    depth, _ = quad(lambda r: -np.log(1 - opacity * np.exp(-r * r / 2)) * r, 0, 12)
    enlarged = np.log(np.sqrt(s**2 + d**2 / 4) / s)
    error = 2 * depth * s**2 * (enlarged + COLOR_WEIGHT * 3 * 0.25 * (colors[1] - colors[0]) ** 2)
    sizes = tree.sizes(nodes.means, nodes.log_scales, errors=nodes.extras["node_size"])
    assert sizes[2] == pytest.approx(ERROR_SCALE * np.sqrt(error), rel=1e-3)
    assert not sizes[:2].any()


def test_cut_by_error_is_better_than_by_size():
    """A wall of random colours whose right half is faint: cuts by error keep the splats of the left half."""
    side = 48
    grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, side)] * 2), axis=-1).reshape(-1, 2)
    colors = np.random.default_rng(0).uniform(-1, 1, (side**2, 1, 3))
    wall = Splats(
        np.concatenate([grid, np.zeros((side**2, 1))], axis=1).astype(np.float32),
        np.tile(np.float32([1, 0, 0, 0]), (side**2, 1)),
        np.tile(np.log([1 / side, 1 / side, 1e-4]), (side**2, 1)).astype(np.float32),
        logit(np.where(grid[:, 0] < 0, 0.9, 0.02)).astype(np.float32),
        colors.astype(np.float32),
    )
    pose = np.eye(4)
    pose[2, 3] = 3
    camera = Camera("a", 96, 96, 140.0, 140.0, 48.0, 48.0, pose)
    full = rasterize(Gaussians.of(wall), camera, backend="cpu").image
    errors = []
    for by_error in (False, True):
        nodes, tree = build(wall, by_error)
        sizes = tree.sizes(nodes.means, nodes.log_scales, errors=nodes.extras.get("node_size"))
        parents = np.append(sizes, np.inf)[tree.parents]
        limits = np.sort(sizes)
        counts = [int(((sizes <= limit) & (parents > limit)).sum()) for limit in limits]
        limit = limits[np.argmax(np.array(counts) <= side**2 * 0.6)]
        cut = nodes.select((sizes <= limit) & (parents > limit))
        errors.append(float(((rasterize(Gaussians.of(cut), camera, backend="cpu").image - full) ** 2).mean()))
    assert errors[1] < 0.3 * errors[0]


def test_single_splat_raises():
    with pytest.raises(LodgsError, match="Cannot build a tree"):
        build(scene(1))


def test_tree_is_independent_of_thread_count():
    from training.rasterize.cpu import compile

    initial, actual = compile.thread_count(), []
    try:
        for count in (1, 3):
            compile.set_thread_count(count)
            actual.append(build(scene(20_000)))
    finally:
        compile.set_thread_count(initial)
    (first, tree), (second, same) = actual
    np.testing.assert_array_equal(tree.children, same.children)
    np.testing.assert_array_equal(first.sh, second.sh)

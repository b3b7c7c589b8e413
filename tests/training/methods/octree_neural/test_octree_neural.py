"""Tests of Octree-GS with neural anchors: decoding against the papers, baking against the networks."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from training.errors import LodgsError
from training.evaluate.views import Evaluation
from training.methods.octree_neural import METHOD
from training.methods.octree_neural.train import Method
from training.optimize.anchors import growing
from training.optimize.parameters import override
from training.rasterize import Gaussians, contributions, rasterize
from training.runs.arrays import read_arrays
from training.scenes.cameras import Camera


def make(data, **values) -> Method:
    values = {
        "levels": 3, "coarser_levels": 0, "nearest": 0.0, "farthest": 1.0, "footprint": 12.0, "steps": 40,
        "offsets": 4, "features": 8, "far_share": 0.0, "full_share": 0.0, "sh_degree": 2, "view_shapes": True,
        **values,
    }  # fmt: skip
    method = Method(data, override(METHOD.preset("draft"), values), seed=0, backend="cpu")
    rng = torch.Generator().manual_seed(1)
    for name in set(method.model.adam.tensors) & {"features", "offsets", "looks"}:  # simulate training
        method.model[name].data.copy_(torch.randn(method.model[name].shape, generator=rng))
    return method


def test_anchors_are_at_voxel_centres(data):
    method = make(data)
    means, level = method.model["means"].detach().double().numpy(), method.model.columns["level"].numpy()
    cells = (means - method.schedule.tree.origin) / method.schedule.tree.size(level)[:, None]
    np.testing.assert_allclose(cells % 1, 0.5, atol=1e-4)


def test_initial_gaussians_respect_max_splats(data):
    assert len(make(data).model) > 10
    assert len(make(data, max_splats=43, offsets=4, margin=0.0).model) == 10
    assert len(make(data, max_splats=10, offsets=10, margin=0.0).model) == 1
    with pytest.raises(LodgsError, match="one anchor needs 10 Gaussians, besides those of margins"):
        make(data, max_splats=10, offsets=10, margin=0.5)


@pytest.mark.parametrize("changes", [{"direct": False}, {}, {"view_shapes": False}])
def test_decoding_matches_papers(data, changes):
    """Decode one anchor in float64: Scaffold-GS, Sec. 3.2, Gaussian by Gaussian.

    With own looks, these are added and opacity is a sigmoid. Shapes without view dependence ignore the
    direction.
    """
    method, camera = make(data, **changes), data.train[2]
    direct = method.parameters.direct
    if direct:
        method.model["looks"].data[:, 1::2, 0] = -30
    counts = method.decoder.decode(method.model, camera, torch.arange(len(method.model))).anchor.bincount()
    anchor = int((counts == 2).nonzero()[0])
    g = method.decoder.decode(method.model, camera, torch.tensor([anchor]))
    tensors = method.model.adam.tensors
    model = {name: tensor.detach()[anchor].double().numpy() for name, tensor in tensors.items()}
    direction = model["means"] - camera.center
    direction /= np.linalg.norm(direction)
    inputs = np.concatenate([model["features"], direction])
    shape_inputs = np.concatenate([model["features"], direction * method.parameters.view_shapes])

    def network(net, inputs=shape_inputs):
        (w1, b1), (w2, b2) = ((x.weight.detach().double().numpy(), x.bias.detach().double().numpy())
                              for x in (net[0], net[2]))  # fmt: skip
        return w2 @ np.maximum(w1 @ inputs + b1, 0) + b2

    own_looks = model.get("looks", np.zeros((4, 11)))
    logit = network(method.networks.opacity) + own_looks[:, 0]
    opacity = 1 / (1 + np.exp(-logit)) if direct else np.tanh(logit)
    drawn = np.flatnonzero(opacity > (1 / 255 if direct else 0))
    assert len(drawn) == 2 and g.offset_index.tolist() == drawn.tolist()
    looks = (network(method.networks.covariance).reshape(4, 7) + own_looks[:, 1:8])[drawn]
    colors = (network(method.networks.color, inputs).reshape(4, 3) + own_looks[:, 8:])[drawn]
    extents = np.exp(model["log_scales"])
    for name, expected in {
        "opacities": opacity[drawn],
        "colors": 1 / (1 + np.exp(-colors)),
        "means": model["means"] + model["offsets"][drawn] * extents[:3],
        "scales": extents[3:] / (1 + np.exp(-looks[:, :3])),
        "quats": looks[:, 3:],
    }.items():
        np.testing.assert_allclose(getattr(g, name).detach().numpy(), expected, rtol=1e-5, atol=1e-6)


def test_anchors_reaching_into_the_image_are_visible(data):
    method = make(data)
    method.model["log_scales"].data -= 2
    all_anchors = torch.arange(len(method.model))
    outside_count = 0
    for camera in data.train:
        camera = replace(camera, fx=8 * camera.fx, fy=8 * camera.fy)  # a narrow view
        visible = method.decoder.visible_anchors(method.model, camera, torch.ones(len(method.model)))
        with torch.no_grad():
            expected, drawn = (draw_anchors(method, camera, anchors) for anchors in (all_anchors, visible))
        assert (drawn - expected).abs().max() < 1e-5
        local = method.model["means"][visible].detach().numpy() @ camera.world_to_camera[:3, :3].T
        x, _, z = (local + camera.world_to_camera[:3, 3]).T
        outside_count += np.sum((np.abs(camera.fx * x / z) > 0.6 * camera.width) | (z < 0))
        assert len(visible) < len(all_anchors)
    assert outside_count > 0


def test_gaussians_of_low_weight_are_disabled(data):
    """The reference rasterizer gives the maximum blending weights."""
    method = make(data, least_weight=0.1)
    method.schedule.join_steps = [0] * len(method.schedule.join_steps)
    largest = torch.zeros_like(method.model.stats["seen"])
    for view, camera in enumerate(data.train):
        g = method.decoder.decode(method.model, camera, method.drawn_anchors(camera), view)
        actual = contributions(g.gaussians(), [camera], near=data.near, backend="reference").largest
        largest[g.anchor, g.offset_index] = torch.maximum(largest[g.anchor, g.offset_index], actual)
    remaining = (largest >= 0.1).any(1)
    assert 0 < remaining.sum() < len(remaining)
    method.prune_unseen(39)
    alive = method.model["looks"][..., 0].detach() > -20
    assert torch.equal(alive, largest[remaining] >= 0.1) and not alive.all()
    assert method.splats == alive.sum()


def test_anchors_without_gaussians_are_removed(data, monkeypatch):
    method = make(data, grad_threshold=1e9)
    method.model["looks"].data[:5, :, 0] = -30
    monkeypatch.setattr(method.schedule, "weights", lambda *_, **__: torch.ones(len(method.model)))
    view = data.view(data.training_view(0, 0))
    drawings = method.draw(view, 0)
    drawings[0].rendering.grad2d = torch.zeros(len(drawings[0].rendering.radii), 2)
    unseen = 5 - int((drawings[0].anchors < 5).sum())
    initial = len(method.model)
    drawings[0].accumulate_stats(method.model, view.shrink)
    method.grow(20)
    assert unseen < 5
    assert len(method.model) == initial - 5 + unseen


def test_view_without_gaussians_has_a_finite_loss(data):
    method = make(data)
    method.model["looks"].data[..., 0] = -30
    assert method.train_step(0).loss() > 0


def draw(splats, camera, data):
    return rasterize(Gaussians.of(splats), camera, near=data.near).image


def draw_anchors(method: Method, camera: Camera, anchors: torch.Tensor) -> torch.Tensor:
    """Return the networks' image of these anchors."""
    return method.decoder.rasterize(method.decoder.decode(method.model, camera, anchors), camera).image


def drawn_in_training(method: Method) -> torch.Tensor:
    """Return the anchors (indices) that a training view draws; others are not baked."""
    return torch.cat([method.drawn_anchors(camera) for camera in method.data.train]).unique()


def ignore_direction(method: Method, *names: str) -> None:
    """Make networks independent of the view direction."""
    for name in names:
        features = method.parameters.features
        getattr(method.networks, name)[0].weight.data[:, features : features + 3] = 0


@pytest.mark.parametrize("appearance", [0, 2])
def test_baking_is_exact_without_view_dependence(data, appearance):
    """Appearance vectors of single photos do not count as view dependence."""
    method = make(data, appearance=appearance)
    method.networks.appearance.data.normal_(generator=torch.Generator().manual_seed(2))
    ignore_direction(method, "opacity", "covariance", "color")
    baked = method.bake()
    for camera in (data.train[0], data.test[0]):
        with torch.no_grad():
            expected = draw_anchors(method, camera, drawn_in_training(method))
        assert expected.max() > 0.2
        assert (draw(baked, camera, data) - expected).abs().max() < 1e-3


def test_baking_uses_the_median_view(data):
    method = make(data)
    baked = method.bake()
    means, anchors = method.model["means"].detach(), []
    for anchor in range(len(method.model)):
        visible = [camera for camera in data.train if anchor in method.drawn_anchors(camera)]
        if not visible:
            continue
        distances = [float((means[anchor] - torch.as_tensor(c.center).float()).norm()) for c in visible]
        camera = visible[int(np.argsort(distances)[(len(distances) - 1) // 2])]
        anchors.append(method.decoder.decode(method.model, camera, torch.tensor([anchor])))
    opacity = torch.cat([g.opacities for g in anchors]).detach()
    scales = torch.cat([g.scales for g in anchors]).detach()
    np.testing.assert_allclose(1 / (1 + np.exp(-baked.opacity_logits)), opacity, rtol=1e-4)
    np.testing.assert_allclose(np.exp(baked.log_scales), scales, rtol=1e-4)


def test_baking_fits_harmonics(data):
    """Colours linear in the direction are reproduced between the training views."""
    method = make(data, bake_ridge=1e-5)
    ignore_direction(method, "opacity", "covariance")
    # sigmoid(x) is x/4 + 1/2 near 0: the first layer gives positive directions, the second small values
    first, last = method.networks.color[0], method.networks.color[2]
    first.weight.data.zero_()
    first.weight.data[:3, -3:] = torch.eye(3)
    first.bias.data[:] = 1.0
    last.weight.data.mul_(0.5)
    baked = method.bake()
    camera = data.test[1]
    with torch.no_grad():
        g = method.decoder.decode(method.model, camera, drawn_in_training(method))
        drawn = method.decoder.rasterize(g, camera).image
        flat = np.array(baked.sh)
        flat[:, 1:] = 0
    error = (draw(baked, camera, data) - drawn).abs().mean()
    baked.sh = flat
    assert error < 0.3 * (draw(baked, camera, data) - drawn).abs().mean()


def test_arrays_restore_the_networks(data, tmp_path):
    method = make(data, appearance=2)
    for step in range(4):
        method.train_step(step)
    np.savez(tmp_path / "model.npz", **method.arrays())
    second = make(data, appearance=2)
    arrays = read_arrays(tmp_path / "model.npz")
    second.load_arrays(arrays)
    camera = data.test[0]
    assert torch.equal(second.render(camera).image, method.render(camera).image)
    second.train_step(4)  # training continues
    network = next(name for name in arrays if name.startswith("network."))
    for name, invalid in (
        ("means", arrays["means"][:-1]),
        ("means", arrays["means"].astype("f8")),
        ("level", arrays["level"][:, None]),
        (network, arrays[network][:-1]),
    ):
        with pytest.raises(ValueError, match=r" is \(.* not \("):
            second.load_arrays(arrays | {name: invalid})
    with pytest.raises(KeyError, match="means"):
        second.load_arrays({})


def test_splats_of_a_view_are_those_that_the_networks_decode(data):
    """Octree-GS, Sec. 5.1: the mean number of neural Gaussians that a view renders."""
    method = make(data, direct=False, levels=1)
    measured = Evaluation(data, "cpu", False, {}).measure(method.render)
    opacities = []
    for camera in data.test:
        anchors = method.decoder.visible_anchors(method.model, camera, torch.ones(len(method.model)))
        direction = torch.nn.functional.normalize(
            method.model["means"][anchors] - torch.as_tensor(camera.center).float(), dim=1
        )
        inputs = torch.cat([method.model["features"][anchors], direction], 1)
        opacities.append(method.networks.opacity(inputs).tanh())
    assert measured["splats"] == round(np.mean([int((opacity > 0).sum()) for opacity in opacities]))
    assert 0 < measured["drawn"] <= measured["splats"] < sum(opacity.numel() for opacity in opacities)


def test_growth_at_large_gradients(data):
    method = make(data, steps=400, coarse_share=0.0, min_opacity=0.0, max_splats=10_000)
    count, columns = len(method.model), method.model.columns
    method.model.stats["seen"] += 1
    method.model.stats["gradient_sum"][:, 1] += 1  # one of four Gaussians of each anchor
    positions = (
        method.model["means"] + method.model["offsets"][:, 1] * method.model["log_scales"].exp()[:, :3]
    )
    level = (columns["level"] + 1).clamp_max(method.levels)
    keys = method.schedule.tree.keys(positions.detach().double().numpy(), level.long().numpy())
    method.grow(200)
    added = method.model["means"][count:].detach().double().numpy()
    assert len(added) > 0
    grown = method.schedule.tree.keys(added, method.model.columns["level"][count:].long().numpy())
    assert set(grown) <= set(keys)
    offsets = method.model["offsets"][count:].detach()
    assert (offsets.abs() <= 0.5).all()  # inside the voxel, and distinct
    assert all(len(positions.unique(dim=0)) == 4 for positions in offsets)


def test_statistics_are_kept_until_enough_views_drew_an_anchor(data):
    """Octree-GS program: over 40 views of 100 to grow, over 80 to remove; sums last across passes."""
    method = make(data, steps=400, coarse_share=0.0, grow_interval=100, success_threshold=0.8, bias_rate=0.5)
    stats = method.model.stats
    stats["gradient_sum"][:] = 0.0
    stats["seen"][0], stats["seen"][1] = 40, 41
    stats["gradient_sum"][:2] = 1e9
    stats["anchor_seen"][2], stats["anchor_seen"][3] = 80, 81  # both were transparent in all views
    means = method.model["means"].detach().clone()
    method.grow(199)
    rows = {tuple(mean): row for row, mean in enumerate(method.model["means"].tolist())}
    assert tuple(means[3].tolist()) not in rows and tuple(means[2].tolist()) in rows
    final_stats = method.model.stats
    assert final_stats["seen"][0].tolist() == [40] * 4 and final_stats["seen"][1].tolist() == [0] * 4
    assert final_stats["anchor_seen"][2] == 80
    assert method.model.columns["bias"][:3].tolist() == [0.0, 0.5, 0.0]
    new = method.model.columns["bias"][len(means) - 1 :]
    assert len(new) and not new.any(), "program: new anchors begin without bias"


def test_bias_follows_mean_gradient_of_ready_gaussians(data):
    method = make(data, steps=400, coarse_share=0.0, grow_interval=100, success_threshold=0.8, bias_rate=0.5)
    threshold = method.parameters.grad_threshold * data.threshold_scale
    stats = method.model.stats
    stats["seen"][0], stats["seen"][1] = 100, 100
    stats["gradient_sum"][0, 0] = 99 * threshold  # mean of four: 0.2475 thresholds
    stats["gradient_sum"][1] = 26 * threshold
    level = method.model.columns["level"]
    stats["gradient_sum"][:2] *= 2 ** (method.parameters.grow_harder * (level[:2, None] - 1))
    method.grow(199)
    assert method.model.columns["bias"][:2].tolist() == [0.0, 0.5]


def test_next_level_growth_can_be_disabled(data):
    for grow_next in (True, False):
        method = make(data, steps=400, coarse_share=0.0, grow_next=grow_next)
        method.model.stats["seen"] += 1
        method.model.stats["gradient_sum"] += 1e9
        source, _, level = growing.select_growth(method.schedule, method.model, 200)
        assert (level > method.model.columns["level"][source]).any() == grow_next


def test_offset_rate_is_multiplied_by_extent(data):
    for scaled, factor in ((False, 1.0), (True, data.extent)):
        method = make(data, scale_offset_rate=scaled)
        method.set_learning_rates(0)
        assert method.model.adam.lr["offsets"] == pytest.approx(1e-2 * factor)


def test_appearance_of_a_photo_is_rendered(data):
    name = data.train[1].name
    method = make(data, appearance=8, appearance_of=name)
    with torch.no_grad():
        method.networks.appearance.copy_(torch.randn(method.networks.appearance.shape))
    anchors, camera = torch.arange(5), data.train[0]
    rendered, photo, other_photo = (
        method.decoder.decode(method.model, camera, anchors, view).colors for view in (None, 1, 2)
    )
    assert torch.equal(rendered, photo) and not torch.equal(photo, other_photo)
    method.use_appearance([data.train[2].name, data.train[1].name])
    mean = method.networks.appearance[1:3].mean(0)
    mixed = method.decoder.decode(method.model, camera, anchors).colors
    with torch.no_grad():
        method.networks.appearance[0] = mean
    torch.testing.assert_close(mixed, method.decoder.decode(method.model, camera, anchors, 0).colors)
    with pytest.raises(LodgsError, match=r"no appearance vectors. Train again"):
        make(data).use_appearance([name])
    with pytest.raises(LodgsError, match=r"appearance of .none\.jpg.: no training photo has"):
        make(data, appearance=8, appearance_of="none.jpg")

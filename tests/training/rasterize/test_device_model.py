"""Splats that are trained on a device, against the same steps by the reference and torch's Adam."""

import numpy as np
import pytest
import torch

from training.rasterize import Adam, Gaussians, Target, make_device_model, photometric_loss, rasterize

RATES = {
    "means": 1e-3,
    "quats": 2e-3,
    "log_scales": 5e-3,
    "opacity_logits": 2e-2,
    "sh": torch.tensor([[2e-3], *[[1e-4]] * 15]),
}
STATS = ("gradient_sum", "seen", "gradient_max", "radius_max", "opacity_sum")
VIEW = {"near": 0.2, "sh_degree": 2, "background": (0.2, 0.4, 0.1), "min_scale": 0.02}


@pytest.fixture
def photograph() -> Target:
    """Of whole counts of 255, as files have them."""
    image = np.random.default_rng(3).integers(0, 256, (50, 75, 3)).astype(np.float32) / 255
    return Target(image)


def adam_of(splats: Gaussians) -> Adam:
    tensors = {name: t.float().clone().requires_grad_() for name, t in vars(splats).items()}
    return Adam(tensors, RATES)


def blank(count: int) -> dict[str, torch.Tensor]:
    return {name: torch.zeros(count) for name in STATS}


def expected(adam: Adam, stats: dict, camera, target: Target, weights, backend: str) -> float:
    """A step as methods make it through torch."""
    drawn = rasterize(
        Gaussians(**adam.tensors), camera, weights=weights, backend=backend, antialias=True, **VIEW
    )
    loss = photometric_loss(drawn.image, target, backend=backend)
    loss.backward()
    steep, seen = drawn.grad2d.norm(dim=1) / 2, drawn.radii > 0
    stats["gradient_sum"] += steep
    stats["seen"] += seen
    stats["gradient_max"] = torch.maximum(stats["gradient_max"], steep)
    stats["radius_max"] = torch.maximum(stats["radius_max"], drawn.radii)
    stats["opacity_sum"] += torch.where(seen, adam.tensors["opacity_logits"].detach().sigmoid(), 0)
    adam.step()
    adam.zero_grad()
    return float(loss.detach())


@pytest.mark.parametrize("backend", ["cpu", "gpu"])
def test_steps_are_those_through_torch(graphics, make_splats, odd_camera, photograph, backend):
    """With weights and without, with moments that were there before, over all that is counted."""
    one, other = adam_of(make_splats(300)), adam_of(make_splats(300))
    stats, ours = blank(300), blank(300)
    weights = torch.from_numpy(np.random.default_rng(1).choice([0.0, 0.5, 1.0], 300)).float()
    expected(one, stats, odd_camera, photograph, None, "cpu")
    expected(other, ours, odd_camera, photograph, None, "cpu")
    twin = make_device_model("gpu", other, ours, antialias=True)
    assert twin is not None
    for given in (weights, None, weights):
        told = twin.step(odd_camera, photograph, ssim_weight=0.2, weights=given, shrink=2, **VIEW)
        assert told == pytest.approx(expected(one, stats, odd_camera, photograph, given, backend), rel=1e-4)
    torch.testing.assert_close(twin.read("means"), one.tensors["means"].detach(), atol=2e-4, rtol=0)
    twin.copy_to_host()
    assert one.steps == other.steps
    for name, tensor in one.tensors.items():
        rate = float(torch.as_tensor(RATES[name]).max())
        # a step is as long as the rate, whichever way a gradient points that is all but zero
        apart = (tensor - other.tensors[name]).detach().abs()
        assert apart.mean() < 0.01 * rate and apart.quantile(0.98) < 0.05 * rate, name
        for ours_, theirs in zip(one.state[name], other.state[name], strict=True):
            assert (ours_ - theirs).norm() < 1e-3 * ours_.norm(), name
    for name, values in stats.items():
        assert (values - ours[name]).norm() < 1e-3 * values.norm(), name


def test_a_device_that_binds_little_trains_the_same(
    graphics, make_splats, odd_camera, photograph, monkeypatch
):
    """Of 1500 splats it takes the moments of 512 at a time, and 4654 of their 5700 pairs."""
    found = []
    for most in (graphics.binding_bytes, 200 << 10):
        monkeypatch.setattr(graphics, "binding_bytes", most)
        adam, stats = adam_of(make_splats(1500)), blank(1500)
        twin = make_device_model("gpu", adam, stats)
        assert twin is not None
        weights = torch.linspace(0, 1, 1500)
        told = [
            twin.step(odd_camera, photograph, ssim_weight=0.2, weights=w, shrink=1, **VIEW)
            for w in (None, weights)
        ]
        twin.raise_log_scales(torch.linspace(-4, -2, 1500))
        seen = twin.read("quats")
        twin.copy_to_host()
        moments = [moment for state in adam.state.values() for moment in state]
        tensors = [tensor.detach() for tensor in adam.tensors.values()]
        found.append([*tensors, *moments, *stats.values(), seen, torch.tensor(told)])
    assert all(torch.equal(one, other) for one, other in zip(*found, strict=True))


def test_what_is_not_asked_for_stays(graphics, make_splats, odd_camera, photograph):
    """Statistics where they are not wanted; harmonics of higher degrees; what is out of sight."""
    adam, stats = adam_of(make_splats(50)), blank(50)
    before = {name: tensor.detach().clone() for name, tensor in adam.tensors.items()}
    weights = torch.ones(50)
    weights[:10] = 0
    twin = make_device_model("gpu", adam, stats)
    assert twin is not None
    twin.step(odd_camera, photograph, ssim_weight=0.2, weights=weights, **VIEW)
    twin.copy_to_host()
    assert all((values == 0).all() for values in stats.values())
    after = {name: tensor.detach() for name, tensor in adam.tensors.items()}
    assert torch.equal(after["sh"][:, 9:], before["sh"][:, 9:])
    assert all(torch.equal(after[name][:10], before[name][:10]) for name in after)
    assert not torch.equal(after["means"][10:], before["means"][10:])


def test_log_scales_rise_to_their_least(graphics, make_splats):
    adam = adam_of(make_splats(50))
    twin, before = make_device_model("gpu", adam, {}), adam.tensors["log_scales"].detach().clone()
    assert twin is not None
    least = torch.linspace(-4, 0, 50)
    least[7] = -torch.inf
    twin.raise_log_scales(least)
    assert torch.equal(twin.read("log_scales"), torch.maximum(before, least[:, None]))
    assert torch.equal(adam.tensors["log_scales"], before)  # until it is brought home


def test_a_step_moves_a_few_numbers(graphics, make_splats, odd_camera, photograph):
    """However many splats there are."""
    moved = []
    for count in (100, 4000):
        twin = make_device_model("gpu", adam_of(make_splats(count)), blank(count))
        assert twin is not None
        twin.step(odd_camera, photograph, ssim_weight=0.2, shrink=1, **VIEW)
        before = graphics.transferred
        twin.step(odd_camera, photograph, ssim_weight=0.2, shrink=1, **VIEW)
        moved.append(graphics.transferred - before)
    assert max(moved) < 20_000


def test_a_step_is_the_same_however_often_its_numbers_fill_their_buffer(
    graphics, make_splats, odd_camera, photograph, monkeypatch
):
    def trained() -> torch.Tensor:
        twin = make_device_model("gpu", adam_of(make_splats(300)), blank(300))
        assert twin is not None
        for _ in range(2):
            twin.step(odd_camera, photograph, ssim_weight=0.2, shrink=1, **VIEW)
        return torch.cat([twin.read(name).reshape(300, -1) for name in ("means", "sh", "gradient_sum")], 1)

    submit, submitted = graphics.submit, []
    monkeypatch.setattr(graphics, "submit", lambda: (submitted.append(1), submit()))
    at_once, few = trained(), len(submitted)
    monkeypatch.setattr(graphics, "_numbers", graphics._numbers[:256])
    assert torch.equal(trained(), at_once)
    assert len(submitted) - few > few  # it was full in between


def test_only_splats_that_a_device_can_count_go_there(graphics, make_splats):
    adam = adam_of(make_splats(5))
    assert make_device_model("cpu", adam, {}) is None
    assert make_device_model("gpu", adam, {"something": torch.zeros(5)}) is None
    assert make_device_model("gpu", Adam({"means": torch.zeros(5, 3)}, {"means": 1.0}), {}) is None
    assert make_device_model("gpu", adam_of(make_splats(5).select(torch.arange(0))), {}) is None

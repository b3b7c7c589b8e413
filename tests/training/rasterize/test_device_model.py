"""Compare training in device memory with steps through torch."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch

from training.rasterize import (
    Adam,
    Gaussians,
    StepOptions,
    Target,
    make_step_model,
    photometric_loss,
    rasterize,
    warm_up,
)
from training.rasterize.cuda.adam import update as update_on_gpu
from training.rasterize.gpu import device_model, recording

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
def photo() -> Target:
    """Random photo with 8-bit values, as in files."""
    image = np.random.default_rng(3).integers(0, 256, (50, 75, 3)).astype(np.float32) / 255
    return Target(image)


def adam_of(splats: Gaussians) -> Adam:
    tensors = {name: t.float().clone().requires_grad_() for name, t in vars(splats).items()}
    return Adam(tensors, RATES)


def zero_stats(count: int) -> dict[str, torch.Tensor]:
    return {name: torch.zeros(count) for name in STATS}


@pytest.fixture(params=["cpu", "cuda"])
def in_place(request) -> str:
    """Backend that trains in place; the kernels of cuda run on the CPU."""
    if request.param == "cuda":
        request.getfixturevalue("fake_card")
    return request.param


def torch_step(adam: Adam, stats: dict, camera, target: Target, weights, backend: str) -> float:
    """Make one step through torch, as methods do; return the loss."""
    drawn = rasterize(
        Gaussians(**adam.tensors), camera, weights=weights, backend=backend, antialias=True, **VIEW
    )
    loss = photometric_loss(drawn.image, target.over(VIEW["background"]), backend=backend)
    loss.backward()
    norm = drawn.grad2d.norm(dim=1) / 2
    visible = drawn.radii > 0
    stats["gradient_sum"] += norm
    stats["seen"] += visible
    stats["gradient_max"] = torch.maximum(stats["gradient_max"], norm)
    stats["radius_max"] = torch.maximum(stats["radius_max"], drawn.radii)
    stats["opacity_sum"] += torch.where(visible, adam.tensors["opacity_logits"].detach().sigmoid(), 0)
    adam.step()
    adam.zero_grad()
    return float(loss.detach())


def test_warm_up_needs_no_kernels_of_the_cpu(graphics, monkeypatch):
    """The first step of a training on a card does not wait for Numba."""
    steps = []
    original = device_model.GpuModel.step
    monkeypatch.setattr(device_model.GpuModel, "step", lambda *a, **k: steps.append(1) or original(*a, **k))
    monkeypatch.setattr("training.rasterize.cpu.adam.update", None)
    warm_up("gpu")
    assert steps == [1]


def test_steps_use_the_current_camera_of_a_photo(graphics, make_splats, odd_camera, photo):
    """Views are cached with their photo; another camera, near depth or minimum size replaces them."""
    nearer = np.eye(4)
    nearer[2, 3] = -0.5
    moved = replace(odd_camera, world_to_camera=nearer @ odd_camera.world_to_camera)
    changes = [
        (odd_camera, {}),
        (moved, {}),
        (moved, {"near": 2.5}),
        (moved, {"near": 2.5, "min_scale": 0.1}),
    ]
    images = []
    for camera, options in changes:
        used, fresh = (make_step_model("gpu", adam_of(make_splats(50)), {}) for _ in range(2))
        assert used is not None and fresh is not None
        used.step(camera, photo, StepOptions(**VIEW | options))
        fresh.step(camera, Target(photo.image), StepOptions(**VIEW | options))
        images.append(used.last_image()[0])
        assert torch.equal(images[-1], fresh.last_image()[0])
    assert all(not torch.equal(*pair) for pair in itertools.pairwise(images))


@pytest.mark.parametrize("backend", ["cpu", "gpu"])
def test_steps_match_torch(graphics, make_splats, odd_camera, photo, backend):
    """Compare parameters, moments and statistics after steps with and without weights."""
    torch_adam, device_adam = adam_of(make_splats(300)), adam_of(make_splats(300))
    stats, device_stats = zero_stats(300), zero_stats(300)
    weights = torch.from_numpy(np.random.default_rng(1).choice([0.0, 0.5, 1.0], 300)).float()
    torch_step(torch_adam, stats, odd_camera, photo, None, "cpu")
    torch_step(device_adam, device_stats, odd_camera, photo, None, "cpu")
    model = make_step_model("gpu", device_adam, device_stats, antialias=True)
    assert model is not None
    for step_weights in (weights, None, weights):
        loss = model.step(odd_camera, photo, StepOptions(weights=step_weights, shrink=2, **VIEW))()
        expected = torch_step(torch_adam, stats, odd_camera, photo, step_weights, backend)
        assert loss == pytest.approx(expected, rel=1e-4)
    torch.testing.assert_close(model.read("means"), torch_adam.tensors["means"].detach(), atol=2e-4, rtol=0)
    model.copy_to_host()
    assert torch_adam.steps == device_adam.steps
    for name, tensor in torch_adam.tensors.items():
        rate = float(torch.as_tensor(RATES[name]).max())
        # for gradients near zero, Adam's step has the full rate in an arbitrary direction
        difference = (tensor - device_adam.tensors[name]).detach().abs()
        assert difference.mean() < 0.01 * rate and difference.quantile(0.98) < 0.05 * rate, name
        for moment, device_moment in zip(torch_adam.state[name], device_adam.state[name], strict=True):
            assert (moment - device_moment).norm() < 1e-3 * moment.norm(), name
    for name, values in stats.items():
        assert (values - device_stats[name]).norm() < 1e-3 * values.norm(), name


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("parts", [(), ("mask",), ("mask", "alpha")])
def test_steps_in_place_equal_steps_through_torch(in_place, make_splats, odd_camera, photo, weighted, parts):
    """Backends give the same bits with and without autograd, also for splats of weight 0."""
    results = []
    random = np.random.default_rng(2)
    planes = {name: random.random((50, 75), np.float32) for name in parts}
    photo = Target(photo.image * planes.get("alpha", np.ones((50, 75), np.float32))[..., None], **planes)
    weights = torch.from_numpy(np.random.default_rng(1).choice([0.0, 0.5, 1.0], 300)).float()
    for fused in (False, True):
        adam, stats = adam_of(make_splats(300)), zero_stats(300)
        losses = []
        for step_weights in (None, weights if weighted else None, None):
            if fused:
                model = make_step_model(in_place, adam, stats, antialias=True)
                assert model is not None
                options = {"weights": step_weights, "shrink": 2, **VIEW}
                losses.append(model.step(odd_camera, photo, StepOptions(**options))())
            else:
                losses.append(torch_step(adam, stats, odd_camera, photo, step_weights, in_place))
        moments = [moment for state in adam.state.values() for moment in state]
        tensors = [tensor.detach() for tensor in adam.tensors.values()]
        results.append([*tensors, *moments, *stats.values(), torch.tensor(losses)])
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


def test_steps_of_cuda_copy_nothing_that_waits(fake_card, make_splats, odd_camera, photo, monkeypatch):
    """A blocking copy from the host would wait for all kernels of the step, as would a scalar's."""
    adam, copies = adam_of(make_splats(50)), []
    model = make_step_model("cuda", adam, zero_stats(50), antialias=True)
    assert model is not None
    target = Target(photo.image, mask=torch.rand(50, 75))
    model.step(odd_camera, target, StepOptions(shrink=1, **VIEW))  # caches photo and mask
    to, as_tensor = torch.Tensor.to, torch.as_tensor

    def noted_to(*args, **options):
        copies.append(options.get("non_blocking", False))
        return to(*args, **options)

    def noted_as_tensor(*args, **options):
        copies.append("device" not in options)
        return as_tensor(*args, **options)

    monkeypatch.setattr(torch.Tensor, "to", noted_to)
    monkeypatch.setattr(torch, "as_tensor", noted_as_tensor)
    model.step(odd_camera, target, StepOptions(shrink=1, **VIEW))
    sh = adam.tensors["sh"].detach()
    update_on_gpu(sh, sh, *adam.state["sh"], RATES["sh"], adam.betas, adam.eps, 1)
    assert copies and all(copies)


@pytest.mark.parametrize("backend", ["cpu", "gpu"])
def test_steps_can_leave_ignored_splats_unchanged(graphics, make_splats, odd_camera, photo, backend):
    """Moments of splats of weight 0 decay and move them, unless the step trains drawn splats only."""
    weights = torch.ones(50)
    weights[:10] = 0
    for drawn_only in (False, True):
        adam = adam_of(make_splats(50))
        model = make_step_model(backend, adam, zero_stats(50))
        assert model is not None
        model.step(odd_camera, photo, StepOptions(**VIEW))
        before = {
            name: model.read(name) if backend == "gpu" else adam.tensors[name].detach().clone()
            for name in RATES
        }
        model.step(odd_camera, photo, StepOptions(weights=weights, drawn_only=drawn_only, **VIEW))
        if backend == "gpu":
            model.copy_to_host()
        for name, values in before.items():
            after = adam.tensors[name].detach()
            assert torch.equal(after[:10], values[:10]) == drawn_only, name
            assert not torch.equal(after[10:], values[10:]), name


@pytest.mark.parametrize("backend", ["cpu", "cuda", "gpu"])
def test_steps_can_leave_harmonics_outside_the_image_unchanged(
    fake_card, graphics, make_splats, odd_camera, photo, backend
):
    """Other parameters make a step of Adam with zero gradients, as do all without ``sparse_sh``."""
    for sparse_sh in (False, True):
        splats = make_splats(50)
        adam = adam_of(splats)
        model = make_step_model(backend, adam, zero_stats(50))
        assert model is not None
        model.step(odd_camera, photo, StepOptions(**VIEW))
        if backend == "gpu":
            model.copy_to_host()
        before = {name: tensor.detach().clone() for name, tensor in adam.tensors.items()}
        shifted = odd_camera.world_to_camera.copy()
        shifted[0, 3] += 2  # some splats leave the image
        camera = replace(odd_camera, world_to_camera=shifted)
        drawn = (
            rasterize(Gaussians(**before), camera, near=VIEW["near"], min_scale=VIEW["min_scale"]).radii > 0
        )
        assert 5 < drawn.sum() < 45
        model = make_step_model(backend, adam, zero_stats(50))
        assert model is not None
        model.step(camera, photo, StepOptions(sparse_sh=sparse_sh, **VIEW))
        if backend == "gpu":
            model.copy_to_host()
        moved = {
            name: (adam.tensors[name] != values).flatten(1).any(1)
            for name, values in before.items()
            if name != "opacity_logits"
        }
        assert moved.pop("sh")[~drawn].any() != sparse_sh
        assert moved["means"][~drawn].any()


def test_small_bindings_do_not_change_training(graphics, make_splats, odd_camera, photo, monkeypatch):
    """Bindings of 200 KB hold the moments of 512 of 1500 splats, and 4654 of 5700 pairs."""
    results = []
    for binding_bytes in (graphics.binding_bytes, 200 << 10):
        monkeypatch.setattr(graphics, "binding_bytes", binding_bytes)
        adam, stats = adam_of(make_splats(1500)), zero_stats(1500)
        model = make_step_model("gpu", adam, stats)
        assert model is not None
        weights = torch.linspace(0, 1, 1500)
        losses = [
            model.step(odd_camera, photo, StepOptions(weights=w, shrink=1, **VIEW))() for w in (None, weights)
        ]
        model.raise_log_scales(torch.linspace(-4, -2, 1500))
        quats = model.read("quats")
        model.copy_to_host()
        moments = [moment for state in adam.state.values() for moment in state]
        tensors = [tensor.detach() for tensor in adam.tensors.values()]
        results.append([*tensors, *moments, *stats.values(), quats, torch.tensor(losses)])
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


def test_unused_data_stays_unchanged(graphics, make_splats, odd_camera, photo):
    """Statistics without shrink, inactive harmonics, and splats of weight 0 stay unchanged."""
    adam, stats = adam_of(make_splats(50)), zero_stats(50)
    initial = {name: tensor.detach().clone() for name, tensor in adam.tensors.items()}
    weights = torch.ones(50)
    weights[:10] = 0
    model = make_step_model("gpu", adam, stats)
    assert model is not None
    model.step(odd_camera, photo, StepOptions(weights=weights, **VIEW))
    model.copy_to_host()
    assert all((values == 0).all() for values in stats.values())
    final = {name: tensor.detach() for name, tensor in adam.tensors.items()}
    assert torch.equal(final["sh"][:, 9:], initial["sh"][:, 9:])
    assert all(torch.equal(final[name][:10], initial[name][:10]) for name in final)
    assert not torch.equal(final["means"][10:], initial["means"][10:])


def test_log_scales_are_limited(graphics, make_splats):
    adam = adam_of(make_splats(50))
    model = make_step_model("gpu", adam, {})
    initial = adam.tensors["log_scales"].detach().clone()
    assert model is not None
    minimum = torch.linspace(-4, 0, 50)
    minimum[7] = -torch.inf
    model.raise_log_scales(minimum)
    raised = torch.maximum(initial, minimum[:, None])
    assert torch.equal(model.read("log_scales"), raised)
    maximum = torch.linspace(-2, -3, 50)
    maximum[9] = torch.inf
    model.lower_log_scales(maximum)
    assert torch.equal(model.read("log_scales"), torch.minimum(raised, maximum[:, None]))
    assert torch.equal(adam.tensors["log_scales"], initial)  # unchanged until copy_to_host


def test_values_are_assigned_with_or_without_their_moments(graphics, make_splats, odd_camera, photo):
    for keep_moments in (False, True):
        adam = adam_of(make_splats(50))
        model = make_step_model("gpu", adam, zero_stats(50))
        assert model is not None
        model.step(odd_camera, photo, StepOptions(shrink=1, **VIEW))
        values = torch.linspace(-2, 2, 50)
        model.assign("opacity_logits", values, keep_moments=keep_moments)
        model.copy_to_host()
        assert torch.equal(adam.tensors["opacity_logits"].detach(), values)
        assert all(bool(moment.any()) == keep_moments for moment in adam.state["opacity_logits"])
        assert all(moment.any() for moment in adam.state["means"])


def test_steps_transfer_little_data(graphics, make_splats, odd_camera, photo):
    """The transferred bytes per step do not depend on the number of splats."""
    transferred = []
    for count in (100, 4000):
        model = make_step_model("gpu", adam_of(make_splats(count)), zero_stats(count))
        assert model is not None
        model.step(odd_camera, photo, StepOptions(shrink=1, **VIEW))
        start = graphics.transferred
        model.step(odd_camera, photo, StepOptions(shrink=1, **VIEW))
        transferred.append(graphics.transferred - start)
    assert max(transferred) < 20_000


def test_steps_wait_for_the_device_once_in_many(graphics, make_splats, odd_camera, photo):
    """A step replays its recording; it creates nothing and reads nothing until its loss is read."""
    model = make_step_model("gpu", adam_of(make_splats(300)), zero_stats(300))
    assert model is not None
    losses = [model.step(odd_camera, photo, StepOptions(shrink=1, **VIEW))]
    counts = graphics.counts.copy()
    losses += [
        model.step(odd_camera, photo, StepOptions(shrink=1, **VIEW)) for _ in range(device_model.PENDING)
    ]
    difference = graphics.counts - counts
    assert difference["reads"] == 1 and not difference["buffers"] and not difference["bind_groups"]
    assert difference["submissions"] == device_model.PENDING
    assert difference["dispatches"] <= 24 * device_model.PENDING
    values = [loss() for loss in losses]
    assert graphics.counts["reads"] == counts["reads"] + 2
    assert all(np.diff(values) < 0)


@pytest.mark.parametrize("capacity", [64, pytest.param(1000, marks=pytest.mark.nightly), None])
def test_too_many_pairs_repeat_steps_with_the_same_bits(graphics, make_splats, odd_camera, photo, capacity):
    """The 300 splats have about 1400 pairs. Steps that overflow, and those after them, are repeated."""
    results = []
    for first_capacity in (1 << 14, capacity):
        adam, stats = adam_of(make_splats(300)), zero_stats(300)
        model = make_step_model("gpu", adam, stats)
        assert model is not None
        model._capacity = first_capacity
        weights = torch.linspace(0, 1, 300)
        options = [
            {"weights": w, "shrink": s, **VIEW, "background": (0.1 * k, 0.0, 0.0)}
            for k, (w, s) in enumerate([(None, 1), (weights, None), (weights, 2), (None, 1)])
        ]
        losses = [model.step(odd_camera, photo, StepOptions(**option)) for option in options]
        image, _ = model.last_image()
        if capacity is not None and first_capacity == capacity:
            assert capacity < model._capacity < 1 << 14
        model.copy_to_host()
        moments = [moment for state in adam.state.values() for moment in state]
        tensors = [tensor.detach() for tensor in adam.tensors.values()]
        losses = torch.tensor([loss() for loss in losses])
        results.append([*tensors, *moments, *stats.values(), image, losses])
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


def test_recorded_steps_do_not_depend_on_dispatch_size(graphics, make_splats, odd_camera, photo, monkeypatch):
    """Dispatches of at most seven workgroups are submitted separately."""
    results = []
    for max_groups in (graphics.max_groups, 7):
        monkeypatch.setattr(graphics, "max_groups", max_groups)
        model = make_step_model("gpu", adam_of(make_splats(50)), {})
        assert model is not None
        for _ in range(2):
            model.step(odd_camera, photo, StepOptions(**VIEW))
        results.append(model.read("means"))
    assert torch.equal(*results)


def test_recorded_steps_need_no_private_functions(graphics, make_splats, odd_camera, photo, monkeypatch):
    """A version of wgpu-py that hides wgpu-native gives the same bits."""

    def trained() -> torch.Tensor:
        model = make_step_model("gpu", adam_of(make_splats(50)), {})
        assert model is not None
        model.step(odd_camera, photo, StepOptions(**VIEW))
        return model.read("means")

    assert recording._native_replay() is not None
    expected = trained()
    monkeypatch.setattr(recording, "_native_replay", lambda: None)
    assert torch.equal(trained(), expected)


def test_image_sizes_share_buffers(graphics, make_splats, odd_camera, photo):
    """Steps on reduced images create only their photos and a number, with the bits of separate buffers."""
    sizes = (75, 50), (40, 20), (17, 9)
    views = [
        (replace(odd_camera, width=width, height=height), Target(photo.image[:height, :width]))
        for width, height in sizes
    ]
    results, created = [], []
    for shared in (True, False):
        model = make_step_model("gpu", adam_of(make_splats(300)), zero_stats(300))
        assert model is not None
        losses = []
        for k in (0, 1, 2, 1, 0, 2):
            if not shared:
                model._forget_recordings()
            before = graphics.counts.copy()
            losses.append(model.step(*views[k], StepOptions(shrink=1, **VIEW)))
            created.append((graphics.counts - before)["buffers"])
        results.append([model.read("means"), model.read("sh"), torch.tensor([loss() for loss in losses])])
    assert created[1:6] == [2, 2, 0, 0, 0] and min(created[6:]) > 10
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


def test_lost_losses_are_reported_later(graphics, make_splats, odd_camera, photo):
    """A loss that is not finite is returned by all later steps, whose own loss may be finite again."""
    adam = adam_of(make_splats(50))
    model = make_step_model("gpu", adam, {})
    assert model is not None
    model.step(odd_camera, photo, StepOptions(ssim_weight=float("nan"), **VIEW))
    assert np.isnan(model.step(odd_camera, photo, StepOptions(**VIEW))())


def test_steps_do_not_depend_on_uniform_buffer_size(graphics, make_splats, odd_camera, photo, monkeypatch):
    def trained() -> torch.Tensor:
        model = make_step_model("gpu", adam_of(make_splats(300)), zero_stats(300))
        assert model is not None
        model._capacity = None  # steps are not recorded
        for _ in range(2):
            model.step(odd_camera, photo, StepOptions(shrink=1, **VIEW))
        return torch.cat([model.read(name).reshape(300, -1) for name in ("means", "sh", "gradient_sum")], 1)

    submit = graphics.submit
    submissions = []
    monkeypatch.setattr(graphics, "submit", lambda: (submissions.append(1), submit()))
    expected = trained()
    count = len(submissions)
    monkeypatch.setattr(graphics, "_numbers", graphics._numbers[:256])
    assert torch.equal(trained(), expected)
    assert len(submissions) - count > count  # a full buffer causes submissions


def test_unsupported_models_stay_on_the_host(graphics, make_splats):
    adam = adam_of(make_splats(5))
    assert make_step_model("reference", adam, {}) is None
    assert make_step_model("gpu", adam, {"something": torch.zeros(5)}) is None
    assert make_step_model("gpu", Adam({"means": torch.zeros(5, 3)}, {"means": 1.0}), {}) is None
    assert make_step_model("gpu", adam_of(make_splats(5).select(torch.arange(0))), {}) is None

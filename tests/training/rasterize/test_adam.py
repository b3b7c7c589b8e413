"""Compare Adam with torch's Adam, and test densification and resume."""

import io

import pytest
import torch

from training.rasterize import Adam
from training.rasterize.adam import update_in_torch
from training.rasterize.cpu.adam import update
from training.rasterize.cuda.adam import update as update_on_gpu


def gradients(step, shape):
    return torch.randn(shape, generator=torch.Generator().manual_seed(step))


def test_steps_match_torch():
    start = torch.randn(700, 5, 3, generator=torch.Generator().manual_seed(99))
    actual = start.clone()
    rates = torch.full((5, 1), 2e-3)
    rates[0] = 1e-2
    adam = Adam({"sh": actual}, {"sh": rates})
    expected = [start[:, :1].double().requires_grad_(), start[:, 1:].double().requires_grad_()]
    optimizer = torch.optim.Adam(
        [{"params": [expected[0]], "lr": 1e-2}, {"params": [expected[1]], "lr": 2e-3}], eps=1e-15
    )
    for step in range(30):
        gradient = gradients(step, start.shape)
        adam.step({"sh": gradient})
        expected[0].grad, expected[1].grad = gradient[:, :1].double(), gradient[:, 1:].double()
        optimizer.step()
    torch.testing.assert_close(actual.double(), torch.cat(expected, 1).detach(), atol=2e-6, rtol=2e-6)


@pytest.mark.parametrize("lr", [1e-2, torch.tensor([[1e-2], [1e-3], [1e-3], [2e-3]])])
def test_torch_update_matches_kernel_and_formula(lr):
    """Compare the code path of rows on a GPU with the CPU kernel, and with Algorithm 1 in float64."""
    start = torch.randn(300, 4, 3, generator=torch.Generator().manual_seed(99))
    in_torch, in_kernel = (
        [start.clone(), torch.zeros_like(start), torch.zeros_like(start)] for _ in range(2)
    )
    exact, m, v = start.double(), torch.zeros(()).double(), torch.zeros(()).double()
    for step in range(1, 31):
        gradient = gradients(step, start.shape) * (step % 3)
        update_in_torch(in_torch[0], gradient, *in_torch[1:], lr, (0.9, 0.999), 1e-15, step)
        arrays = [array.numpy() for array in (in_kernel[0], gradient, *in_kernel[1:])]
        update(*arrays, lr, (0.9, 0.999), 1e-15, step)
        m, v = 0.9 * m + 0.1 * gradient.double(), 0.999 * v + 0.001 * gradient.double() ** 2
        exact -= lr * (m / (1 - 0.9**step)) / ((v / (1 - 0.999**step)).sqrt() + 1e-15)
    for actual, expected in zip(in_torch, in_kernel, strict=True):
        torch.testing.assert_close(actual, expected, atol=2e-6, rtol=2e-5)
    torch.testing.assert_close(in_torch[0].double(), exact, atol=2e-6, rtol=2e-5)


@pytest.mark.parametrize("lr", [1e-2, torch.tensor([[1e-2], [1e-3], [1e-3], [2e-3]])])
def test_gpu_kernel_matches_cpu_kernel(fake_card, lr):
    """Compare values and moments, with more numbers than a block of threads has."""
    start = torch.randn(300, 4, 3, generator=torch.Generator().manual_seed(99))
    on_gpu, on_cpu = ([start.clone(), torch.zeros_like(start), torch.zeros_like(start)] for _ in range(2))
    for step in range(1, 31):
        gradient = gradients(step, start.shape) * (step % 3) * 1e-3
        update_on_gpu(on_gpu[0], gradient, *on_gpu[1:], lr, (0.9, 0.999), 1e-15, step)
        arrays = [array.numpy() for array in (on_cpu[0], gradient, *on_cpu[1:])]
        update(*arrays, lr, (0.9, 0.999), 1e-15, step)
    for actual, expected in zip(on_gpu, on_cpu, strict=True):
        torch.testing.assert_close(actual, expected, atol=2e-6, rtol=2e-5)
    on_gpu[1][:] = 2e-30
    on_gpu[2][:] = 1e-37
    update_on_gpu(on_gpu[0], torch.zeros_like(start), *on_gpu[1:], lr, (0.4, 0.999), 1e-15, 31)
    assert not on_gpu[1].any() and not on_gpu[2].any(), "tiny moments become zero"


def test_steps_can_change_some_rows(fake_card):
    """Other rows keep their values and moments, on the CPU and with the kernel of cards."""
    start = torch.randn(300, 4, 3, generator=torch.Generator().manual_seed(7))
    trained = torch.arange(300) % 3 == 0
    adam = Adam({"sh": start.clone(), "means": start[:, 0].clone()}, {"sh": 1e-2, "means": 1e-2})
    on_gpu = [start.clone(), torch.zeros_like(start), torch.zeros_like(start)]
    for step in range(1, 4):
        gradient = gradients(step, start.shape)
        adam.step({"sh": gradient, "means": gradient[:, 0].contiguous()}, {"sh": trained})
        update_on_gpu(on_gpu[0], gradient, *on_gpu[1:], 1e-2, (0.9, 0.999), 1e-15, step, trained)
    complete = Adam({"sh": start.clone()}, {"sh": 1e-2})
    for step in range(1, 4):
        complete.step({"sh": gradients(step, start.shape)})
    for row, all_rows, actual in zip(
        (adam.tensors["sh"], *adam.state["sh"]),
        (complete.tensors["sh"], *complete.state["sh"]),
        on_gpu,
        strict=True,
    ):
        assert torch.equal(row[trained], all_rows[trained])
        torch.testing.assert_close(actual, row, atol=2e-6, rtol=2e-5)
    assert torch.equal(adam.tensors["sh"][~trained], start[~trained])
    assert not any(moment[~trained].any() for moment in adam.state["sh"])
    assert (adam.tensors["means"] != start[:, 0]).all()


def test_resumed_optimizer_is_bit_identical():
    def run(adam, tensors, steps):
        for step in steps:
            for tensor in tensors.values():
                tensor.grad = gradients(step, tensor.shape)
            adam.step()

    rates = {"means": 1e-3, "sh": torch.full((4, 1), 1e-2)}
    unbroken = {"means": torch.zeros(50, 3), "sh": torch.zeros(50, 4, 3)}
    adam = Adam(unbroken, rates)
    run(adam, unbroken, range(4))
    file = io.BytesIO()
    torch.save({"tensors": {k: v.clone() for k, v in unbroken.items()}, "adam": adam.state_dict()}, file)
    run(adam, unbroken, range(4, 9))

    file.seek(0)
    saved = torch.load(file, weights_only=True)
    resumed = Adam(saved["tensors"], rates)
    resumed.load_state_dict(saved["adam"])
    run(resumed, saved["tensors"], range(4, 9))
    for name, tensor in unbroken.items():
        assert torch.equal(tensor, saved["tensors"][name])
        assert torch.equal(adam.state[name][1], resumed.state[name][1])


def test_rows_can_be_replaced_with_their_moments():
    tensor = torch.zeros(6, 3)
    adam = Adam({"means": tensor}, {"means": 0.1})
    adam.step({"means": gradients(0, (6, 3))})
    m, v = adam.state["means"]
    rows = torch.tensor([4, 1, 4])
    selected = tensor[rows].clone()
    adam.replace("means", selected, m[rows], v[rows])
    assert adam.steps["means"] == 1
    adam.step({"means": gradients(0, (6, 3))[rows]})

    full = torch.zeros(6, 3)
    full_adam = Adam({"means": full}, {"means": 0.1})
    for _ in range(2):
        full_adam.step({"means": gradients(0, (6, 3))})
    assert torch.equal(selected, full[rows])


def test_tensor_without_gradient_stays():
    tensors = {"a": torch.ones(3), "b": torch.ones(3)}
    adam = Adam(tensors, {"a": 0.1, "b": 0.1})
    adam.step({"a": torch.ones(3)})
    assert tensors["b"].equal(torch.ones(3))
    assert adam.steps == {"a": 1, "b": 0}


def test_moments_of_invisible_splats_do_not_become_denormal():
    tensor = torch.zeros(1000)
    adam = Adam({"a": tensor}, {"a": 1e-3})
    adam.step({"a": torch.full((1000,), 1e-12)})
    for _ in range(900):
        adam.step({"a": torch.zeros(1000)})
    for moment in adam.state["a"]:
        assert ((moment == 0) | (moment.abs() > 1.2e-38)).all()


def test_invalid_tensors_raise():
    with pytest.raises(ValueError, match="learning rates"):
        Adam({"a": torch.zeros(2)}, {"b": 0.1})
    with pytest.raises(ValueError, match="contiguous float32"):
        Adam({"a": torch.zeros(2).double()}, {"a": 0.1})

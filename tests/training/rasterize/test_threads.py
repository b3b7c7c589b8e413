"""Test bit reproducibility, distribution to threads, buffers and compilation of the kernels."""

import os
import subprocess
import sys
import threading
from collections import Counter

import numpy as np
import pytest
import torch

from tests.training.rasterize.comparison import drawn_and_differentiated
from training.rasterize import Target, photometric_loss, rasterize
from training.rasterize.cpu import frame
from training.rasterize.cpu.compile import Buffers, _idle, run_parallel, set_thread_count, thread_count
from training.scenes.cameras import Camera


def render_and_differentiate(splats, camera, truth, backend="cpu"):
    """Return image, alpha, radii, loss and all gradients."""
    leaves = splats.map(lambda tensor: tensor.float().clone().requires_grad_())
    drawn = rasterize(leaves, camera, backend=backend)
    loss = photometric_loss(drawn.image, truth, backend=backend)
    loss.backward()
    return [drawn.image.detach(), drawn.alpha.detach(), drawn.radii, drawn.grad2d, loss.detach()] + [
        leaf.grad for leaf in vars(leaves).values()
    ]


def test_results_do_not_depend_on_thread_count(make_splats, odd_camera):
    splats, truth = make_splats(2000), Target(torch.rand(50, 75, 3))
    original = thread_count()
    results = []
    try:
        for count in (1, 2, 16, 1):
            set_thread_count(count)
            results.append(render_and_differentiate(splats, odd_camera, truth))
    finally:
        set_thread_count(original)
    for result in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], result, strict=True))


@pytest.fixture
def sixteen_threads():
    original = thread_count()
    set_thread_count(16)
    yield
    set_thread_count(original)


@pytest.mark.parametrize(
    "name", ["degree 3", "antialiased some", pytest.param("crowd", marks=pytest.mark.nightly)]
)
def test_results_do_not_depend_on_array_addresses(name, make_splats, odd_camera):
    """Loops that sum and write may be compiled in two versions, for overlapping and separate arrays."""
    random = np.random.default_rng(0)
    first = None
    for _ in range(25):
        fillers = [np.empty(size, np.uint8) for size in random.integers(1, 200_000, 40)]
        _idle.clear()  # otherwise kernels would reuse their arrays
        del fillers[::2]
        results = drawn_and_differentiated(name, make_splats, odd_camera, "cpu", torch.float32)
        first = first or results
        assert all(torch.equal(results[key], first[key]) for key in first)


def test_sixteen_threads_process_equal_numbers_of_ranges(sixteen_threads):
    """A barrier waits until all threads have a range, so each must process five ranges."""
    barrier = threading.Barrier(16, timeout=200)
    ranges = []

    def work(begin, end, width):
        assert end - begin == width
        ranges.append((begin, threading.get_ident()))
        barrier.wait()

    run_parallel(work, 16 * 5 * 7, 7, 7)
    assert sorted(begin for begin, _ in ranges) == list(range(0, 16 * 5 * 7, 7))
    by_thread = Counter(thread for _, thread in ranges)
    assert len(by_thread) == 16 and set(by_thread.values()) == {5}


def test_last_range_is_clipped_and_errors_propagate(sixteen_threads):
    ranges = []
    run_parallel(lambda begin, end: ranges.append((begin, end)), 10, 4)
    assert sorted(ranges) == [(0, 4), (4, 8), (8, 10)]
    with pytest.raises(ZeroDivisionError):  # errors in threads reach the caller
        run_parallel(lambda begin, end: 1 // (begin - 8), 10, 4)


def test_ranges_balance_sixteen_threads(make_splats, sixteen_threads, monkeypatch):
    """Simulate greedy scheduling, with work measured in pairs for tiles and in rows otherwise."""
    width, height = 640, 480
    camera = Camera("even", width, height, 500.0, 500.0, 320.0, 240.0, np.eye(4))
    splats = make_splats(40_000).to(dtype=torch.float32)
    splats.means[:, :2] *= splats.means[:, 2:] * 0.7
    splats.log_scales.sub_(2)
    leaves = splats.map(torch.Tensor.requires_grad_)
    calls = []

    def spy(kernel, total, grain, *args):
        calls.append((kernel.__name__, total, grain))
        run_parallel(kernel, total, grain, *args)

    monkeypatch.setattr(frame, "run_parallel", spy)
    drawn = rasterize(leaves, camera)
    drawn.image.sum().backward()
    tiles = drawn.tile_counts.flatten().numpy()
    assert {name for name, *_ in calls} >= {"project_forward", "blend_forward", "blend_backward"}
    for name, total, grain in calls:
        work = tiles if total == len(tiles) else np.ones(total)
        loads = np.zeros(16)
        for begin in range(0, total, grain):
            loads[loads.argmin()] += work[begin : begin + grain].sum()
        assert loads.max() <= 1.35 * loads.mean(), name


def test_results_are_bit_identical_between_runs(kernels, make_splats, odd_camera):
    splats, truth = make_splats(2000), Target(torch.rand(50, 75, 3))
    first, *repeats = (render_and_differentiate(splats, odd_camera, truth, kernels) for _ in range(3))
    for repeat in repeats:
        assert all(torch.equal(a, b) for a, b in zip(first, repeat, strict=True))


def test_two_renderings_can_share_one_backward_pass(kernels, make_splats, odd_camera, axis_camera):
    splats = make_splats(100)
    separate = []
    for camera in (odd_camera, axis_camera):
        leaves = splats.map(lambda tensor: tensor.float().clone().requires_grad_())
        rasterize(leaves, camera, backend=kernels).image.square().sum().backward()
        separate.append([leaf.grad for leaf in vars(leaves).values()])
    leaves = splats.map(lambda tensor: tensor.float().clone().requires_grad_())
    cameras = odd_camera, axis_camera
    images = [rasterize(leaves, camera, backend=kernels).image.square().sum() for camera in cameras]
    sum(images).backward()
    for leaf, first, second in zip(vars(leaves).values(), *separate, strict=True):
        torch.testing.assert_close(leaf.grad, first + second)


def test_buffers_are_reused_after_their_owner_is_deleted():
    owner, second_owner = Buffers(), Buffers()
    first, second = (buffers.take("test", np.float32, 100, 16) for buffers in (owner, second_owner))
    first[:], second[:] = 1, 2
    assert (first == 1).all() and not np.shares_memory(first, second)
    assert first.ctypes.data % 64 == 0
    address = first.ctypes.data
    del owner, first
    assert Buffers().take("test", np.int32, 3).ctypes.data == address
    assert Buffers().take("test", np.uint8, 1 << 20).size == 1 << 20, "too small buffers are replaced"


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="processes are not forked elsewhere")
def test_two_processes_compile_every_kernel_once(tmp_path):
    program = """
import os, sys
from training import rasterize
step = rasterize._step
def record_process(backend):
    open(os.path.join(sys.argv[1], f"{os.getpid()}.pid"), "w").close()
    step(backend)
rasterize._step = record_process
rasterize.warm_up("cpu")
from training.rasterize.cpu import adam, bin, blend, loss, project, project_backward
modules = adam, bin, blend, loss, project, project_backward
kernels = {k for m in modules for k in vars(m).values() if hasattr(k, "stats") and k.stats.cache_path}
compiled = sum(sum(kernel.stats.cache_misses.values()) for kernel in kernels)
read = sum(sum(kernel.stats.cache_hits.values()) for kernel in kernels)
print(compiled, read)
"""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path), "LODGS_THREADS": "2"}
    result = subprocess.run(
        [sys.executable, "-c", program, tmp_path], env=environment, stdout=subprocess.PIPE, check=True
    )
    assert len(list(tmp_path.glob("*.pid"))) == 1  # torch cannot compute gradients in the forked process
    compiled, read = map(int, result.stdout.split())
    assert compiled > 0 and read > 0
    assert compiled + read == len(list(tmp_path.rglob("*.nbi")))

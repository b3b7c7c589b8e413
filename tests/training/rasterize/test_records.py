"""Test gathering of splat records, and compare their Adam step with float64."""

import numpy as np
import torch

from training.rasterize import Rendering, records

COUNT, TERMS = 500, 4
C = 11 + 3 * TERMS
NUMBERS = torch.Generator().manual_seed(3)


def random_records():
    array = torch.randn(COUNT, 3 * C + 3, generator=NUMBERS)
    array[:, C:] = 0
    return array


def rendering(count):
    empty = torch.zeros(0)
    radii = torch.arange(count) % 3
    return Rendering(empty, empty, radii, torch.randn(count, 2, generator=NUMBERS), empty, None)


def test_gathered_values_have_order_of_gaussians():
    array, rows = random_records(), np.array([7, 3, 499, 0])
    splats = records.gather_gaussians(array, rows, TERMS)
    values = torch.cat([tensor.reshape(4, -1) for tensor in vars(splats).values()], 1)
    torch.testing.assert_close(values, array[rows, :C], rtol=0, atol=0)
    assert records.gather_gaussians(array, rows[:0], TERMS).sh.shape == (0, TERMS, 3)


def test_every_record_counts_its_own_steps():
    """Compare with Algorithm 1 in float64 per record, while random records are absent or invisible."""
    array, rates = random_records(), torch.logspace(-4, -2, C)
    values, m, v = array[:, :C].double(), torch.zeros(COUNT, C).double(), torch.zeros(COUNT, C).double()
    times, largest, last = torch.zeros(COUNT, 1), torch.zeros(COUNT), torch.zeros(COUNT)
    for number in range(1, 40):
        rows = np.random.default_rng(number).permutation(COUNT)[:200]
        at = torch.from_numpy(rows)
        shapes = (3,), (4,), (3,), (), (TERMS, 3)
        gradients = [torch.randn(200, *shape, generator=NUMBERS) * (number % 3) for shape in shapes]
        drawn = rendering(200)
        opacity = array[at, 10].sigmoid()
        shares = torch.tensor([0.0, 0.25, 1.0])[torch.arange(200) % 3] if number % 2 else None
        records.adam_step(array, rows, gradients, drawn, number, rates, shares)
        score = drawn.grad2d.norm(dim=1) * drawn.radii * opacity**0.2
        g = torch.cat([gradient.reshape(200, -1) for gradient in gradients], 1).double()
        largest[at] = torch.maximum(largest[at], score)
        last[at[drawn.radii > 0]] = float(number)
        share = torch.ones(200, 1).double() if shares is None else shares[:, None].double()
        moves = (share[:, 0] > 0) & (drawn.radii > 0)
        at, g, share = (tensor[moves] for tensor in (at, g, share))
        times[at] += 1
        m[at], v[at] = 0.9 * m[at] + 0.1 * g, 0.999 * v[at] + 0.001 * g**2
        first, second = (1 - beta ** times[at].double() for beta in (0.9, 0.999))
        values[at] -= share * rates.double() * (m[at] / first) / ((v[at] / second).sqrt() + 1e-15)
    torch.testing.assert_close(array[:, :C].double(), values, rtol=2e-5, atol=2e-6)
    torch.testing.assert_close(array[:, C : 2 * C].double(), m, rtol=2e-5, atol=2e-6)
    torch.testing.assert_close(array[:, 3 * C :], torch.stack([times[:, 0], largest, last], 1))

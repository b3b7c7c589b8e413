"""Records of splats: what is copied out of them, and their step of Adam against float64."""

import numpy as np
import torch

from training.rasterize import Rendering, records

COUNT, TERMS = 500, 4
C = 11 + 3 * TERMS
NUMBERS = torch.Generator().manual_seed(3)


def made():
    found = torch.randn(COUNT, 3 * C + 3, generator=NUMBERS)
    found[:, C:] = 0
    return found


def rendering(count):
    nothing = torch.zeros(0)
    radii = torch.arange(count) % 3
    return Rendering(nothing, nothing, radii, torch.randn(count, 2, generator=NUMBERS), nothing, None)


def test_what_is_gathered_lies_in_the_order_of_gaussians():
    some, places = made(), np.array([7, 3, 499, 0])
    splats = records.gather(some, places, TERMS)
    values = torch.cat([each.reshape(4, -1) for each in vars(splats).values()], 1)
    torch.testing.assert_close(values, some[places, :C], rtol=0, atol=0)
    assert records.gather(some, places[:0], TERMS).sh.shape == (0, TERMS, 3)


def test_each_record_makes_steps_of_its_own():
    """Against Algorithm 1 in float64, record by record; not all are there or in the image each time."""
    some, rates = made(), torch.logspace(-4, -2, C)
    values, m, v = some[:, :C].double(), torch.zeros(COUNT, C).double(), torch.zeros(COUNT, C).double()
    times, largest, last = torch.zeros(COUNT, 1), torch.zeros(COUNT), torch.zeros(COUNT)
    for number in range(1, 40):
        places = np.random.default_rng(number).permutation(COUNT)[:200]
        at = torch.from_numpy(places)
        shapes = (3,), (4,), (3,), (), (TERMS, 3)
        gradients = [torch.randn(200, *shape, generator=NUMBERS) * (number % 3) for shape in shapes]
        drawn = rendering(200)
        opacity = some[at, 10].sigmoid()
        shares = torch.tensor([0.0, 0.25, 1.0])[torch.arange(200) % 3] if number % 2 else None
        records.adam_step(some, places, gradients, drawn, number, rates, shares)
        score = drawn.grad2d.norm(dim=1) * drawn.radii * opacity**0.2
        g = torch.cat([each.reshape(200, -1) for each in gradients], 1).double()
        largest[at] = torch.maximum(largest[at], score)
        last[at[drawn.radii > 0]] = float(number)
        share = torch.ones(200, 1).double() if shares is None else shares[:, None].double()
        moves = (share[:, 0] > 0) & (drawn.radii > 0)
        at, g, share = (each[moves] for each in (at, g, share))
        times[at] += 1
        m[at], v[at] = 0.9 * m[at] + 0.1 * g, 0.999 * v[at] + 0.001 * g**2
        first, second = (1 - beta ** times[at].double() for beta in (0.9, 0.999))
        values[at] -= share * rates.double() * (m[at] / first) / ((v[at] / second).sqrt() + 1e-15)
    torch.testing.assert_close(some[:, :C].double(), values, rtol=2e-5, atol=2e-6)
    torch.testing.assert_close(some[:, C : 2 * C].double(), m, rtol=2e-5, atol=2e-6)
    torch.testing.assert_close(some[:, 3 * C :], torch.stack([times[:, 0], largest, last], 1))

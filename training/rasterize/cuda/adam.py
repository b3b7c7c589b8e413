"""Adam update of tensors on an NVIDIA GPU."""

from __future__ import annotations

import ctypes

import numpy as np
import torch

from . import driver

THREADS = 256


def update(
    parameter: torch.Tensor,
    gradient: torch.Tensor,
    m: torch.Tensor,
    v: torch.Tensor,
    lr: float | torch.Tensor | np.ndarray,
    betas: tuple[float, float],
    eps: float,
    step: int,
    trained: torch.Tensor | None = None,
) -> None:
    """Make one Adam step in place with one kernel; same formula as ``cpu.adam.update``.

    Args:
        trained: (N,) bool, rows to change; None changes all.
    """
    rates, rate, width = None, 0.0, 1
    if isinstance(lr, float | int):
        rate = float(lr)
    else:
        row = parameter.shape[1:]
        # a blocking copy would wait for the whole step
        rates = torch.as_tensor(lr, dtype=torch.float32).to(parameter.device, non_blocking=True)
        rates = rates.expand(row).contiguous()
        width = rates.numel()
    first, second = (1 - beta**step for beta in betas)
    count = parameter.numel()
    driver.kernels().launch(
        "adam", -(-count // THREADS), THREADS, parameter, gradient, m, v, rates, rate, width,
        ctypes.c_longlong(count), trained, count // max(len(parameter), 1), *betas, first, second, eps,
    )  # fmt: skip

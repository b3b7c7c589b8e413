"""Adam for named tensors whose rows change between steps."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
import torch

LearningRate = float | torch.Tensor | np.ndarray
BETAS, EPS = (0.9, 0.999), 1e-15
"""Values of 3DGS."""


class Adam:
    """Adam (Kingma and Ba 2015, Algorithm 1) for splat tensors, with moments that densification can index.

    Args:
        tensors: leaf tensors (N, ...) by name, contiguous float32, on the CPU or on a GPU.
        lr: learning rate by name: a number, or an array that broadcasts against one row. For ``sh`` of shape
            (N, K, 3), a (K, 1) array sets one rate per coefficient. It may change between steps.
        betas, eps: see the paper.

    Attributes:
        tensors: the tensors by name.
        state: (first moment, second moment) by name, tensors of the parameter's shape.
        steps: number of steps of each tensor.
    """

    def __init__(
        self,
        tensors: Mapping[str, torch.Tensor],
        lr: Mapping[str, LearningRate],
        betas: tuple[float, float] = BETAS,
        eps: float = EPS,
    ) -> None:
        if set(tensors) != set(lr):
            raise ValueError(f"learning rates for {sorted(lr)} do not match tensors {sorted(tensors)}")
        self.tensors: dict[str, torch.Tensor] = {}
        self.state: dict[str, tuple[torch.Tensor, torch.Tensor]] = {}
        self.steps = dict.fromkeys(tensors, 0)
        self.lr = dict(lr)
        self.betas = betas
        self.eps = eps
        for name, tensor in tensors.items():
            self.replace(name, tensor)

    def replace(
        self, name: str, tensor: torch.Tensor, m: torch.Tensor | None = None, v: torch.Tensor | None = None
    ) -> None:
        """Replace the tensor ``name`` and its moments (zeros by default)."""
        m = torch.zeros_like(tensor, requires_grad=False) if m is None else m
        v = torch.zeros_like(tensor, requires_grad=False) if v is None else v
        for array in (tensor, m, v):
            if array.shape != tensor.shape or array.dtype != torch.float32 or not array.is_contiguous():
                raise ValueError(f"{name} and its moments must be contiguous float32 of the same shape")
        self.tensors[name] = tensor
        self.state[name] = (m, v)

    def count_step(self, name: str) -> tuple[LearningRate, tuple[float, float], float, int]:
        """Count a step of a tensor; return its rate, betas, eps and number of steps."""
        self.steps[name] += 1
        return self.lr[name], self.betas, self.eps, self.steps[name]

    @torch.no_grad()
    def step(
        self,
        grads: Mapping[str, torch.Tensor] | None = None,
        trained: Mapping[str, torch.Tensor] = MappingProxyType({}),
    ) -> None:
        """Make one step in place; skip tensors without a gradient.

        Args:
            grads: gradients by name; None uses the tensors' own.
            trained: rows to change by name, (N,) bool; others keep their values and moments. Of tensors
                without an entry, all rows change.
        """
        from .cpu.adam import update, update_rows
        from .cuda.adam import update as update_on_gpu

        for name, tensor in self.tensors.items():
            gradient = tensor.grad if grads is None else grads.get(name)
            if gradient is None:
                continue
            arrays = tensor.detach(), gradient.contiguous(), *self.state[name]
            constants, rows = self.count_step(name), trained.get(name)
            if tensor.device.type != "cpu":
                update_on_gpu(*arrays, *constants, rows)
            elif rows is None:
                update(*(array.numpy() for array in arrays), *constants)
            else:
                index = torch.nonzero(rows).squeeze(1)
                arrays = arrays[0], index, arrays[1][index], *arrays[2:]
                update_rows(*(array.numpy() for array in arrays), *constants)

    @torch.no_grad()
    def step_rows(self, rows: torch.Tensor, grads: Mapping[str, torch.Tensor | None]) -> None:
        """Make one step in place for rows (M,) int64 only, with gradients (M, ...).

        Other rows cost nothing and keep their moments.
        """
        from .cpu.adam import update_rows

        for name, tensor in self.tensors.items():
            gradient = grads.get(name)
            if gradient is None:
                continue
            constants = self.count_step(name)
            if tensor.device.type == "cpu":
                arrays = tensor.detach(), rows, gradient.contiguous(), *self.state[name]
                update_rows(*(array.numpy() for array in arrays), *constants)
            else:
                m, v = (moment[rows] for moment in self.state[name])
                values = tensor.detach()[rows]
                update_in_torch(values, gradient, m, v, *constants)
                for target, updated in zip((tensor.detach(), *self.state[name]), (values, m, v), strict=True):
                    target[rows] = updated

    def zero_grad(self) -> None:
        """Clear the gradients of all tensors."""
        for tensor in self.tensors.values():
            tensor.grad = None

    def state_dict(self) -> dict[str, Any]:
        """Return moments and step counts in a form that ``torch.load(weights_only=True)`` accepts."""
        return {
            "steps": dict(self.steps),
            "m": {name: m for name, (m, _) in self.state.items()},
            "v": {name: v for name, (_, v) in self.state.items()},
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore the result of :meth:`state_dict`; ValueError if names or shapes differ from the
        tensors'."""
        if set(state["steps"]) != set(self.tensors):
            raise ValueError(
                f"state of {sorted(state['steps'])} does not match tensors {sorted(self.tensors)}"
            )
        for name, tensor in self.tensors.items():
            self.replace(name, tensor, state["m"][name].clone(), state["v"][name].clone())
        self.steps = dict(state["steps"])


def update_in_torch(
    parameter: torch.Tensor,
    gradient: torch.Tensor,
    m: torch.Tensor,
    v: torch.Tensor,
    lr: LearningRate,
    betas: tuple[float, float],
    eps: float,
    step: int | torch.Tensor,
) -> None:
    """Make one Adam step in place on any device; same formula as ``cpu.adam.update``."""
    m.lerp_(gradient, 1 - betas[0])
    v.mul_(betas[1]).addcmul_(gradient, gradient, value=1 - betas[1])
    rate = torch.as_tensor(lr, dtype=torch.float32, device=m.device) / (1 - betas[0] ** step)
    parameter.sub_(rate * m / (v / (1 - betas[1] ** step)).sqrt_().add_(eps))

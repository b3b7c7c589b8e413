"""Adam over named tensors whose rows come and go."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

LearningRate = float | torch.Tensor | np.ndarray
BETAS, EPS = (0.9, 0.999), 1e-15


class Adam:
    """Adam (Kingma and Ba 2015, Algorithm 1) over splat tensors, with moments that densification can index.

    Args:
        tensors: leaf tensors (N, ...) by name, contiguous float32, on the CPU or on a GPU.
        lr: learning rate by name: a number, or an array that broadcasts against one row (for ``sh`` of shape
            (N, K, 3) a (K, 1) array gives each coefficient its own). Change it between steps as you like.
        betas, eps: as in the paper; by default 3DGS's.

    Attributes:
        tensors: the tensors by name.
        state: (first moment, second moment) by name, tensors of the parameter's shape.
        steps: how many steps each tensor has seen.
    """

    def __init__(
        self,
        tensors: Mapping[str, torch.Tensor],
        lr: Mapping[str, LearningRate],
        betas: tuple[float, float] = BETAS,
        eps: float = EPS,
    ) -> None:
        if set(tensors) != set(lr):
            raise ValueError(f"learning rates for {sorted(lr)}, tensors for {sorted(tensors)}")
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
        """Put another tensor in the place of ``name``, with moments of its shape (zeros by default)."""
        m = torch.zeros_like(tensor, requires_grad=False) if m is None else m
        v = torch.zeros_like(tensor, requires_grad=False) if v is None else v
        for each in (tensor, m, v):
            if each.shape != tensor.shape or each.dtype != torch.float32 or not each.is_contiguous():
                raise ValueError(f"{name} and its moments must be contiguous float32 of one shape")
        self.tensors[name] = tensor
        self.state[name] = (m, v)

    @torch.no_grad()
    def step(self, grads: Mapping[str, torch.Tensor] | None = None) -> None:
        """One step in place, by the gradients given or each tensor's own; a tensor without one is left."""
        from .cpu.adam import update

        for name, tensor in self.tensors.items():
            gradient = tensor.grad if grads is None else grads.get(name)
            if gradient is None:
                continue
            self.steps[name] += 1
            arrays = tensor.detach(), gradient.contiguous(), *self.state[name]
            rest = self.lr[name], self.betas, self.eps, self.steps[name]
            if tensor.device.type == "cpu":
                update(*(array.numpy() for array in arrays), *rest)
            else:
                update_in_torch(*arrays, *rest)

    @torch.no_grad()
    def step_rows(self, rows: torch.Tensor, grads: Mapping[str, torch.Tensor | None]) -> None:
        """One step in place for these rows (M,) int64 alone, by their gradients (M, ...); others stay.

        What is out of sight costs nothing, and keeps its moments.
        """
        from .cpu.adam import update_rows

        for name, tensor in self.tensors.items():
            gradient = grads.get(name)
            if gradient is None:
                continue
            self.steps[name] += 1
            rest = self.lr[name], self.betas, self.eps, self.steps[name]
            if tensor.device.type == "cpu":
                arrays = tensor.detach(), rows, gradient.contiguous(), *self.state[name]
                update_rows(*(array.numpy() for array in arrays), *rest)
            else:
                m, v = (moment[rows] for moment in self.state[name])
                values = tensor.detach()[rows]
                update_in_torch(values, gradient, m, v, *rest)
                for whole, part in zip((tensor.detach(), *self.state[name]), (values, m, v), strict=True):
                    whole[rows] = part

    def zero_grad(self) -> None:
        """Forget the gradients, so that the next ``backward`` starts from nothing."""
        for tensor in self.tensors.values():
            tensor.grad = None

    def state_dict(self) -> dict[str, Any]:
        """Moments and step counts: tensors and numbers, as ``torch.load(weights_only=True)`` reads them."""
        return {
            "steps": dict(self.steps),
            "m": {name: m for name, (m, _) in self.state.items()},
            "v": {name: v for name, (_, v) in self.state.items()},
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Take up what :meth:`state_dict` gave; ValueError where names or shapes differ from the tensors'."""
        if set(state["steps"]) != set(self.tensors):
            raise ValueError(f"state of {sorted(state['steps'])}, tensors {sorted(self.tensors)}")
        for name, tensor in self.tensors.items():
            self.replace(name, tensor, state["m"][name].clone(), state["v"][name].clone())
        self.steps = dict(state["steps"])


@torch.no_grad()
def step_records(
    records: torch.Tensor,
    places: np.ndarray,
    gradient: torch.Tensor,
    lr: torch.Tensor,
    steps: int,
    most: int,
    betas: tuple[float, float] = BETAS,
    eps: float = EPS,
) -> None:
    """One Adam step in place for some records, each with the moments and the number of steps of its own.

    Args:
        records: (N, width), C values in the columns from 0 on, then their first, then their second moments.
        places: (M,) int64, each once.
        gradient: (M, C) of the values.
        lr: (C,) learning rates.
        steps: the column of the number of steps made.
        most: no record has made more.
    """
    from .cpu.adam import update_records

    if records.device.type == "cpu":
        rates = np.ascontiguousarray(lr.numpy(), np.float32)
        gradient = gradient.contiguous()
        update_records(records.numpy(), places, gradient.numpy(), rates, steps, betas, eps, most)
        return
    at, count = torch.from_numpy(places).to(records.device), len(lr)
    some = records[at]
    values, m, v = (some[:, i * count : (i + 1) * count] for i in range(3))
    some[:, steps] += 1
    update_in_torch(values, gradient, m, v, lr, betas, eps, some[:, steps, None].double())
    records[at] = some


def update_in_torch(parameter, gradient, m, v, lr, betas, eps, step) -> None:
    """One Adam step in place, as ``cpu.adam.update`` makes it, on any device."""
    m.lerp_(gradient, 1 - betas[0])
    v.mul_(betas[1]).addcmul_(gradient, gradient, value=1 - betas[1])
    rate = torch.as_tensor(lr, dtype=torch.float32, device=m.device) / (1 - betas[0] ** step)
    parameter.sub_(rate * m / (v / (1 - betas[1] ** step)).sqrt_().add_(eps))

"""Photographs differ in exposure and white balance: learned beside the splats, and left out of pictures."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from ..rasterize import Adam
from .schedules import log_linear

FINAL_RATE = 0.1
"""What is left of the learning rate at the end."""


class Exposure:
    """A gain and an offset of each colour channel for each photograph (as Kerbl et al. 2024 have a matrix).

    Their means over the photographs are kept at 1 and 0: splats have the exposure of all of them together.

    Args:
        names: of the V photographs.
        lr: learning rate; with 0 pictures are left as they are.
    """

    def __init__(self, names: Sequence[str], lr: float, device: torch.device | str = "cpu") -> None:
        start = torch.tensor([[1.0] * 3, [0.0] * 3], device=device)
        # a tensor each: what a step does not see keeps its place and its moments
        self._names = list(names) if lr else []
        tensors = {name: start.clone().requires_grad_(True) for name in self._names}
        self._lr, self._adam = lr, Adam(tensors, dict.fromkeys(tensors, lr))

    @property
    def table(self) -> torch.Tensor:
        """A copy of the gains and offsets (V, 2, 3) of red, green and blue, display-coded."""
        return torch.stack([self._adam.tensors[name].detach() for name in self._names])

    def __call__(self, image: torch.Tensor, view: int) -> torch.Tensor:
        """A picture (H, W, 3) as the photograph of a view would show it: what is over 1 is lost there."""
        if not self._lr:
            return image
        gain, offset = self._adam.tensors[self._names[view]]
        return (image * gain + offset).clamp_max(1.0)

    def optimizers(self, share: float) -> Sequence[Adam]:
        """What makes a step, if anything, after a share of the run's steps: its rate falls to a tenth."""
        if not self._lr:
            return ()
        rate = log_linear(self._lr, FINAL_RATE * self._lr, share)
        self._adam.lr.update(dict.fromkeys(self._names, rate))
        return (self._adam,)

    @torch.no_grad()
    def center(self) -> None:
        """Takes out what all photographs have in common."""
        if not self._lr:
            return
        common = self.table.mean(0)
        common[0] -= 1
        for tensor in self._adam.tensors.values():
            tensor -= common

    def state_dict(self) -> dict:
        """Tensors and numbers, as ``torch.load(weights_only=True)`` reads them."""
        tensors = {name: tensor.detach() for name, tensor in self._adam.tensors.items()}
        return {"tensors": tensors, "adam": self._adam.state_dict()}

    def load_state_dict(self, state: dict) -> None:
        """Becomes what ``state_dict`` gave, as far as that had the same photographs; others begin anew."""
        adam = self._adam.state_dict()
        for name in set(self._names) & set(state["tensors"]):
            self._adam.replace(name, state["tensors"][name].requires_grad_(True))
            for part, values in adam.items():
                values[name] = state["adam"][part][name]
        self._adam.load_state_dict(adam)

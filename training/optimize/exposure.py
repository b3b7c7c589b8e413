"""Per-photo exposure and white balance, learned with the splats and not rendered."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from ..rasterize import Adam
from .schedules import log_linear

FINAL_RATE = 0.1
"""Learning rate at the end, as a share of the initial one."""


class Exposure:
    """A gain and an offset per colour channel and photo. Kerbl et al. 2024 use a matrix.

    The means over all photos stay 1 and 0, so splats have the average exposure.

    Args:
        names: names of the V photos.
        lr: learning rate; 0 disables.
    """

    def __init__(self, names: Sequence[str], lr: float, device: torch.device | str = "cpu") -> None:
        start = torch.tensor([[1.0] * 3, [0.0] * 3], device=device)
        # One tensor per photo: photos that a step does not use keep their values and moments.
        self._names = list(names) if lr else []
        tensors = {name: start.clone().requires_grad_(True) for name in self._names}
        self._lr = lr
        self._adam = Adam(tensors, dict.fromkeys(tensors, lr))

    @property
    def table(self) -> torch.Tensor:
        """Copy of the gains and offsets (V, 2, 3) of red, green and blue, display-coded."""
        return torch.stack([self._adam.tensors[name].detach() for name in self._names])

    def __call__(self, image: torch.Tensor, view: int) -> torch.Tensor:
        """Apply a view's exposure to an image (H, W, 3) and clip it at 1."""
        if not self._lr:
            return image
        gain, offset = self._adam.tensors[self._names[view]]
        return (image * gain + offset).clamp_max(1.0)

    def optimizers(self, share: float) -> Sequence[Adam]:
        """Return the optimizers to step, with the rate after a share of the run's steps."""
        if not self._lr:
            return ()
        rate = log_linear(self._lr, FINAL_RATE * self._lr, share)
        self._adam.lr.update(dict.fromkeys(self._names, rate))
        return (self._adam,)

    @torch.no_grad()
    def center(self) -> None:
        """Restore the mean gain 1 and the mean offset 0."""
        if not self._lr:
            return
        common = self.table.mean(0)
        common[0] -= 1
        for tensor in self._adam.tensors.values():
            tensor -= common

    def state_dict(self) -> dict:
        """Return tensors and numbers, as read by ``torch.load(weights_only=True)``."""
        tensors = {name: tensor.detach() for name, tensor in self._adam.tensors.items()}
        return {"tensors": tensors, "adam": self._adam.state_dict()}

    def load_state_dict(self, state: dict) -> None:
        """Restore a state. Photos that it lacks keep their initial values."""
        adam = self._adam.state_dict()
        for name in set(self._names) & set(state["tensors"]):
            self._adam.replace(name, state["tensors"][name].requires_grad_(True))
            for part, values in adam.items():
                values[name] = state["adam"][part][name]
        self._adam.load_state_dict(adam)

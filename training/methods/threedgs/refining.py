"""What methods have in common that begin with a finished model, or make it by 3DGS, and then refine it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from ...lod.blocks import spatial_order
from ...optimize.initialize import from_splats
from ...optimize.method import Optimizer
from ...optimize.training_data import TrainingView
from ...rasterize import Adam, Gaussians
from ...splats.gaussians import Splats
from . import train as threedgs_train


class SeenRows:
    """Adam's step for the rows alone that a picture was made of.

    Args:
        adam: of all rows.
        rows: (M,) int64 of them.
        leaves: these rows of each tensor, from which the picture was made.
    """

    def __init__(self, adam: Adam, rows: torch.Tensor, leaves: dict[str, torch.Tensor]) -> None:
        self._adam, self._rows, self._leaves = adam, rows, leaves

    def step(self) -> None:
        """One step of these rows."""
        self._adam.step_rows(self._rows, {name: leaf.grad for name, leaf in self._leaves.items()})

    def zero_grad(self) -> None:
        """The rows go with their gradients: the next picture has others."""
        self._leaves = {}


class Refining(threedgs_train.Method):
    """Steps of 3DGS, none with a base, and then steps that move what a picture was made of.

    Of the latter a method says what they draw; splats come and go as it says, and not as in 3DGS.

    Attributes:
        finest_steps: so many steps are 3DGS.
    """

    def setup(self, base: Splats | None) -> None:
        p = self.parameters
        self.finest_steps = 0 if base is not None else p.steps
        self._optimizer: Optimizer | None = None
        if base is None:
            super().setup(None)
            return
        p = self.parameters = replace(p, sh_degree=min(p.sh_degree, base.sh_degree))  # as they come
        tensors = from_splats(base.select(spatial_order(base.means)), p.sh_degree, self.device)
        self.model = self.new_model(tensors)
        self._densify_until = 0

    def refines(self, step: int) -> bool:
        """Whether a step comes after those of 3DGS."""
        return step >= self.finest_steps

    def take_rows(self, rows: torch.Tensor) -> Gaussians:
        """The splats (M,) of these rows, int64, to draw: they alone make the step."""
        leaves = {name: tensor.requires_grad_() for name, tensor in self.model.read_rows(rows).items()}
        self._optimizer = SeenRows(self.model.adam, rows, leaves)
        return Gaussians(**leaves)

    def optimizers(self) -> Sequence[Optimizer]:
        return super().optimizers() if self._optimizer is None else (self._optimizer,)

    def shrink(self, step: int) -> float:
        return 1 if self.refines(step) else super().shrink(step)

    def sh_degree(self, step: int) -> int:
        return self.parameters.sh_degree if self.refines(step) else super().sh_degree(step)

    def allows_device_step(self, step: int) -> bool:
        return not self.refines(step)

    def collects_stats(self, view: TrainingView, step: int) -> bool:
        return not self.refines(step) and super().collects_stats(view, step)

    def set_learning_rates(self, step: int) -> None:
        if self.refines(step):  # a finished model's
            self.model.lr["means"] = self.parameters.lr_means_final * self.data.extent
        else:
            super().set_learning_rates(step)

    def prune_unsupported(self, step: int) -> None:
        if not self.refines(step):
            super().prune_unsupported(step)

    def control_density(self, step: int) -> None:
        if not self.refines(step):
            super().control_density(step)

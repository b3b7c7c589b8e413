"""Refinement of a trained model: a base, the result of 3DGS steps, or a level merged from a finer one."""

from __future__ import annotations

from dataclasses import replace

import torch

from ..rasterize import Gaussians, contributions, tensor_device
from ..rasterize.adam import LearningRate
from ..splats.gaussians import Splats
from ..splats.morton import spatial_order
from .initialize import from_splats
from .model import splat_rates
from .parameters import Parameters
from .schedules import log_linear
from .splat_method import SplatMethod
from .training_data import TrainingData, TrainingView

MEANS_RATE, FINAL_RATE = 3.0, 0.1
"""Initial rate of positions relative to the final one of 3DGS, and final rates relative to initial ones."""
MERGED_RATE = 4.0
"""Factor on the rates of merged levels, which have more to learn."""
LEAST_WEIGHT = 0.05
"""Minimum share of a pixel of splats that are merged; others are dropped."""


def refining_rates(
    parameters: Parameters, extent: float, fraction: float, factor: float = 1.0
) -> dict[str, LearningRate]:
    """Return the learning rates after a fraction of the steps that refine a level."""
    lr = splat_rates(parameters, extent) | {"means": MEANS_RATE * parameters.lr_means_final * extent}
    return {name: rate * factor * log_linear(1.0, FINAL_RATE, fraction) for name, rate in lr.items()}


@torch.no_grad()
def drop_invisible(
    splats: Splats, minimum: int, data: TrainingData, parameters: Parameters, backend: str
) -> Splats:
    """Drop splats of low weight in all training views and margins, before a merge.

    At least ``minimum`` remain.
    """
    p = parameters
    wide = (camera.widened(p.margin) for camera in data.train)
    gaussians = Gaussians.of(splats, tensor_device(backend))
    largest = contributions(gaussians, wide, near=data.near, antialias=p.antialias, backend=backend).largest
    threshold = min(LEAST_WEIGHT, float(largest.topk(minimum).values[-1]))
    return splats.select((largest >= threshold).cpu().numpy())


class RefiningMethod(SplatMethod):
    """3DGS steps, none with a base, followed by steps that refine only the rendered rows.

    Subclasses define the images of the refining steps and control density in them; the rules of 3DGS do not
    apply there.

    Attributes:
        finest_steps: number of 3DGS steps.
    """

    def setup(self, base: Splats | None) -> None:
        p = self.parameters
        self.finest_steps = 0 if base is not None else p.steps
        self.steps = self.finest_steps + p.base_steps
        self.device_steps = self.sh_degree.full_from = self.support.end = self.finest_steps
        if base is None:
            super().setup(None)
            return
        p = self.parameters = replace(p, sh_degree=min(p.sh_degree, base.sh_degree))  # the base has no more
        self.sh_degree.degree = p.sh_degree
        tensors = from_splats(base.select(spatial_order(base.means)), p.sh_degree, self.device)
        self.model = self.new_model(tensors)
        self._densify_until = 0

    def refines(self, step: int) -> bool:
        """Return True if a step follows the 3DGS steps."""
        return step >= self.finest_steps

    def shrink(self, step: int) -> float:
        return 1 if self.refines(step) else super().shrink(step)

    def collects_stats(self, view: TrainingView, step: int) -> bool:
        return not self.refines(step) and super().collects_stats(view, step)

    def set_learning_rates(self, step: int) -> None:
        if self.refines(step):  # the model is already trained
            p, extent = self.parameters, self.data.extent
            self.model.lr.update(splat_rates(p, extent) | {"means": p.lr_means_final * extent})
        else:
            super().set_learning_rates(step)

    def control_density(self, step: int) -> None:
        if not self.refines(step):
            super().control_density(step)

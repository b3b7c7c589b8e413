"""Coarser levels merged from the finest one, shared by methods. Not in the papers.

The finest level is trained first. Each coarser level is a merge of the next finer one, which is then refined.
The rule ``bands`` draws one level at each distance.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch

from ..rasterize import Gaussians, tensor_device
from ..rasterize.adam import LearningRate
from ..splats.gaussians import Splats
from .initialize import from_splats
from .level_distances import measure_min_sizes
from .merged_parameters import MergedParameters
from .merging import merge
from .model import Model, splat_rates
from .parameters import Parameters
from .refining import MERGED_RATE, drop_invisible, refining_rates
from .schedules import LevelStages, refining_reduction
from .training_data import TrainingData

Tensors = Mapping[str, torch.Tensor]
"""Splats of a level, as tensors by name."""


class MergedLevels:
    """Merging, refinement and distances of the coarser levels.

    Args:
        stages: stages of the run; if levels are merged, the first one trains the finest level.
        parameters: parameters of a method with :class:`MergedParameters`.
    """

    def __init__(
        self, stages: LevelStages, data: TrainingData, parameters: Parameters, seed: int, backend: str
    ) -> None:
        assert isinstance(parameters, MergedParameters)
        self._stages = stages
        self._data = data
        self._parameters = parameters
        self._seed = seed
        self._backend = backend

    def refines(self, step: int) -> bool:
        """Return whether a step refines a merged level."""
        ends = self._stages.ends
        return self._parameters.merges and ends[0] <= step < ends[-1]

    def shrink(self, step: int, first: float, full: float) -> float:
        """Return the factor by which the image of a step is reduced; see :func:`refining_reduction`."""
        return refining_reduction(self._seed, step, self._stages.share(step), first, full)

    def learning_rates(self, step: int) -> dict[str, LearningRate]:
        """Return the learning rates of a step."""
        share = self._stages.share(step)
        return refining_rates(self._parameters, self._data.extent, share, MERGED_RATE)

    def start(self, number: int, finer: Splats, finest_count: int) -> Model:
        """Start a level as a merge of the next finer one.

        Args:
            number: level to start.
            finer: splats of level ``number + 1``.
            finest_count: number of splats of the finest level.
        """
        p, finest = self._parameters, self._stages.level_at(0)
        count = max(round(p.share_below(finest - number) * finest_count), 1)
        if number == finest - 1:
            finer = drop_invisible(finer, count, self._data, p, self._backend)
        tensors = from_splats(merge(finer, count), p.sh_degree, tensor_device(self._backend))
        return Model(tensors, splat_rates(p, self._data.extent))

    def measure_min_sizes(self, completed: Mapping[int, Tensors], gamma: float, ratio: float) -> list[float]:
        """Measure the distances of the levels, as minimum sizes of all levels, coarse to fine.

        Args:
            completed: all levels by number.
            gamma: control of the rule ``bands``.
            ratio: ratio of the distances of coarser levels.

        Returns:
            The fact ``s_min`` of each level, in scene units.
        """
        p = self._parameters
        levels = {number: Gaussians(**completed[number]) for number in sorted(completed)[-2:]}
        return measure_min_sizes(levels, self._data, p.drawn, p.antialias, self._backend, gamma, ratio)

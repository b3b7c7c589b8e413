"""The papers' methods behind one interface. Importing this package needs no torch; making a method does."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    import numpy as np
    import torch

    from ..rasterize import Target
    from ..scenes.cameras import Camera
    from ..splats.bundle import Level
    from .data import TrainingData
    from .parameters import Parameters

MODULES = {"flod": "flod", "3dgs": "flod", "octree": "octree", "octree_neural": "octree_neural"}
"""The module of each method; its class is called ``Method``."""


class Method(Protocol):
    """One run of a method, step by step: what the loop asks of it.

    Every random choice is drawn from (seed, step), so that a resumed run repeats an unbroken one.

    Attributes:
        cumulative: whether a level only holds what it adds to the coarser ones.
        steps: number of steps of the whole run.
        levels: number of levels.
        splats: how many there are now.
    """

    cumulative: bool

    def __init__(self, data: TrainingData, parameters: Parameters, seed: int, backend: str) -> None: ...

    @property
    def steps(self) -> int: ...

    @property
    def levels(self) -> int: ...

    @property
    def splats(self) -> int: ...

    def level_at(self, step: int) -> int:
        """The finest level (1-based) that a step trains."""
        ...

    def train_step(self, step: int) -> tuple[float, torch.Tensor, Target]:
        """Makes one step; the first has number 0. Returns the loss, the image (H, W, 3) and its target."""
        ...

    def levels_after(self, step: int) -> list[Level]:
        """The levels to hand over after a step, finished or newer than before, coarse to fine."""
        ...

    def meta(self) -> dict:
        """What a bundle records of this run: all that choosing levels by distance needs."""
        ...

    def arrays(self) -> dict[str, np.ndarray]:
        """What levels do not hold of the model, to go on with it or to draw it; empty where they hold all."""
        return {}

    def load_arrays(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Takes the model from what ``arrays`` gave."""
        raise NotImplementedError("the levels hold all")

    def picture(self, camera: Camera) -> torch.Tensor:
        """What the model itself shows a camera, (H, W, 3); asked only where ``arrays`` gives some."""
        raise NotImplementedError("the levels hold all")

    def state_dict(self) -> dict:
        """Everything that the next step depends on, as tensors and numbers."""
        ...

    def load_state_dict(self, state: dict) -> None:
        """Continues from what ``state_dict`` gave."""
        ...


def create(name: str, data: TrainingData, parameters: Parameters, seed: int, backend: str) -> Method:
    """The method of a job, ready for its first step.

    Args:
        name: a key of ``parameters.METHODS``.
        backend: the rasterizer's; the tensors live where it draws (``rasterize.device_of``).
    """
    module = import_module(f".{MODULES[name]}", __package__)
    return module.Method(data, parameters, seed, backend)

"""Base class of all methods, with the training step that they share."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Generic, NamedTuple, Protocol, TypeVar, cast

import numpy as np
import torch

from ..errors import LodgsError
from ..rasterize import (
    Gaussians,
    Rendering,
    StepOptions,
    Target,
    photometric_loss,
    rasterize,
    tensor_device,
)
from ..scenes.cameras import Camera
from ..splats.gaussians import Splats
from ..splats.levels import Level
from ..splats.ply import Columns
from .background import Background
from .depth_loss import DepthLoss
from .dropout import Dropout
from .exposure import Exposure
from .growth_region import GrowthRegion
from .margins import MarginGenerator
from .model import Model, select_rows
from .parameters import Parameters
from .schedules import ShSchedule, due
from .support import PRUNE_INTERVAL, SETTLED_INTERVAL, SupportPruning
from .training_data import TrainingData, TrainingView


class Optimizer(Protocol):
    """Optimizer of trained tensors."""

    def step(self) -> None:
        """Make one step with the gradients of ``backward``."""

    def zero_grad(self) -> None:
        """Clear the gradients."""


@dataclass
class Drawing:
    """One rendered image of a step. Methods add fields that they need after ``backward``.

    Attributes:
        optimizer: optimizer of the rows that the image was rendered from; None for that of the model.
    """

    rendering: Rendering
    optimizer: Optimizer | None = field(default=None, kw_only=True)

    def accumulate_stats(self, model: Model, shrink: float) -> None:
        """Add the image's statistics for density control to ``model.stats``, after ``backward``.

        Args:
            shrink: factor by which the image was reduced.
        """
        model.accumulate_stats(self.rendering, shrink)


class StepResult(NamedTuple):
    """Result of a step, valid until the next one.

    Attributes:
        loss: return the loss, read from the device on demand.
        image: return the first rendered image (H, W, 3) over black, read from the device on demand.
        target: training image.
    """

    loss: Callable[[], float]
    image: Callable[[], torch.Tensor]
    target: Target


def require_finite(loss: Callable[[], float], step: int) -> None:
    """Raise LodgsError if the loss of a step is not finite. Reading it waits for the device."""
    value = loss()
    if not math.isfinite(value):
        raise LodgsError(
            f"Training diverged by step {step}: the loss is {value}.",
            "Train again with lower learning rates.",
        )


class ImageModel(Protocol):
    """Model that renders images itself. The levels only approximate it."""

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the model as arrays by name."""
        ...

    def load_arrays(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Restore the result of :meth:`arrays`. Invalid arrays leave the model unchanged.

        Raises:
            KeyError, ValueError: an array is missing, or has another shape or type.
        """

    def render(self, camera: Camera) -> Rendering:
        """Render the Gaussians that the model decodes for a camera."""
        ...

    def use_appearance(self, photos: Sequence[str]) -> None:
        """Render and bake with the mean appearance of training photos, by file name.

        Raises:
            LodgsError: the model has no appearances, or a name is unknown.
        """


P = TypeVar("P", bound=Parameters)
D = TypeVar("D", bound=Drawing)


class Method(ABC, Generic[P, D]):
    """A training run, step by step. P is the class of its parameters, D that of its drawings.

    A method defines ``setup``, ``set_learning_rates``, ``control_density`` and ``levels_after``, usually
    ``draw``, and overrides other hooks as needed. The components below have a part of the training step
    each. Random numbers depend only on (seed, step), so a resumed run repeats an uninterrupted one.

    Attributes:
        model: trained rows. Set by ``setup``.
        steps: number of steps of the run.
        device_steps: number of first steps that the backend may make without autograd. They render one
            image of all splats with ``render_weights`` and use this class's loss. Set by ``setup``.
        levels: number of levels. Set by ``setup`` if there are several.
        facts: scene facts declared by the method's rule, by name. Set by ``setup``.
        controls: initial values of the rule's controls, by name; others keep the rule's defaults. Set by
            ``setup``.
        image_model: model that the levels only approximate, or None if they are complete. Set by ``setup``.
        extra_optimizers: optimizers of tensors outside the model. Set by ``setup``.
        device: device of the tensors.
        warn: report a warning about the run, one sentence. Set by the caller.
        background, depth_loss, dropout, exposure, margins, region, sh_degree, support: components.

    Args:
        backend: rasterizer backend.
        base: initial splats instead of the scene's points; only for methods with ``from_base``.
    """

    model: Model
    levels: int = 1
    device_steps: float = 0
    image_model: ImageModel | None = None

    def __init__(
        self, data: TrainingData, parameters: P, seed: int, backend: str, base: Splats | None = None
    ) -> None:
        self.warn: Callable[[str], None] = lambda message: None
        self.data = data
        self.parameters = p = parameters.for_photos(len(data.train))
        self.steps = p.total_steps
        self.seed = seed
        self.backend = backend
        self.device = tensor_device(backend)
        self.facts: dict[str, float] = {}
        self.controls: dict[str, float] = {}
        self.extra_optimizers: list[Optimizer] = []
        self.background = Background(data, p.random_background, seed)
        self.depth_loss = DepthLoss(*(p.depth_weight, data.median_depth) if data.depths else (0.0, 0.0))
        self.dropout = Dropout(p.dropout, len(data.train), seed, self.device)
        self.exposure = Exposure([view.name for view in data.train], p.lr_exposure, self.device)
        self.margins = MarginGenerator(data, p.margin, backend)
        self.region = GrowthRegion(data.region)
        self.sh_degree = ShSchedule(p.sh_degree, p.sh_interval)
        self.support = SupportPruning(data.scene, data.train, p.free_depth, p.largest, base is None)
        self.setup(base)

    # -- to define -------------------------------------------------------------------------------------

    @abstractmethod
    def setup(self, base: Splats | None) -> None:
        """Create ``model`` and other state for the first step, from a base or the scene's points."""

    @abstractmethod
    def set_learning_rates(self, step: int) -> None:
        """Set the optimizers' learning rates of a step."""

    @abstractmethod
    def control_density(self, step: int) -> None:
        """Add and remove splats if due, after the optimizers' step.

        It also adds ``margins``, ideally when no more splats are added.

        Raises:
            LodgsError: no splats remain.
        """

    @abstractmethod
    def levels_after(self, step: int) -> list[Level]:
        """Return the levels that a step finished or updated, coarse to fine."""

    def draw(self, view: TrainingView, step: int) -> Sequence[D]:
        """Render the images of the loss, one or more. The first is reported.

        By default, render one image of all splats with :meth:`render_weights`.
        """
        weights, min_scale = self.render_weights(view, step)
        gaussians = optimizer = None
        if self.trains_drawn_only(step) and weights is not None:
            rows = torch.nonzero(weights).squeeze(1)
            optimizer = select_rows(self.model, rows)
            gaussians, weights = optimizer.gaussians, weights[rows]
        rendering = self.rasterize_model(view.camera, step, weights, min_scale, gaussians)
        return [cast(D, Drawing(rendering, optimizer=optimizer))]

    # -- progress and result, to override --------------------------------------------------------------

    @property
    def splats(self) -> int:
        """Current number of splats."""
        return len(self.model)

    def level_at(self, step: int) -> int:
        """Return the finest level (1-based) that a step trains."""
        return 1

    def ends_level(self, step: int) -> bool:
        """Return True if a step finishes a level or the run."""
        return step + 1 == self.steps or self.level_at(step + 1) > self.level_at(step)

    def stage(self, step: int) -> str:
        """Describe the part of the run that a step belongs to, for progress reports."""
        return f"level {self.level_at(step)} of {self.levels}"

    def tables(self) -> dict[str, Columns]:
        """Return the tables of the bundle that the method's rule reads, by name."""
        return {}

    def meta(self) -> dict:
        """Return the metadata of the run's bundle."""
        data = self.data
        central = min(data.full_train, key=lambda camera: np.linalg.norm(camera.center - data.mean_camera))
        target = central.center + data.median_depth * central.world_to_camera[2, :3]
        place = data.scene.georeference
        return {
            "camera_center": data.mean_camera.tolist(),
            "view": [central.center.tolist(), target.tolist()],
            "focal_px": data.focal,
            "scene_extent": data.extent,
            "median_depth": data.median_depth,
            **({"antialias": True} if self.parameters.antialias else {}),
            **({"origin": data.scene.origin.tolist()} if data.scene.origin.any() else {}),
            **({"georeference": place.to_json()} if place is not None else {}),
        }

    # -- parts of a step, to override ------------------------------------------------------------------

    def begin_step(self, step: int) -> StepResult | None:
        """Prepare a step before its view is chosen. A result replaces the whole step."""

    def view_index(self, step: int) -> int | None:
        """Return the index of a step's training view, or None if :meth:`begin_step` makes the step.

        It depends on (seed, step). Each epoch uses every view once.
        """
        return self.data.training_view(step, self.seed)

    def shrink(self, step: int) -> float:
        """Return the factor by which the image of a step is reduced."""
        return 1

    def render_weights(self, view: TrainingView, step: int) -> tuple[torch.Tensor | None, float]:
        """Return weights (N,) and minimum standard deviation of splats in a step; see ``rasterize``."""
        return None, 0.0

    def trains_drawn_only(self, step: int) -> bool:
        """Return True if a step leaves splats of weight 0 unchanged, with their moments."""
        return False

    def loss(self, drawings: Sequence[D], view: TrainingView, step: int) -> torch.Tensor:
        """Return the loss of a step: the sum of the images' photometric losses (3DGS, Eq. 7).

        A sum keeps the gradients of the first image independent of the others, and with them the meaning of
        the densification threshold.
        """
        weight = self.parameters.ssim_weight
        target = view.target.over(self.background(step))
        first, *additional = (
            photometric_loss(
                self.exposure(drawing.rendering.image, view.index), target, weight, backend=self.backend
            )
            for drawing in drawings
        )
        depth_loss = self.depth_loss(drawings[0].rendering, view.target, step / self.steps)
        return sum(additional, first) + depth_loss

    def collects_stats(self, view: TrainingView, step: int) -> bool:
        """Return True if :meth:`control_density` uses the statistics of a step."""
        return True

    def prune_unsupported(self, step: int, turn: int) -> None:
        """Remove splats in free space, at intervals and at the ends of levels.

        Args:
            turn: see :meth:`SupportPruning.prune`.

        Raises:
            LodgsError: no splats remain.
        """
        self.support.prune(self.model, step, turn)

    # -- checkpoints, to override ----------------------------------------------------------------------

    def state_dict(self) -> dict:
        """Return the state that the next step depends on, as tensors and numbers."""
        return {"model": self.model.state_dict(), "exposure": self.exposure.state_dict()}

    def load_state_dict(self, state: dict) -> None:
        """Restore a state."""
        self.model.load_state_dict(state["model"])
        self.exposure.load_state_dict(state["exposure"])

    def close(self) -> None:
        """Close open files."""

    # -- the step of all methods -----------------------------------------------------------------------

    def train_step(self, step: int) -> StepResult:
        """Make a step, numbered from 0."""
        if result := self.begin_step(step):
            return result
        view = self.choose_view(step)
        result = self._step_without_autograd(view, step) or self._step_with_autograd(view, step)
        self.control_density(step)
        interval = PRUNE_INTERVAL if self.collects_stats(view, step) else SETTLED_INTERVAL
        if due(interval, step + 1) or self.ends_level(step):
            self.exposure.center()
            self.prune_unsupported(step, step // interval)
        return result

    def choose_view(self, step: int) -> TrainingView:
        """Return the training view of a step."""
        return self.data.view_at(step, self.planned_view)

    def planned_view(self, step: int) -> tuple[int, float] | None:
        """Forecast the view and ``shrink`` of a step, or None if it has no view.

        Images are read ahead by this forecast. It may change later.
        """
        index = self.view_index(step) if step < self.steps else None
        return None if index is None else (index, self.shrink(step))

    def rasterize_model(
        self,
        camera: Camera,
        step: int,
        weights: torch.Tensor | None = None,
        min_scale: float = 0.0,
        gaussians: Gaussians | None = None,
    ) -> Rendering:
        """Render the model's splats, or others, with the run's settings; see ``rasterize``."""
        return rasterize(
            self.model.gaussians if gaussians is None else gaussians,
            camera,
            weights=weights,
            min_scale=min_scale,
            sh_degree=self.sh_degree(step),
            near=self.data.near,
            antialias=self.parameters.antialias,
            background=self.background(step),
            outputs=self.depth_loss.outputs,
            backend=self.backend,
        )

    def _step_with_autograd(self, view: TrainingView, step: int) -> StepResult:
        """Render, compute gradients by autograd and step the optimizers."""
        drawings = self.draw(view, step)
        loss = self.loss(drawings, view, step)
        loss.backward()
        self.model.freeze_gradients()
        if self.collects_stats(view, step):
            drawings[0].accumulate_stats(self.model, view.shrink)
        self.region.clear_outside(self.model, step)
        self.set_learning_rates(step)
        optimizers = drawings[0].optimizer or self.model.adam, *self.extra_optimizers
        for optimizer in (*optimizers, *self.exposure.optimizers(step / self.steps)):
            optimizer.step()
            optimizer.zero_grad()
        rendering = drawings[0].rendering
        image, alpha = rendering.image.detach(), rendering.alpha.detach()
        return StepResult(
            lambda: float(loss.detach()), lambda: self.background.remove(image, alpha, step), view.target
        )

    def _step_without_autograd(self, view: TrainingView, step: int) -> StepResult | None:
        """Make the step entirely in the backend, on its device. Return None if it cannot."""
        p = self.parameters
        target = view.target
        needs_autograd = p.lr_exposure or self.depth_loss.outputs or self.data.region
        if needs_autograd or step >= self.device_steps:
            return None
        if self.backend == "gpu" and (target.mask is not None or target.alpha is not None):
            return None
        model = self.model.step_model(self.backend, p.antialias)
        if model is None:
            return None
        weights, min_scale = self.render_weights(view, step)
        self.set_learning_rates(step)
        loss = model.step(
            view.camera,
            target,
            StepOptions(
                near=self.data.near,
                sh_degree=self.sh_degree(step),
                background=self.background(step),
                ssim_weight=p.ssim_weight,
                weights=weights,
                min_scale=min_scale,
                shrink=view.shrink if self.collects_stats(view, step) else None,
                drawn_only=self.trains_drawn_only(step),
                sparse_sh=self.parameters.sparse_sh,
            ),
        )
        return StepResult(loss, lambda: self.background.remove(*model.last_image(), step), target)

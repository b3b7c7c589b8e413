"""Base class of all methods, with the training step that they share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np
import torch

from ..rasterize import Gaussians, Rendering, Target, photometric_loss, rasterize, tensor_device
from ..scenes.cameras import Camera
from ..splats.gaussians import Splats
from ..splats.levels import Level
from ..splats.ply import Columns
from .density_control import require_rows
from .exposure import Exposure
from .margins import Margins
from .model import OUTSIDE, PEAK_STATS, Model
from .parameters import Parameters
from .schedules import due, log_linear
from .support import INTERVAL
from .training_data import TrainingData, TrainingView

FINAL_DEPTH_WEIGHT = 0.01
"""Weight of the depth loss at the end, as a share of the initial one."""
DROPOUT_VIEWS = 40
"""Number of training views from which dropout is disabled."""
DROPOUT_END = 7 / 8
"""Share of the steps after which dropout is disabled."""


@dataclass
class Drawing:
    """One rendered image of a step. Methods add fields that they need after ``backward``."""

    rendering: Rendering


class Optimizer(Protocol):
    """Optimizer of trained tensors."""

    def step(self) -> None:
        """Make one step with the gradients of ``backward``."""

    def zero_grad(self) -> None:
        """Clear the gradients."""


class StepResult(NamedTuple):
    """Result of a step, valid until the next one.

    Attributes:
        image: return the first rendered image (H, W, 3) over black, read from the device on demand.
        target: training image.
    """

    loss: float
    image: Callable[[], torch.Tensor]
    target: Target


P = TypeVar("P", bound=Parameters)
D = TypeVar("D", bound=Drawing)


class Method(ABC, Generic[P, D]):
    """A training run, step by step. P is the class of its parameters, D that of its drawings.

    All methods share :meth:`train_step` and define views, images and density control. Random numbers depend
    only on (seed, step), so a resumed run repeats an uninterrupted one.

    Attributes:
        model: trained rows.
        device: device of the tensors.
        warn: report a warning about the run, one sentence. Set by the caller.

    Args:
        backend: rasterizer backend.
        base: initial splats instead of the scene's points; only for methods with ``from_base``.
    """

    model: Model

    def __init__(
        self, data: TrainingData, parameters: P, seed: int, backend: str, base: Splats | None = None
    ) -> None:
        self.warn: Callable[[str], None] = lambda message: None
        self.data = data
        self.parameters = parameters
        self.seed = seed
        self.backend = backend
        self.device = tensor_device(backend)
        self.exposure = Exposure([view.name for view in data.train], parameters.lr_exposure, self.device)
        self.setup(base)

    @abstractmethod
    def setup(self, base: Splats | None) -> None:
        """Create ``model`` and other state for the first step, from a base or the scene's points."""

    # -- result ---------------------------------------------------------------------------------------

    @property
    def steps(self) -> int:
        """Number of steps of the run."""
        return self.parameters.total_steps

    @property
    def levels(self) -> int:
        """Number of levels."""
        return 1

    @property
    def splats(self) -> int:
        """Current number of splats."""
        return len(self.model)

    def level_at(self, step: int) -> int:
        """Return the finest level (1-based) that a step trains."""
        return 1

    def stage(self, step: int) -> str:
        """Describe the part of the run that a step belongs to, for progress reports."""
        return f"level {self.level_at(step)} of {self.levels}"

    @abstractmethod
    def levels_after(self, step: int) -> list[Level]:
        """Return the levels that a step finished or updated, coarse to fine."""

    def facts(self) -> dict[str, float]:
        """Return the scene facts declared by the method's rule, by name."""
        return {}

    def tables(self) -> dict[str, Columns]:
        """Return the tables of the bundle that the method's rule reads, by name."""
        return {}

    def controls(self) -> dict[str, float]:
        """Return initial values of the rule's controls for this run. The others keep the rule's defaults."""
        return {}

    def meta(self) -> dict:
        """Return the metadata of the run's bundle. Methods extend it."""
        data = self.data
        central = min(data.full_train, key=lambda camera: np.linalg.norm(camera.center - data.mean_camera))
        target = central.center + data.median_depth * central.world_to_camera[2, :3]
        return {
            "camera_center": data.mean_camera.tolist(),
            "view": [central.center.tolist(), target.tolist()],
            "focal_px": data.focal,
            "scene_extent": data.extent,
            "median_depth": data.median_depth,
            **({"antialias": True} if self.parameters.antialias else {}),
        }

    # -- step ------------------------------------------------------------------------------------------

    def train_step(self, step: int) -> StepResult:
        """Make a step, numbered from 0."""
        view = self.choose_view(step)
        result = self.step_on_device(view, step) or self.step_with_autograd(view, step)
        self.control_density(step)
        if self.parameters.margin and not self.data.transparent and self.adds_margins(step):
            self.extend_margins(step)
        if due(INTERVAL, step + 1) or self.ends_level(step):
            self.exposure.center()
            self.prune_unsupported(step)
        return result

    def step_with_autograd(self, view: TrainingView, step: int) -> StepResult:
        """Render, compute gradients by autograd and step the optimizers."""
        drawings = self.draw(view, step)
        loss = self.loss(drawings, view, step)
        loss.backward()
        self.model.freeze_gradients()
        self.accumulate_stats(drawings, view, step)
        self.limit_growth(step)
        self.set_learning_rates(step)
        for optimizer in (*self.optimizers(), *self.exposure.optimizers(step / self.steps)):
            optimizer.step()
            optimizer.zero_grad()
        rendering = drawings[0].rendering
        image = self.composite_over_black(rendering.image, rendering.alpha, step)
        return StepResult(float(loss.detach()), lambda: image, view.target)

    def step_on_device(self, view: TrainingView, step: int) -> StepResult | None:
        """Make the step entirely on the backend's device. Return None if it cannot."""
        p = self.parameters
        target = view.target
        allowed = self.allows_device_step(step) and not (p.lr_exposure or self.outputs or self.data.region)
        if not allowed or target.mask is not None or target.alpha is not None:
            return None
        device_model = self.model.device_model(self.backend, p.antialias)
        if device_model is None:
            return None
        weights, min_scale = self.render_weights(view, step)
        self.set_learning_rates(step)
        loss = device_model.step(
            view.camera,
            target,
            near=self.data.near,
            sh_degree=self.sh_degree(step),
            background=self.background(step),
            ssim_weight=p.ssim_weight,
            weights=weights,
            min_scale=min_scale,
            shrink=view.shrink if self.collects_stats(view, step) else None,
        )
        return StepResult(loss, lambda: self.composite_over_black(*device_model.last_image(), step), target)

    def allows_device_step(self, step: int) -> bool:
        """Return True if :meth:`step_on_device` may replace :meth:`step_with_autograd`.

        The step must render one image of all splats with :meth:`render_weights` and use this class's loss.
        """
        return False

    def render_weights(self, view: TrainingView, step: int) -> tuple[torch.Tensor | None, float]:
        """Return weights (N,) and minimum standard deviation of splats in a step; see ``rasterize``."""
        return None, 0.0

    def dropout_weights(self, step: int, share: float) -> torch.Tensor | None:
        """Return weights (N,) that drop random splats from a step, or None without dropout.

        The remaining splats become more opaque to compensate (DropGaussian, Park et al. 2025). With few
        images, splats overfit to single images; dropout makes others replace them.

        Args:
            share: share of the schedule's steps completed before this one.
        """
        rate = self.parameters.dropout * (1 - len(self.data.train) / DROPOUT_VIEWS)
        if rate <= 0 or share >= DROPOUT_END:
            return None
        draws = np.random.default_rng([self.seed, step, 13]).random(len(self.model), np.float32)
        return torch.from_numpy((draws >= rate) / np.float32(1 - rate)).to(self.device)

    def choose_view(self, step: int) -> TrainingView:
        """Return the training view of a step."""
        return self.data.view_at(step, self.planned_view)

    def planned_view(self, step: int) -> tuple[int, float] | None:
        """Forecast the view and ``shrink`` of a step, or None if :meth:`choose_view` is not called there.

        Images are read ahead by this forecast. It may change later.
        """
        return (self.view_index(step), self.shrink(step)) if step < self.steps else None

    def view_index(self, step: int) -> int:
        """Return the index of a step's training view, from (seed, step). Each epoch uses every view once."""
        return self.data.training_view(step, self.seed)

    def shrink(self, step: int) -> float:
        """Return the factor by which the image of a step is reduced."""
        return 1

    @abstractmethod
    def draw(self, view: TrainingView, step: int) -> Sequence[D]:
        """Render the images of the loss, one or more. The first is reported."""

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
        return sum(additional, first) + self.depth_loss(drawings[0].rendering, view, step)

    def depth_loss(self, rendering: Rendering, view: TrainingView, step: int) -> torch.Tensor | float:
        """Return the weighted mean |Σ w / z − 1 / depth| over pixels with known depth.

        As in H3DGS (Kerbl et al. 2024), but in inverse median depths.
        """
        rendered = rendering.inverse_depth
        truth = view.target.inverse_depth
        if rendered is None or truth is None:
            return 0.0
        p = self.parameters
        truth = truth.to(rendered)
        valid = truth.isfinite()
        error = torch.where(valid, rendered - truth, 0).abs().sum() / valid.sum().clamp_min(1)
        weight = log_linear(p.depth_weight, FINAL_DEPTH_WEIGHT * p.depth_weight, step / self.steps)
        return weight * self.data.median_depth * error

    @property
    def outputs(self) -> tuple[str, ...]:
        """Additional outputs of a step's renderings; see ``rasterize``."""
        return ("inverse_depth",) if self.data.depths and self.parameters.depth_weight else ()

    def collects_stats(self, view: TrainingView, step: int) -> bool:
        """Return True if :meth:`control_density` uses the statistics of a step."""
        return True

    def accumulate_stats(self, drawings: Sequence[D], view: TrainingView, step: int) -> None:
        """Add a step's statistics for :meth:`control_density` to ``model.stats``, after ``backward``."""
        if self.collects_stats(view, step):
            self.model.accumulate_stats(drawings[0].rendering, view.shrink)

    def limit_growth(self, step: int) -> None:
        """Clear the gradient statistics outside the job's region, so that no splats are added there."""
        region = self.data.region
        model = self.model
        if region is None:
            return
        if OUTSIDE not in model.columns or due(INTERVAL, step):
            outside = ~region.contains(model["means"].detach().cpu().numpy())
            model.columns[OUTSIDE] = torch.from_numpy(outside).to(model["means"])
        for name in ("gradient_sum", PEAK_STATS[0]):
            if name in model.stats:
                model.stats[name][model.columns[OUTSIDE] > 0] = 0

    @abstractmethod
    def set_learning_rates(self, step: int) -> None:
        """Set the optimizers' learning rates of a step."""

    def optimizers(self) -> Sequence[Optimizer]:
        """Return the optimizers to step."""
        return (self.model.adam,)

    @abstractmethod
    def control_density(self, step: int) -> None:
        """Add and remove splats if due, after the optimizers' step.

        Raises:
            LodgsError: no splats remain.
        """

    def ends_level(self, step: int) -> bool:
        """Return True if a step finishes a level or the run."""
        return step + 1 == self.steps or self.level_at(step + 1) > self.level_at(step)

    def adds_margins(self, step: int) -> bool:
        """Return True if margins are added after a step, ideally when no more splats are added."""
        return False

    @torch.no_grad()
    def extend_margins(self, step: int) -> None:
        """Add splats that extend the images beyond their edges."""
        room = self.parameters.margin_room(self.budget_at(step))
        self.append_margins(vars(self.margins().extend(self.gaussians_at(step), room)), step)

    def budget_at(self, step: int) -> int:
        """Return the maximum number of splats after a step."""
        return self.parameters.max_splats

    def growth_limit(self, step: int) -> int:
        """Return the maximum number of splats for densification, which reserves the budget of margins."""
        return self.budget_at(step) - self.parameters.margin_room(self.budget_at(step))

    def margins(self) -> Margins:
        """Return the generator of margin splats."""
        return Margins(self.data.train, self.parameters.margin, self.data.near, self.backend)

    def gaussians_at(self, step: int) -> Gaussians:
        """Return all splats as a step renders them."""
        return self.model.gaussians

    def append_margins(self, rows: Mapping[str, torch.Tensor], step: int) -> None:
        """Add splats in the form of :meth:`gaussians_at` to the model, by the names of ``model.NAMES``."""
        self.model.append(rows)

    @torch.no_grad()
    def prune_unsupported(self, step: int) -> None:
        """Remove splats too close to the training views, and limit the size of the others.

        Raises:
            LodgsError: no splats remain.
        """
        p = self.parameters
        model = self.model
        if not (p.free_depth or p.largest):
            return
        support = self.data.support
        means = model["means"].detach().cpu().numpy()
        distances, positions = support.nearest_positions(means)
        if p.largest:
            sizes = np.maximum(p.largest * distances, np.finfo(np.float32).tiny)
            limits = torch.from_numpy(np.log(sizes)).to(model["log_scales"])
            model["log_scales"].clamp_max_(limits[:, None])
        if p.free_depth:
            intruding = support.find_intruding(means, distances, positions, p.free_depth)
            model.keep(torch.from_numpy(~intruding))
            require_rows(model, step, "free_depth")

    # -- rendering -------------------------------------------------------------------------------------

    def sh_degree(self, step: int) -> int:
        """Return the active degree of harmonics, which increases during training."""
        p = self.parameters
        return min(p.sh_degree, step // max(p.sh_interval, 1))

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
            outputs=self.outputs,
            backend=self.backend,
        )

    def background(self, step: int) -> tuple[float, float, float]:
        """Return the background colour of a step, the same for all of its images.

        It is always random for transparent images, so that splats match their transparency.
        """
        if not (self.parameters.random_background or self.data.transparent):
            return 0.0, 0.0, 0.0
        red, green, blue = np.random.default_rng([self.seed, step, 5]).random(3)
        return red, green, blue

    @torch.no_grad()
    def composite_over_black(self, image: torch.Tensor, alpha: torch.Tensor, step: int) -> torch.Tensor:
        """Replace the background of a step's image (H, W, 3) by black."""
        background = torch.tensor(self.background(step)).to(image)
        return image - (1 - alpha[..., None]) * background

    # -- checkpoints -----------------------------------------------------------------------------------

    def arrays(self) -> dict[str, np.ndarray]:
        """Return model data that is missing from the levels. Empty if levels are complete."""
        return {}

    def load_arrays(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Restore the result of :meth:`arrays`. Invalid arrays leave the model unchanged.

        Raises:
            KeyError, ValueError: an array is missing, or has another shape or type.
        """
        raise NotImplementedError("levels are complete")

    def render_image(self, camera: Camera) -> torch.Tensor:
        """Render the model itself, (H, W, 3). Only called if :meth:`arrays` is not empty."""
        raise NotImplementedError("levels are complete")

    def close(self) -> None:
        """Close open files."""

    def state_dict(self) -> dict:
        """Return the state that the next step depends on, as tensors and numbers."""
        return {"model": self.model.state_dict(), "exposure": self.exposure.state_dict()}

    def load_state_dict(self, state: dict) -> None:
        """Restore a state."""
        self.model.load_state_dict(state["model"])
        self.exposure.load_state_dict(state["exposure"])

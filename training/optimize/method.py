"""What every method is to the training loop, and the step that all have in common."""

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
"""What is left of the weight of depths at the end."""
DROPOUT_VIEWS = 40
"""With so many training views no splats are left out of steps."""
DROPOUT_END = 7 / 8
"""From this share of the steps on none are, however few views there are."""


@dataclass
class Drawing:
    """One picture that a step draws; methods add what they have to know of it after ``backward``."""

    rendering: Rendering


class Optimizer(Protocol):
    """What moves what is trained."""

    def step(self) -> None:
        """One step, by the gradients that ``backward`` has left."""

    def zero_grad(self) -> None:
        """Forgets these gradients."""


class StepResult(NamedTuple):
    """What a step tells of itself, until the next one.

    Attributes:
        image: gives its (first) picture (H, W, 3), as it is over black; of a device it is read then.
        target: the photograph.
    """

    loss: float
    image: Callable[[], torch.Tensor]
    target: Target


P = TypeVar("P", bound=Parameters)
D = TypeVar("D", bound=Drawing)


class Method(ABC, Generic[P, D]):
    """One run of a method, step by step. P is the class of its parameters, D that of its drawings.

    :meth:`train_step` is the same for all; a method says what it sees, draws and changes. Every random choice
    is drawn from (seed, step), so that a resumed run repeats an unbroken one.

    Attributes:
        model: the rows that are trained.
        device: where tensors live.
        warn: told in a sentence what somebody should know of the run; who runs it says where that goes.

    Args:
        backend: the rasterizer's.
        base: splats to begin with instead of the scene's points; None unless the method's ``from_base``.
    """

    model: Model

    def __init__(
        self, data: TrainingData, parameters: P, seed: int, backend: str, base: Splats | None = None
    ) -> None:
        self.warn: Callable[[str], None] = lambda message: None
        self.data, self.parameters, self.seed, self.backend = data, parameters, seed, backend
        self.device = tensor_device(backend)
        self.exposure = Exposure([view.name for view in data.train], parameters.lr_exposure, self.device)
        self.setup(base)

    @abstractmethod
    def setup(self, base: Splats | None) -> None:
        """Makes ``model`` and all else that the first step needs, from a base or from the scene's points."""

    # -- what it makes ---------------------------------------------------------------------------------

    @property
    def steps(self) -> int:
        """Number of steps of the whole run."""
        return self.parameters.total_steps

    @property
    def levels(self) -> int:
        """Number of levels."""
        return 1

    @property
    def splats(self) -> int:
        """How many splats there are now."""
        return len(self.model)

    def level_at(self, step: int) -> int:
        """The finest level (1-based) that a step trains."""
        return 1

    def stage(self, step: int) -> str:
        """What a step is part of, in a few words."""
        return f"level {self.level_at(step)} of {self.levels}"

    @abstractmethod
    def levels_after(self, step: int) -> list[Level]:
        """The levels to hand over after a step, finished or newer than before, coarse to fine."""

    def facts(self) -> dict[str, float]:
        """What the method's rule has to know of the scene, by the names that the rule declares."""
        return {}

    def tables(self) -> dict[str, Columns]:
        """What the method's rule has to know besides, as tables of the bundle."""
        return {}

    def controls(self) -> dict[str, float]:
        """Values of the rule's controls that pictures of this run begin with; of others the rule's own."""
        return {}

    def meta(self) -> dict:
        """What a bundle records of this run. Methods add to it."""
        data = self.data
        middle = min(data.full_train, key=lambda camera: np.linalg.norm(camera.center - data.mean_camera))
        ahead = middle.center + data.median_depth * middle.world_to_camera[2, :3]
        return {
            "camera_center": data.mean_camera.tolist(),
            "view": [middle.center.tolist(), ahead.tolist()],
            "focal_px": data.focal,
            "scene_extent": data.extent,
            "median_depth": data.median_depth,
            **({"antialias": True} if self.parameters.antialias else {}),
        }

    # -- a step ----------------------------------------------------------------------------------------

    def train_step(self, step: int) -> StepResult:
        """Makes one step; the first has number 0."""
        view = self.choose_view(step)
        made = self.step_on_device(view, step) or self.step_with_autograd(view, step)
        self.control_density(step)
        if self.parameters.margin and not self.data.transparent and self.adds_margins(step):
            self.extend_margins(step)
        if due(INTERVAL, step + 1) or self.ends_level(step):
            self.exposure.center()
            self.prune_unsupported(step)
        return made

    def step_with_autograd(self, view: TrainingView, step: int) -> StepResult:
        """Draws, and moves what is trained by its gradients."""
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
        seen = drawings[0].rendering
        picture = self.composite_over_black(seen.image, seen.alpha, step)
        return StepResult(float(loss.detach()), lambda: picture, view.target)

    def step_on_device(self, view: TrainingView, step: int) -> StepResult | None:
        """The same where the backend can make the whole step by itself; None where it cannot."""
        p, target = self.parameters, view.target
        plain = self.allows_device_step(step) and not (p.lr_exposure or self.outputs or self.data.region)
        if not plain or target.mask is not None or target.alpha is not None:
            return None
        twin = self.model.device_model(self.backend, p.antialias)
        if twin is None:
            return None
        weights, min_scale = self.render_weights(view, step)
        self.set_learning_rates(step)
        loss = twin.step(
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
        return StepResult(loss, lambda: self.composite_over_black(*twin.last_image(), step), target)

    def allows_device_step(self, step: int) -> bool:
        """Whether a step has one picture, of all the model's splats as :meth:`shown`, and this class's loss.

        Such a step may be made without ``draw`` and all that follows until ``control_density``.
        """
        return False

    def render_weights(self, view: TrainingView, step: int) -> tuple[torch.Tensor | None, float]:
        """Weights (N,) and smallest standard deviation with which a plain step draws; see ``rasterize``."""
        return None, 0.0

    def dropout_weights(self, step: int, share: float) -> torch.Tensor | None:
        """Weights (N,) that leave some splats out of a step, at random; None: it draws all.

        The others become as much more opaque (DropGaussian, Park et al. 2025). The fewer photographs see a
        place, the more its splats come to serve one of them alone; where some are missing, others have to
        stand in for them.

        Args:
            share: of the schedule's steps that were made before.
        """
        rate = self.parameters.dropout * (1 - len(self.data.train) / DROPOUT_VIEWS)
        if rate <= 0 or share >= DROPOUT_END:
            return None
        draws = np.random.default_rng([self.seed, step, 13]).random(len(self.model), np.float32)
        return torch.from_numpy((draws >= rate) / np.float32(1 - rate)).to(self.device)

    def choose_view(self, step: int) -> TrainingView:
        """The photograph of a step."""
        return self.data.view_at(step, self.planned_view)

    def planned_view(self, step: int) -> tuple[int, float] | None:
        """Which view :meth:`choose_view` takes at a step, and its ``shrink``; None: it is not asked.

        It is asked ahead, so that photographs are read before they are needed, and may say something else
        later.
        """
        return (self.view_index(step), self.shrink(step)) if step < self.steps else None

    def view_index(self, step: int) -> int:
        """The training view of a step, from (seed, step): every epoch shows each once."""
        return self.data.training_view(step, self.seed)

    def shrink(self, step: int) -> float:
        """How many times smaller the photograph of a step is."""
        return 1

    @abstractmethod
    def draw(self, view: TrainingView, step: int) -> Sequence[D]:
        """The pictures that the loss is made of, one or more; the first is the one that is shown."""

    def loss(self, drawings: Sequence[D], view: TrainingView, step: int) -> torch.Tensor:
        """What the step makes smaller: the sum of the pictures' photometric losses (3DGS, Eq. 7).

        It is a sum so that the first picture's gradients are what they would be alone: densification's
        threshold means the same.
        """
        weight, target = self.parameters.ssim_weight, view.target.over(self.background(step))
        first, *others = (
            photometric_loss(
                self.exposure(drawing.rendering.image, view.index), target, weight, backend=self.backend
            )
            for drawing in drawings
        )
        return sum(others, first) + self.depth_loss(drawings[0].rendering, view, step)

    def depth_loss(self, rendering: Rendering, view: TrainingView, step: int) -> torch.Tensor | float:
        """Weighted mean |Σ w / z − 1 / depth| of a picture, where the depth of its view is known.

        As H3DGS has it (Kerbl et al. 2024), but in inverse median depths.
        """
        drawn, truth = rendering.inverse_depth, view.target.inverse_depth
        if drawn is None or truth is None:
            return 0.0
        p, truth = self.parameters, truth.to(drawn)
        known = truth.isfinite()
        apart = torch.where(known, drawn - truth, 0).abs().sum() / known.sum().clamp_min(1)
        weight = log_linear(p.depth_weight, FINAL_DEPTH_WEIGHT * p.depth_weight, step / self.steps)
        return weight * self.data.median_depth * apart

    @property
    def outputs(self) -> tuple[str, ...]:
        """What pictures of steps show besides colours, as ``rasterize`` takes it."""
        return ("inverse_depth",) if self.data.depths and self.parameters.depth_weight else ()

    def collects_stats(self, view: TrainingView, step: int) -> bool:
        """Whether :meth:`control_density` decides by what a step sees."""
        return True

    def accumulate_stats(self, drawings: Sequence[D], view: TrainingView, step: int) -> None:
        """After ``backward``: what :meth:`control_density` decides by is added up (``model.stats``)."""
        if self.collects_stats(view, step):
            self.model.accumulate_stats(drawings[0].rendering, view.shrink)

    def limit_growth(self, step: int) -> None:
        """After :meth:`accumulate_stats`: outside of a job's region nothing asks for more splats."""
        region, model = self.data.region, self.model
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
        """Gives the optimizers their rates of this step."""

    def optimizers(self) -> Sequence[Optimizer]:
        """Those that make a step together."""
        return (self.model.adam,)

    @abstractmethod
    def control_density(self, step: int) -> None:
        """After the optimizers: splats are added and removed where that is due.

        Raises:
            LodgsError: none is left.
        """

    def ends_level(self, step: int) -> bool:
        """Whether a level, or the run, is finished after a step."""
        return step + 1 == self.steps or self.level_at(step + 1) > self.level_at(step)

    def adds_margins(self, step: int) -> bool:
        """Whether photographs are continued after a step: best when splats are no longer added."""
        return False

    @torch.no_grad()
    def extend_margins(self, step: int) -> None:
        """Adds what continues the photographs beyond their edges."""
        room = self.parameters.margin_room(self.budget_at(step))
        self.append_margins(vars(self.margins().extend(self.gaussians_at(step), room)), step)

    def budget_at(self, step: int) -> int:
        """Most splats that the model may have after a step."""
        return self.parameters.max_splats

    def growth_limit(self, step: int) -> int:
        """Most splats that growing may bring it to: there is room left to continue photographs."""
        return self.budget_at(step) - self.parameters.margin_room(self.budget_at(step))

    def margins(self) -> Margins:
        """What the training views would show if they were wider."""
        return Margins(self.data.train, self.parameters.margin, self.data.near, self.backend)

    def gaussians_at(self, step: int) -> Gaussians:
        """The splats as a step draws all of them."""
        return self.model.gaussians

    def append_margins(self, rows: Mapping[str, torch.Tensor], step: int) -> None:
        """Adds splats to the model, by the names of ``model.NAMES``, as ``gaussians_at`` has them."""
        self.model.append(rows)

    @torch.no_grad()
    def prune_unsupported(self, step: int) -> None:
        """Removes what stands in the way of the training views, and bounds how large splats are.

        Raises:
            LodgsError: none is left.
        """
        p, model = self.parameters, self.model
        if not (p.free_depth or p.largest):
            return
        support = self.data.support
        means = model["means"].detach().cpu().numpy()
        distances, places = support.nearest_positions(means)
        if p.largest:
            sizes = np.maximum(p.largest * distances, np.finfo(np.float32).tiny)
            most = torch.from_numpy(np.log(sizes)).to(model["log_scales"])
            model["log_scales"].clamp_max_(most[:, None])
        if p.free_depth:
            model.keep(torch.from_numpy(~support.find_intruding(means, distances, places, p.free_depth)))
            require_rows(model, step, "free_depth")

    # -- what methods draw with ------------------------------------------------------------------------

    def sh_degree(self, step: int) -> int:
        """The degree of the harmonics that have joined in."""
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
        """What a camera sees of a model of splats, or of others; arguments as of ``rasterize``."""
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
        """The colour behind everything in a step, the same for all of its pictures.

        Behind transparent photographs it is always a random one: so splats are as transparent as these are.
        """
        if not (self.parameters.random_background or self.data.transparent):
            return 0.0, 0.0, 0.0
        red, green, blue = np.random.default_rng([self.seed, step, 5]).random(3)
        return red, green, blue

    @torch.no_grad()
    def composite_over_black(self, image: torch.Tensor, alpha: torch.Tensor, step: int) -> torch.Tensor:
        """A step's picture (H, W, 3) as it is over black, which pictures have behind them."""
        background = torch.tensor(self.background(step)).to(image)
        return image - (1 - alpha[..., None]) * background

    # -- what lasts ------------------------------------------------------------------------------------

    def arrays(self) -> dict[str, np.ndarray]:
        """What levels do not hold of the model, to go on with it or to draw it; empty where they hold all."""
        return {}

    def load_arrays(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Takes the model from what ``arrays`` gave, or stays as it is.

        Raises:
            KeyError, ValueError: an array is missing, or of another shape or type.
        """
        raise NotImplementedError("the levels hold all")

    def render_image(self, camera: Camera) -> torch.Tensor:
        """What the model itself shows a camera, (H, W, 3); asked only where ``arrays`` gives some."""
        raise NotImplementedError("the levels hold all")

    def close(self) -> None:
        """Closes files that are no longer needed."""

    def state_dict(self) -> dict:
        """Everything that the next step depends on, as tensors and numbers."""
        return {"model": self.model.state_dict(), "exposure": self.exposure.state_dict()}

    def load_state_dict(self, state: dict) -> None:
        """Continues from what ``state_dict`` gave."""
        self.model.load_state_dict(state["model"])
        self.exposure.load_state_dict(state["exposure"])

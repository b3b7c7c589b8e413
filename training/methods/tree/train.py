"""A LoD of Gaussians (Windisch et al. 2026): build a tree over a trained model, then train its cuts.

The leaves come from a base, or from 3DGS in the first steps. One step builds the tree. Each step after it
renders one view's cut, randomly coarsened (A.6, "Varying level of detail"), and updates only the nodes of
this cut.

From then on nodes are stored on disk (``store``), and consecutive views are close to each other (Sec. 4.4).
Density control (Sec. 4.2) rewrites the store (``density``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial

import numpy as np
import torch

from ...lod.blocks import BLOCKS
from ...lod.tree.forest import build_levels
from ...lod.tree.shape import LEAVES, leaf_only_columns
from ...optimize.initialize import from_points, from_splats
from ...optimize.method import Drawing, StepResult
from ...optimize.out_of_core.view_order import ViewOrder
from ...optimize.refining import RefiningMethod
from ...optimize.schedules import due, random_reduction
from ...optimize.training_data import TrainingView
from ...rasterize import Rendering, records
from ...rasterize.adam import LearningRate
from ...splats.gaussians import SplatRows
from ...splats.levels import Level
from ...splats.ply import Columns
from . import TreeParameters
from .build import ForestBuilder
from .density import TreeDensityControl
from .store import NodeStore, default_budget

SKY_RADIUS, FAR_QUANTILE = 10, 0.99
"""Radius of the sky as a multiple of the distance of the far points, and their quantile of distances."""


class RecordOptimizer:
    """Apply Adam to the records that are visible in one image, a quarter to a half of a cut.

    Args:
        store: storage of all records.
        indices: (M,) int64 cache indices of the cut.
        lr: learning rates by name, as of ``Adam`` at the time of the step.
        rate_factors: (M,) factors on these rates.
        number: number of the step, from 1.

    Attributes:
        gaussians: splats of the cut, for rendering.
        rendering: rendering of them, set after rendering.
    """

    rendering: Rendering

    def __init__(
        self,
        store: NodeStore,
        indices: np.ndarray,
        lr: Mapping[str, LearningRate],
        rate_factors: torch.Tensor,
        number: int,
    ) -> None:
        self._store = store
        self._indices = indices
        self._lr = lr
        self._rate_factors = rate_factors
        self._number = number
        self.gaussians = store.gaussians_at(indices)
        for tensor in vars(self.gaussians).values():
            tensor.requires_grad_()

    def step(self) -> None:
        """Update the visible records by one step."""
        tensors = vars(self.gaussians)
        gradients = [tensor.grad for tensor in tensors.values() if tensor.grad is not None]
        if len(gradients) < len(tensors):  # no splat is visible
            return
        rates = [
            torch.as_tensor(self._lr[name]).float().expand(tensor.shape[1:]).reshape(-1)
            for name, tensor in tensors.items()
        ]
        cache, rates = self._store.cache, torch.cat(rates)
        records.adam_step(
            cache.records, self._indices, gradients, self.rendering, self._number, rates, self._rate_factors
        )
        cache.mark_changed(self._indices[(self.rendering.radii > 0).numpy(force=True)])

    def zero_grad(self) -> None:
        """Do nothing; the next image has other records."""


class Method(RefiningMethod):
    """Training of A LoD of Gaussians.

    Attributes:
        store: all nodes, once the tree is built.
    """

    parameters: TreeParameters

    def setup(self, base: SplatRows | None) -> None:
        super().setup(None if base is None else base.select(slice(0, 0)))
        p = self.parameters
        if base is None and p.sky_points:
            points, colors = self.sky_points(p.sky_points)
            self.model.append(from_points(points, colors, p.sh_degree, self.device))
            self.parameters = replace(p, max_splats=p.max_trained_splats)
        # density control and margins belong to the 3DGS steps only
        self._densify_until = min(self._densify_until, self.finest_steps)
        self.levels = LEAVES
        self.controls = {"pixels": self.parameters.pixels}  # render with the granularity of training
        self.store: NodeStore | None = None
        self._base = base
        self._table: Columns = {}
        self._reported_budget = 0  # bytes of splat_memory in the last warning

    def sky_points(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Place points (A.2) evenly on a sphere around the cameras, in the mean colour of the scene's points.

        Returns:
            Points (count, 3) and colours (count, 3) uint8. The radius is SKY_RADIUS times the distance of
                the far points.
        """
        scene = self.data.full_scene
        center = np.mean([camera.center for camera in self.data.full_train], axis=0)
        far = np.quantile(np.linalg.norm(scene.points - center, axis=1), FAR_QUANTILE)
        height = 1 - 2 * (np.arange(count) + 0.5) / count  # a spiral with equal areas
        angle = np.pi * (3 - 5**0.5) * np.arange(count)
        around = np.sqrt(1 - height**2)
        directions = np.stack([around * np.cos(angle), around * np.sin(angle), height], axis=1)
        color = scene.point_colors.mean(axis=0).round().astype(np.uint8)
        return center + SKY_RADIUS * far * directions, np.tile(color, (count, 1))

    @property
    def splats(self) -> int:
        if self.store is not None:
            return len(self.store)
        return super().splats if self._base is None else len(self._base)

    def level_at(self, step: int) -> int:
        return LEAVES

    def stage(self, step: int) -> str:
        if not self.refines(step):
            return "leaves"
        return "building the tree" if step == self.finest_steps else "cuts"

    def ends_level(self, step: int) -> bool:
        return step + 1 in (self.finest_steps, self.steps)

    def levels_after(self, step: int) -> list[Level]:
        """Return the leaves after the 3DGS steps, as a preview, and all nodes at the end."""
        if step + 1 == self.steps:
            assert self.store is not None
            levels, self._table = build_levels(self.store, self.data.scratch)
            return levels
        if step + 1 == self.finest_steps:
            splats = self.model.splats()
            splats.extras |= leaf_only_columns(len(splats))
            return [Level(LEAVES, splats)]
        return []

    def tables(self) -> dict[str, Columns]:
        """Return the block table, which allows partial reads of the file."""
        if self.store is None:
            return {}
        return {BLOCKS: self._table or build_levels(self.store, self.data.scratch)[1]}

    # -- steps -----------------------------------------------------------------------------------------

    @cached_property
    def _view_order(self) -> ViewOrder:
        return ViewOrder(np.array([camera.center for camera in self.data.train]), self.seed)

    def view_index(self, step: int) -> int | None:
        """Choose a training view; in steps on cuts, consecutive views are mostly close to each other."""
        if not self.refines(step):
            return super().view_index(step)
        return self._view_order(step - self.finest_steps)

    def begin_step(self, step: int) -> StepResult | None:
        """Build the tree, or update the sizes of its nodes if due."""
        if step == self.finest_steps:
            return self._build_step(step)
        if self.store is not None and due(self.parameters.resize_interval, step - self.finest_steps):
            self.store.update_sizes()
        return None

    def shrink(self, step: int) -> float:
        small = self.refines(step) and self.parameters.octaves
        return random_reduction(self.seed, step) if small else super().shrink(step)

    def draw(self, view: TrainingView, step: int) -> Sequence[Drawing]:
        if not self.refines(step):
            return super().draw(view, step)
        optimizer = self.load_cut(view, step, self._pixels(step))
        optimizer.rendering = self.rasterize_model(view.camera, step, gaussians=optimizer.gaussians)
        return [Drawing(optimizer.rendering, optimizer=optimizer)]

    def load_cut(self, view: TrainingView, step: int, pixels: float) -> RecordOptimizer:
        """Load the cut of a view for rendering; only its splats take part in the next update."""
        assert self.store is not None
        indices = self.store.load_cut(view.camera, pixels, self.data.near)
        if self.store.needed_budget > 2 * self._reported_budget:  # usually once
            self._reported_budget = self.store.needed_budget
            self.warn(
                "The memory budget is too small for some views: they are trained with detail up to "
                f"{self.store.max_coarsening:.1f} times coarser. Set splat_memory to at least "
                f"{-(-self._reported_budget // 10**6):,} MB."
            )
        rate_factors, number = self._rate_factors(indices, step), step + 1 - self.finest_steps
        return RecordOptimizer(self.store, indices, self.model.lr, rate_factors, number)

    def control_density(self, step: int) -> None:
        super().control_density(step)
        p, done = self.parameters, step - self.finest_steps
        if self.store is None:
            return
        if done <= p.grow_until * p.tune_steps and due(p.grow_interval, done):
            self._rebuild_store(done)
        self.store.cache.end_step(done)

    def _rebuild_store(self, done: int) -> None:
        """Replace the store by one of the tree after density control."""
        assert self.store is not None
        p = self.parameters
        control = TreeDensityControl(
            self.store,
            threshold=p.max_threshold * p.threshold_factor(self.data.threshold_scale),
            min_opacity=p.min_opacity,
            unseen_since=done + 1 - round(p.unseen_epochs * len(self.data.train)) if p.unseen_epochs else 0,
            step=done + 1,
            max_leaves=p.splat_limit,
            region=self.data.region,
        )
        updated = self._new_store(self.store.budget)
        updated.fill_records(control, lambda: control.upper)
        updated.supersede(self.store)
        self.store = updated

    @torch.no_grad()
    def _build_step(self, step: int) -> StepResult:
        """Build the tree; the result of the step is an image rendered from it."""
        self.store = self._new_store()
        by_error = self.parameters.merge_by == "error"
        if self._base is not None:
            degree = self.parameters.sh_degree
            self.store.fill(ForestBuilder(self._base, self.data.scratch, degree, by_error=by_error))
        else:
            leaves = self.model.splats()
            no_splats = from_splats(leaves.select(slice(0)), self.parameters.sh_degree, self.device)
            self.model = self.new_model(no_splats)
            self.store.fill(ForestBuilder(leaves, by_error=by_error))
        view = self.choose_view(step)
        gaussians = self.load_cut(view, step, self.parameters.pixels).gaussians
        rendering = self.rasterize_model(view.camera, step, gaussians=gaussians)
        loss = self.loss([Drawing(rendering)], view, step)
        return StepResult(
            lambda: float(loss),
            partial(self.background.remove, rendering.image, rendering.alpha, step),
            view.target,
        )

    def _new_store(self, budget: int | None = None) -> NodeStore:
        budget = self.data.splat_memory or budget or default_budget(self.device)
        return NodeStore(self.data.scratch, self.parameters.sh_degree, budget, self.device)

    def _pixels(self, step: int) -> float:
        """Return the granularity of a step (A.6: distances times 1 + 5 r⁴)."""
        p, r = self.parameters, np.random.default_rng([self.seed, step, 12]).random()
        return p.pixels * (2 ** (p.octaves * r) if p.octaves else 1 + p.lod_noise * r**4)

    def _rate_factors(self, indices: np.ndarray, step: int) -> torch.Tensor:
        """Return factors (M,) on the learning rates of records (M,), which decrease."""
        assert self.store is not None
        p = self.parameters
        done = (step - self.finest_steps) / max(p.tune_steps, 1)
        leaf_rate, node_rate = p.leaf_rate * p.leaf_end**done, p.node_rate * p.node_end**done
        return torch.where(torch.from_numpy(self.store.is_leaf(indices)), leaf_rate, node_rate)

    # -- checkpoints -----------------------------------------------------------------------------------

    def close(self) -> None:
        if self.store is not None:
            self.store.close()

    def state_dict(self) -> dict:
        return {**super().state_dict(), "store": None if self.store is None else self.store.state_dict()}

    def load_state_dict(self, state: dict) -> None:
        super().load_state_dict(state)
        if (saved := state["store"]) is not None:
            self.store = self._new_store(saved["cache"]["budget"])
            self.store.load_state_dict(saved)

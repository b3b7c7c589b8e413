"""A LoD of Gaussians (Windisch et al. 2026): a tree over a finished model, whose cuts are then trained.

The leaves are a base, or 3DGS in the first steps. One step builds the tree; in those after it every view
draws its cut, a little coarser at random (A.6, "Varying level of detail"), and moves the nodes of this cut
alone, as if they were a scene of their own.

From then on the nodes are outside memory (``store``), and views come in an order that stays near (Sec. 4.4).
Density control (Sec. 4.2) makes a new store of the old one (``density``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property, partial

import numpy as np
import torch

from ...lod.partial_read import BLOCKS
from ...lod.tree.forest import build_levels
from ...lod.tree.shape import LEAVES, leaf_only_columns
from ...optimize.initialize import from_splats
from ...optimize.method import Drawing, StepResult
from ...optimize.out_of_core.view_order import ViewOrder
from ...optimize.schedules import due
from ...optimize.training_data import TrainingView
from ...rasterize import Gaussians, Rendering, records
from ...rasterize.adam import LearningRate
from ...splats.gaussians import SplatRows
from ...splats.levels import Level
from ...splats.ply import Columns
from ..threedgs import train as threedgs_train
from ..threedgs.refining import Refining
from . import TreeParameters
from .build import GrowingForest
from .density import Growing
from .store import Store, default_budget

LEAF_REST = 0.03
"""The rate at which leaves move at the end of training, as a share of that at its beginning."""


class SeenRecords:
    """Adam's step for the records alone that are in a picture; of a cut, a half to three quarters are not.

    Args:
        store: of all records.
        places: (M,) int64 of them in its cache.
        lr: learning rates by name, as ``Adam`` has them when the step is made.
        shares: (M,) of these rates, which each moves with.
        number: of the step, from 1.

    Attributes:
        gaussians: these splats, to make the picture from.
        rendering: of them, once it has been made.
    """

    rendering: Rendering

    def __init__(
        self,
        store: Store,
        places: np.ndarray,
        lr: Mapping[str, LearningRate],
        shares: torch.Tensor,
        number: int,
    ) -> None:
        self._store, self._places, self._lr, self._shares, self._number = store, places, lr, shares, number
        self.gaussians = store.gaussians_at(places)
        for values in vars(self.gaussians).values():
            values.requires_grad_()

    def step(self) -> None:
        """One step of these records."""
        leaves = vars(self.gaussians)
        gradients = [leaf.grad for leaf in leaves.values() if leaf.grad is not None]
        if len(gradients) < len(leaves):  # nothing of them is in the picture
            return
        rates = [
            torch.as_tensor(self._lr[name]).float().expand(leaf.shape[1:]).reshape(-1)
            for name, leaf in leaves.items()
        ]
        cache = self._store.cache
        told = self.rendering, self._number, torch.cat(rates), self._shares
        records.adam_step(cache.records, self._places, gradients, *told)
        cache.mark_changed(self._places[(self.rendering.radii > 0).numpy(force=True)])

    def zero_grad(self) -> None:
        """The next picture has other records."""


class Method(Refining):
    """One run of A LoD of Gaussians.

    Attributes:
        store: all nodes, as soon as the tree is built.
    """

    parameters: TreeParameters

    def setup(self, base: SplatRows | None) -> None:
        super().setup(None if base is None else base.select(slice(0, 0)))
        # leaves that are grown on need their own steps, and what continues photographs a model
        self._densify_until = min(self._densify_until, self.finest_steps)
        self.store: Store | None = None
        self._base = base
        self._table: Columns = {}
        self._told = 0  # bytes of splat_memory that somebody was told of

    @property
    def scheduled_steps(self) -> int:
        """Cuts go on with 3DGS where its steps for the leaves end."""
        return self.steps

    @property
    def steps(self) -> int:
        return self.finest_steps + self.parameters.base_steps

    @property
    def levels(self) -> int:
        return LEAVES

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
        """The leaves as soon as they are there, for whoever waits; all nodes at the end."""
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
        """Which blocks of rows an eye needs, by which a part of the file can be read."""
        if self.store is None:
            return {}
        return {BLOCKS: self._table or build_levels(self.store, self.data.scratch)[1]}

    def controls(self) -> dict[str, float]:
        """Pictures begin with the granularity that was trained."""
        return {"pixels": self.parameters.pixels}

    # -- a step ----------------------------------------------------------------------------------------

    @cached_property
    def _walk(self) -> ViewOrder:
        return ViewOrder(np.array([camera.center for camera in self.data.train]), self.seed)

    def view_index(self, step: int) -> int:
        """The training view of a step; of those that draw cuts most are near the one before."""
        if not self.refines(step):
            return super().view_index(step)
        return self._walk(step - self.finest_steps)

    def train_step(self, step: int) -> StepResult:
        if step == self.finest_steps:
            return self._build_step(step)
        if step < self.finest_steps:
            return super().train_step(step)
        assert self.store is not None
        if due(self.parameters.resize_interval, step - self.finest_steps):
            self.store.resize()
        told = super().train_step(step)
        self.store.cache.end_step(step - self.finest_steps)
        return told

    def set_learning_rates(self, step: int) -> None:
        if self._base is None:
            threedgs_train.Method.set_learning_rates(self, step)  # which go on falling
        else:
            super().set_learning_rates(step)

    def draw(self, view: TrainingView, step: int) -> list[Drawing]:
        if not self.refines(step):
            return super().draw(view, step)
        gaussians = self._take(view, step, self._pixels(step))
        return [Drawing(self.rasterize_model(view.camera, step, gaussians=gaussians))]

    def _take(self, view: TrainingView, step: int, pixels: float) -> Gaussians:
        """The splats of a view's cut, to draw: they alone make the step."""
        assert self.store is not None
        places = self.store.take(view.camera, pixels, self.data.near)
        if self.store.wanted > 2 * self._told:  # once, as a rule
            self._told = self.store.wanted
            self.warn(
                "The memory budget has no room for what some views show: they are trained coarser, up to "
                f"{self.store.coarsened:.1f} times so far. {-(-self._told // 10**6):,} MB as splat_memory "
                "would have room for these."
            )
        shares, number = self._shares(places, step), step + 1 - self.finest_steps
        self._optimizer = SeenRecords(self.store, places, self.model.lr, shares, number)
        return self._optimizer.gaussians

    def accumulate_stats(self, drawings: Sequence[Drawing], view: TrainingView, step: int) -> None:
        super().accumulate_stats(drawings, view, step)
        if isinstance(self._optimizer, SeenRecords):
            self._optimizer.rendering = drawings[0].rendering

    def control_density(self, step: int) -> None:
        super().control_density(step)
        p, done = self.parameters, step - self.finest_steps
        if self.store is None or done > p.grow_until * p.tune_steps or not due(p.grow_interval, done):
            return
        growing = Growing(
            self.store,
            threshold=p.max_threshold * self.data.threshold_scale,
            min_opacity=p.min_opacity,
            unseen_since=done + 1 - round(p.unseen_epochs * len(self.data.train)) if p.unseen_epochs else 0,
            now=done + 1,
            most=p.max_splats,
            region=self.data.region,
        )
        grown = self._new_store(self.store.budget)
        grown.fill_records(growing, lambda: growing.upper)
        grown.supersede(self.store)
        self.store = grown

    @torch.no_grad()
    def _build_step(self, step: int) -> StepResult:
        """Builds the tree; what is told of the step is how a view looks by it."""
        self.store = self._new_store()
        if self._base is not None:
            self.store.fill(GrowingForest(self._base, self.data.scratch, self.parameters.sh_degree))
        else:
            leaves = self.model.splats()
            none = from_splats(leaves.select(slice(0)), self.parameters.sh_degree, self.device)
            self.model = self.new_model(none)
            self.store.fill(GrowingForest(leaves))
        view = self.choose_view(step)
        gaussians = self._take(view, step, self.parameters.pixels)
        seen = self.rasterize_model(view.camera, step, gaussians=gaussians)
        loss = self.loss([Drawing(seen)], view, step)
        return StepResult(
            float(loss), partial(self.composite_over_black, seen.image, seen.alpha, step), view.target
        )

    def _new_store(self, budget: int | None = None) -> Store:
        budget = self.data.splat_memory or budget or default_budget(self.device)
        return Store(self.data.scratch, self.parameters.sh_degree, budget, self.device)

    def _pixels(self, step: int) -> float:
        """A step's granularity (A.6: distances times 1 + 5 r⁴)."""
        r = np.random.default_rng([self.seed, step, 12]).random()
        return self.parameters.pixels * (1 + self.parameters.lod_noise * r**4)

    def _shares(self, places: np.ndarray, step: int) -> torch.Tensor:
        """The shares (M,) of the learning rates that records (M,) move with: leaves come to rest."""
        assert self.store is not None
        done = (step - self.finest_steps) / max(self.parameters.tune_steps, 1)
        slow = self.parameters.leaf_rate * LEAF_REST**done
        return torch.where(torch.from_numpy(self.store.are_leaves(places)), slow, self.parameters.node_rate)

    # -- what lasts ------------------------------------------------------------------------------------

    def close(self) -> None:
        if self.store is not None:
            self.store.close()

    def state_dict(self) -> dict:
        return {**super().state_dict(), "store": None if self.store is None else self.store.state_dict()}

    def load_state_dict(self, state: dict) -> None:
        super().load_state_dict(state)
        if (kept := state["store"]) is not None:
            self.store = self._new_store(kept["cache"]["budget"])
            self.store.load_state_dict(kept)

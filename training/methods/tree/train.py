"""A LoD of Gaussians (Windisch et al. 2026): a tree over a finished model, whose cuts are then trained.

The leaves are a base, or 3DGS in the first steps. One step builds the tree; in those after it every view
draws its cut, a little coarser at random (A.6, "Varying level of detail"), and moves the nodes of this cut
alone, as if they were a scene of their own.

All nodes are rows of one model in memory. The paper's external memory (Sec. 4.4) would stand behind
:meth:`Refining.take_rows`, its density control on the tree (Sec. 4.2) in :meth:`Method.control_density`.
"""

from __future__ import annotations

import numpy as np
import torch

from ...lod.paging import table_of_pages
from ...lod.streaming import BLOCKS
from ...lod.tree import LEAVES, Tree, treeless_columns
from ...rasterize import Target
from ...rasterize.hspt import Hspt
from ...splats.bundle import Level
from ...splats.gaussians import Splats
from ...splats.ply import Columns
from ..data import TrainingView
from ..method import Drawing
from ..schedules import due
from ..start import from_splats
from ..threedgs.refining import Refining
from . import TreeParameters
from .build import build

LEAF_REST = 0.1
"""The rate at which leaves move at the end of training, as a share of that at its beginning."""


class Method(Refining):
    """One run of A LoD of Gaussians.

    Attributes:
        tree: over the model's rows, as soon as it is built.
        cuts: of the nodes as they were when sizes were last made, (2N - 1, 3) each: ``means`` and
            ``log_scales``.
    """

    parameters: TreeParameters

    def setup(self, base: Splats | None) -> None:
        super().setup(base)
        self.tree: Tree | None = None
        self.cuts: dict[str, torch.Tensor] = {}

    @property
    def steps(self) -> int:
        return self.finest_steps + self.parameters.base_steps

    @property
    def levels(self) -> int:
        return LEAVES

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
            assert self.tree is not None
            return self.tree.levels(self.model.splats())
        if step + 1 == self.finest_steps:
            splats = self.model.splats()
            splats.extras |= treeless_columns(len(splats))
            return [Level(LEAVES, splats)]
        return []

    def tables(self) -> dict[str, Columns]:
        """Which blocks of rows an eye needs, by which a part of the file can be read."""
        if self.tree is None:
            return {}
        levels = self.tree.levels(self.model.splats())
        return {BLOCKS: table_of_pages({level.number: level.splats.extras for level in levels})}

    def controls(self) -> dict[str, float]:
        """Pictures begin with the granularity that was trained."""
        return {"pixels": self.parameters.pixels}

    # -- a step ----------------------------------------------------------------------------------------

    def train_step(self, step: int) -> tuple[float, torch.Tensor, Target]:
        if step == self.finest_steps:
            return self._build_step(step)
        if step > self.finest_steps and due(self.parameters.resize_interval, step - self.finest_steps):
            self._follow_sizes()
        return super().train_step(step)

    def draw(self, view: TrainingView, step: int) -> list[Drawing]:
        if not self.refines(step):
            return super().draw(view, step)
        rows = self.cut(view, self._pixels(step))
        gaussians = self.take_rows(rows, self._shares(rows, step))
        return [Drawing(self.rasterize_model(view.camera, step, gaussians=gaussians))]

    def cut(self, view: TrainingView, pixels: float) -> torch.Tensor:
        """The rows (M,) int64 that a view is shown at a granularity, ascending."""
        rows = np.sort(self._hspt.cut(view.camera, pixels, self.data.near))
        return torch.from_numpy(rows).long().to(self.device)

    @torch.no_grad()
    def _build_step(self, step: int) -> tuple[float, torch.Tensor, Target]:
        """Builds the tree; what is told of the step is how a view looks by it."""
        nodes, self.tree = build(self.model.splats())
        self.model = self.new_model(from_splats(nodes, self.parameters.sh_degree, self.device))
        self._follow_sizes()
        view = self.choose_view(step)
        gaussians = self.model.gaussians.select(self.cut(view, self.parameters.pixels))
        drawing = Drawing(self.rasterize_model(view.camera, step, gaussians=gaussians))
        loss = self.loss([drawing], view, step)
        return float(loss), self.over_black(drawing.rendering, step), view.target

    def _follow_sizes(self) -> None:
        """Cuts are made by the nodes as they are now."""
        self.cuts = {name: self.model[name].detach().clone() for name in ("means", "log_scales")}
        self._make_cuts()

    def _make_cuts(self) -> None:
        assert self.tree is not None
        means, log_scales = (self.cuts[name].cpu().numpy() for name in ("means", "log_scales"))
        self._hspt = Hspt(self.tree, means, self.tree.sizes(means, log_scales), log_scales)

    def _pixels(self, step: int) -> float:
        """A step's granularity (A.6: distances times 1 + 5 r⁴)."""
        r = np.random.default_rng([self.seed, step, 12]).random()
        return self.parameters.pixels * (1 + self.parameters.lod_noise * r**4)

    def _shares(self, rows: torch.Tensor, step: int) -> torch.Tensor:
        """The shares (M,) of the learning rates that nodes (M,) move with: leaves come to rest."""
        assert self.tree is not None
        done = (step - self.finest_steps) / self.parameters.tune_steps
        slow = self.parameters.leaf_rate * LEAF_REST**done
        return torch.where(rows < self.tree.leaves, slow, self.parameters.node_rate)

    # -- what lasts ------------------------------------------------------------------------------------

    def state_dict(self) -> dict:
        children = None if self.tree is None else torch.from_numpy(self.tree.children)
        return {**super().state_dict(), "children": children, "cuts": self.cuts}

    def load_state_dict(self, state: dict) -> None:
        super().load_state_dict(state)
        self.tree, self.cuts = None, state["cuts"]
        if state["children"] is not None:
            self.tree = Tree(state["children"].numpy())
            self._make_cuts()

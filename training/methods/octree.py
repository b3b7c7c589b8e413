"""Octree-GS (Ren et al. 2024) with explicit anchors: levels of an octree that add up, chosen by distance.

An anchor is one Gaussian with parameters of its own and no network. It belongs to a level, and began in a
voxel of that level in which no other anchor was. What a view draws follows ``lod.rules.octree_weights``,
rounded while training.
"""

from __future__ import annotations

import numpy as np
import torch

from ..errors import LodgsError
from ..lod import octree
from ..lod.rules import octree_wanted, octree_weights
from ..lod.selection import BIAS
from ..rasterize import Rendering, Target, contributions, device_of, photometric_loss, rasterize
from ..rasterize.features import rotation_matrices
from ..rasterize.rendering import ALPHA_MIN
from ..scenes.cameras import Camera
from ..splats.bundle import Level
from . import Method as Interface
from .data import TrainingData
from .model import NAMES, Model, distinct, from_points, means_rate, neighbour_scale, splat_model
from .parameters import OctreeParameters

SMALLEST = 32
"""Pixels that the shorter side of a photograph made smaller has at least."""
FAINT = float(np.log(0.1 / 0.9))
"""Logit of the opacity that new splats have at most, so that pictures do not change when they come."""


class Method(Interface):
    """One run of Octree-GS; see ``methods.Method`` for what it does for the loop.

    Attributes:
        tree: the levels and their voxels.
        joins: the step at which each level joins.
    """

    cumulative = True

    def __init__(self, data: TrainingData, parameters: OctreeParameters, seed: int, backend: str) -> None:
        self.data, self.parameters, self.seed, self.backend = data, parameters, seed, backend
        self.device = device_of(backend)
        p = parameters
        points, colors = distinct(data.scene.points, data.scene.point_colors)
        self.tree = octree.build(
            points, data.train, focal_px=data.focal, footprint=p.footprint,
            quantiles=(p.nearest, p.farthest), levels=p.levels, coarser=p.coarser_levels,
        )  # fmt: skip
        self.joins = self._joins()
        level = octree.anchors(points, self.tree)
        chosen = np.flatnonzero(level > 0)
        chosen = chosen[self._worth_having(points[chosen], level[chosen])]
        if len(chosen) > self._room():
            chosen = np.sort(np.random.default_rng(seed).choice(chosen, self._room(), replace=False))
        self.model = self._first_model(points[chosen], colors[chosen], level[chosen])
        self._rates = dict(self.model.adam.lr)

    # -- what the loop asks of every method ------------------------------------------------------------

    @property
    def steps(self) -> int:
        return self.parameters.steps

    @property
    def levels(self) -> int:
        return self.tree.levels

    @property
    def splats(self) -> int:
        return len(self.model)

    def level_at(self, step: int) -> int:
        return sum(step >= join for join in self.joins)

    def train_step(self, step: int) -> tuple[float, torch.Tensor, Target]:
        p = self.parameters
        view, shrink = self.data.training_view(step, self.seed), self._shrink(step)
        camera, target = self.data.camera(view, shrink), self.data.target(view, shrink)
        rendering = self._draw(camera, self._weights(camera, step, whole=shrink == 1), step)
        loss = photometric_loss(rendering.image, target, p.ssim_weight, backend=self.backend)
        self._regularised(loss, rendering).backward()
        growing = step < p.grow_until * p.steps
        if growing and (shrink == 1 or step < self.joins[-1]):
            rendering.grad2d /= shrink  # as TrainingData.threshold_scale has it for smaller photographs
            self._remember(rendering)
        self._optimise(step)
        if growing and (step + 1) % p.grow_interval == 0:
            self._grow_and_prune(step)
        grown = growing and step + 1 >= p.grow_until * p.steps
        if p.least_weight and (grown or step + 1 == p.steps):
            self._review(step)
        if (step + 1) % p.grow_interval == 0 or step + 1 == self.steps:
            self._settle(step)
        return float(loss.detach()), rendering.image.detach(), target

    def levels_after(self, step: int) -> list[Level]:
        """All levels, when the last one has joined and at the end."""
        if step + 1 not in (self.joins[-1], self.steps):
            return []
        splats, level = self.model.splats(), self.model.columns["level"].cpu().numpy()
        splats.extras = {"lod_level": level.astype(np.uint8), BIAS: self.model.columns["bias"].cpu().numpy()}
        return [Level(number, splats.select(level == number)) for number in range(1, self.levels + 1)]

    def meta(self) -> dict:
        data = self.data
        return {
            "d_max": self.tree.d_max,
            "voxel": self.tree.voxel,
            "camera_center": data.mean_camera.tolist(),
            "focal_px": data.focal,
            "focal_width": data.train[0].width,
            "scene_extent": data.extent,
            "median_depth": data.median_depth,
        }

    def state_dict(self) -> dict:
        return {"model": self.model.state_dict()}

    def load_state_dict(self, state: dict) -> None:
        self.model.load_state_dict(state["model"])

    # -- drawing ---------------------------------------------------------------------------------------

    def _draw(self, camera: Camera, weights: torch.Tensor, step: int) -> Rendering:
        p = self.parameters
        return rasterize(
            *(self.model[name] for name in NAMES),
            camera=camera,
            weights=weights,
            sh_degree=min(p.sh_degree, step // max(p.sh_interval, 1)),
            near=self.data.near,
            backend=self.backend,
        )

    def _regularised(self, loss: torch.Tensor, rendering: Rendering) -> torch.Tensor:
        """The loss with the volume of what is drawn (Octree-GS, Sec. 7.1)."""
        if not self.parameters.volume_weight:
            return loss
        scales = self.model["log_scales"][rendering.radii > 0].exp() / self.data.median_depth
        return loss + self.parameters.volume_weight * scales.prod(1).mean()

    def _weights(self, camera: Camera, step: int, whole: bool) -> torch.Tensor:
        """1 for what a step draws, 0 for the rest; with ``whole``, sometimes for all that has joined."""
        columns, newest = self.model.columns, self.level_at(step)
        if whole and np.random.default_rng([self.seed, step, 4]).random() < self.parameters.full_share:
            return (columns["level"] <= newest).float()
        wanted = self._wanted(camera).clip(1, newest)
        return (octree_weights(wanted, columns["level"]) >= 0.5).float()

    def _wanted(self, camera: Camera) -> torch.Tensor:
        """The level that a view wants at every splat, not rounded."""
        means = self.model["means"].detach()
        distances = (means - torch.as_tensor(camera.center).to(means)).norm(dim=1)
        distances *= self.tree.focal_px / min(camera.fx, camera.fy)
        return octree_wanted(distances, self.model.columns["bias"], self.tree.d_max, self.levels)

    def _shrinks(self) -> list[int]:
        """How many times smaller photographs are made at most, in powers of two from 1."""
        side = min(min(camera.width, camera.height) for camera in self.data.train)
        most = min(self.levels - 1, int(np.log2(max(side / SMALLEST, 1)))) if self.parameters.far_share else 0
        return [2**i for i in range(most + 1)]

    def _shrink(self, step: int) -> int:
        """How many times smaller a step's photograph is made: what one as many times farther away sees.

        Levels that finer ones have not joined yet see what they would be wanted for; later some steps do, so
        that levels learn to stand alone that no photograph is far enough away for. Not in the paper.
        """
        shrinks = self._shrinks()
        if step < self.joins[-1]:
            return shrinks[min(self.levels - self.level_at(step), len(shrinks) - 1)]
        rng = np.random.default_rng([self.seed, step, 3])
        if len(shrinks) == 1 or rng.random() >= self.parameters.far_share:
            return 1
        return shrinks[int(rng.integers(1, len(shrinks)))]

    # -- anchors ---------------------------------------------------------------------------------------

    def _joins(self) -> list[int]:
        """The coarser half of the levels is there at once; each trains longer than the next (Sec. 4.3)."""
        p, first = self.parameters, max(self.levels // 2, 1)
        intervals = p.coarse_factor ** -np.arange(self.levels - first + 1.0)
        ends = np.cumsum(intervals) / intervals.sum() * p.coarse_share * p.steps
        return [0] * first + [round(end) for end in ends[:-1]]

    def _worth_having(self, points: np.ndarray, level: np.ndarray) -> np.ndarray:
        """Whether enough views want the level at a point (N, 3): the paper's weeding, by distance alone."""
        wanting = np.zeros(len(points))
        for camera in self.data.train:
            distances = np.linalg.norm(points - camera.center, axis=1)
            distances *= self.tree.focal_px / min(camera.fx, camera.fy)
            wanted = octree_wanted(distances, 0.0, self.tree.d_max, self.levels)
            wanting += octree_weights(wanted, level) >= 0.5
        return wanting >= max(self.parameters.visible_share * len(self.data.train), 1)

    def _first_model(self, points: np.ndarray, colors: np.ndarray, level: np.ndarray) -> Model:
        """Splats at the points (N, 3), of levels (N,); their size is :meth:`_log_spacing`."""
        tensors = from_points(points, colors, self.parameters.sh_degree)
        tensors["log_scales"] = self._log_spacing(points, level, columns=3)
        zeros = torch.zeros(len(points))
        columns = {"level": torch.from_numpy(level).float(), "bias": zeros, "opacity_sum": zeros.clone()}
        tensors, columns = (
            {name: tensor.to(self.device) for name, tensor in some.items()} for some in (tensors, columns)
        )
        return splat_model(tensors, self.parameters, self.data.extent, columns)

    def _log_spacing(self, points: np.ndarray, level: np.ndarray, columns: int) -> torch.Tensor:
        """Log of how far apart points of a level and coarser ones are, (N, columns)."""
        scale = np.empty(len(points))
        for number in np.unique(level):
            upto = level <= number
            scale[level == number] = neighbour_scale(points[upto])[level[upto] == number]
        return torch.from_numpy(np.repeat(np.log(scale)[:, None], columns, 1)).float()

    def _remember(self, rendering: Rendering) -> None:
        self.model.remember(rendering)
        opacity = self.model["opacity_logits"].detach().sigmoid()
        self.model.columns["opacity_sum"] += torch.where(rendering.radii > 0, opacity, 0)

    def _fallen_rates(self, step: int) -> dict:
        """Learning rates at a step, by name: they fall from when growing ends. Not in the paper."""
        p = self.parameters
        after = step / self.steps - p.grow_until
        fall = p.lr_end ** (after / (1 - p.grow_until)) if after > 0 else 1.0
        return {name: rate * fall for name, rate in self._rates.items()}

    def _optimise(self, step: int) -> None:
        self.model.adam.lr = self._fallen_rates(step)
        self.model.adam.lr["means"] = means_rate(self.parameters, step / self.steps, self.data.extent)
        self.model.adam.step()
        self.model.adam.zero_grad()

    @torch.no_grad()
    def _grow_and_prune(self, step: int) -> None:
        """New anchors in free voxels where gradients are large (Octree-GS, Sec. 4.2); faint ones go.

        A splat proposes places drawn from itself, in its own level, or in the next one if its gradient is
        above that level's threshold. What there is room for rises with the square of the steps, so that most
        is left for finer levels.
        """
        p, model, columns = self.parameters, self.model, self.model.columns
        gradient, level = model.mean_gradient(), columns["level"]
        gradient = gradient.view(len(model), -1)  # of each of an anchor's Gaussians
        harder = 2**p.grow_harder
        rising = harder ** (level - 1 - p.coarser_levels).clamp_min(0)
        threshold = (p.grad_threshold * self.data.threshold_scale * rising)[:, None]
        target = level[:, None].expand_as(gradient)
        if step >= p.coarse_share * p.steps:
            target = (target + (gradient >= threshold * harder)).clamp_max(self.levels)
            columns["bias"] += p.bias_rate * (gradient >= 0.25 * threshold).any(1)

        source, which = torch.nonzero(gradient >= threshold).unbind(1)
        order = torch.argsort(gradient[source, which], descending=True, stable=True)
        source, which = source[order], which[order]
        rng = np.random.default_rng([self.seed, step, 1])
        rows = self._children(source, which, target[source, which], rng)
        room = int(self._room() * min((step + 1) / (p.grow_until * self.steps), 1.0) ** 2) - len(model)
        free = self._free(rows["means"], rows["level"])[: max(room, 0)]

        model.keep(~self._faint())
        model.append({name: row[free] for name, row in rows.items()})
        model.forget()
        model.columns["opacity_sum"].zero_()
        self._some_left(step, "min_opacity")

    @torch.no_grad()
    def _review(self, step: int) -> None:
        """Splats go of which no view, near or far, sees much, by their largest blending weight (RadSplat).

        Not in the paper.
        """
        unjoined = self.model.columns["level"] > self.level_at(step)
        largest = torch.zeros_like(self.model.columns["seen"])
        for view in range(len(self.data.train)):
            for shrink in self._shrinks():
                camera = self.data.camera(view, shrink)
                weights = self._weights(camera, step, whole=False)
                torch.maximum(largest, self._largest(camera, view, weights), out=largest)
        poor = (largest < self.parameters.least_weight).view(len(self.model), -1) & ~unjoined[:, None]
        self._silence(poor)
        self.model.keep(~poor.all(1))
        self._some_left(step, "least_weight")

    def _some_left(self, step: int, limit: str) -> None:
        if not len(self.model):
            raise LodgsError(
                f"No splat is left at step {step + 1}.", f"Lower '{limit}', or choose another preset."
            )

    def _silence(self, splats: torch.Tensor) -> None:
        """Of anchors that stay, those Gaussians (N, n) are no longer drawn."""

    def _largest(self, camera: Camera, view: int, weights: torch.Tensor) -> torch.Tensor:
        """The largest blending weight of each splat, shaped as ``seen``, in a training view."""
        names = "means", "quats", "log_scales", "opacity_logits"
        return contributions(
            *(self.model[name] for name in names),
            cameras=[camera],
            weights=weights,
            near=self.data.near,
            backend=self.backend,
        ).largest

    def _settle(self, step: int) -> None:
        """Splats that have become too wide or too narrow for their level move to one that they fit.

        Wide ones would be seen from farther away than their level is drawn, narrow ones would be drawn from
        where they are not seen. Not in the paper.
        """
        columns, newest = self.model.columns, self.level_at(step)
        means, log_scales = self.model["means"].detach(), self.model["log_scales"].detach()
        columns["level"] = self._fitting(columns["level"], means, log_scales, newest)

    def _fitting(
        self, level: torch.Tensor, means: torch.Tensor, log_scales: torch.Tensor, newest: int
    ) -> torch.Tensor:
        """The level (N,) nearest to the given one for splats at places (N, 3), with logs of scales (N, 3).

        Narrow ones move to ``newest`` at most, to the first level that photographs want at most, and only
        where one does want it: so hardly a photograph is drawn otherwise.
        """
        p, pixel = self.parameters, self.tree.d_max / self.tree.focal_px  # at level 1's distance
        width = log_scales.amax(1).sub(float(np.log(pixel))) / float(np.log(2))
        finer, coarser = (1 + torch.tensor(limit).log2() - width for limit in (p.narrowest, p.widest))
        finer = torch.maximum(level, finer.ceil().clamp_max(min(newest, p.coarser_levels + 1)))
        narrow = torch.nonzero(finer > level)[:, 0]
        wanted = self._worth_having(means[narrow].double().cpu().numpy(), finer[narrow].cpu().numpy())
        narrow = narrow[torch.from_numpy(wanted).to(narrow.device)]
        level = level.index_copy(0, narrow, finer[narrow])
        return torch.minimum(level, coarser.floor().clamp_min(1))

    def _room(self) -> int:
        """Most anchors."""
        return self.parameters.max_splats

    def _faint(self) -> torch.Tensor:
        """Anchors (N,) whose opacity was too low on average in the views that drew them, or is for any."""
        columns, opacity = self.model.columns, self.model["opacity_logits"].detach().sigmoid()
        low = columns["opacity_sum"] < self.parameters.min_opacity * columns["seen"]
        return low | (opacity < min(self.parameters.min_opacity, ALPHA_MIN))

    def _children(
        self, source: torch.Tensor, which: torch.Tensor, level: torch.Tensor, rng: np.random.Generator
    ) -> dict[str, torch.Tensor]:
        """Rows that anchors propose: a splat's likeness at places drawn from itself, smaller and faint.

        Args:
            source, which: (C,) the anchors, and which of their Gaussians has the large gradient.
            level: (C,) the level to grow in.
        """
        source, level = (x.repeat_interleave(self.parameters.candidates) for x in (source, level))
        rows = {name: self.model[name][source] for name in NAMES}
        local = torch.from_numpy(rng.standard_normal((len(source), 3), np.float32)).to(self.device)
        local *= rows["log_scales"].exp()
        rows["means"] += torch.einsum("nij,nj->ni", rotation_matrices(rows["quats"]), local)
        rows["log_scales"] -= float(np.log(1.6))
        rows["opacity_logits"].clamp_max_(FAINT)
        return rows | {"level": level, "bias": self.model.columns["bias"][source]}

    def _free(self, means: torch.Tensor, level: torch.Tensor) -> torch.Tensor:
        """Indices, in order, of places worth having that are the first in a voxel without an anchor."""

        def keys(means: torch.Tensor, level: torch.Tensor) -> np.ndarray:
            return self.tree.keys(means.double().cpu().numpy(), level.long().cpu().numpy())

        proposed = keys(means, level)
        taken = keys(self.model["means"], self.model.columns["level"])
        _, first = np.unique(proposed, return_index=True)
        free = np.sort(first[~np.isin(proposed[first], taken)])
        free = free[self._worth_having(means[free].double().cpu().numpy(), level[free].cpu().numpy())]
        return torch.from_numpy(free).to(self.device)

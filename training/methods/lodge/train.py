"""LODGE (2025): train levels, finest first, each from a copy of the finest; then compute chunks.

In the paper, a level is smoothed for its distance, pruned of unimportant splats, and tuned while blended with
the finer levels, which are frozen (Sec. 3, A.2). Not in the paper: merge each level from the next finer one,
and refine it alone and blended. The finest level is a base, or the result of 3DGS in the first
steps. The last steps compute the splat sets of chunks, one per step.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from ...errors import LodgsError
from ...lod.blocks import BLOCKS, BlockIndex, block_quantiles, block_table
from ...lod.rules.chunks import RULE, TABLE, member_columns
from ...optimize.density_control import require_rows
from ...optimize.initialize import from_splats
from ...optimize.merging import merge
from ...optimize.method import Drawing, StepResult
from ...optimize.model import NAMES, select_rows
from ...optimize.pruning import importance_threshold, log_scale_gain
from ...optimize.refining import MERGED_RATE, RefiningMethod, drop_invisible, refining_rates
from ...optimize.schedules import LevelStages, random_reduction
from ...optimize.training_data import TrainingView
from ...rasterize import Gaussians, photometric_loss
from ...scenes.cameras import pick_evenly
from ...splats.gaussians import Splats
from ...splats.levels import Level
from ...splats.morton import spatial_order
from ...splats.ply import Columns
from . import ROUNDS, LodgeParameters, chunks
from .composite import (
    IndexedLevel,
    LevelStack,
    gather_rows,
    seen_from_distance,
    smooth,
    visible_rows,
)
from .thresholds import MAX_CURVES, Thresholds

COUNTED_VIEWS = 24
"""Number of training views in which drawn splats are counted."""
FAR_VIEWS = 2
"""Number of training views at a level's distance or farther that suffice to tune and prune a splat."""


class Method(RefiningMethod):
    """Training of LODGE levels.

    Attributes:
        stages: levels in the order of training; the finest has no steps if it is a base.
        d_l: distance from which each level is drawn, in scene units, by number; entries are added during
            training.
        finished: frozen levels as rendered, by number, finest first.
        costs: reports of the choice of distances, see ``Thresholds``.
        centers, radii: chunks, (K, 3) and (K,) float32, once their number is known.
        sets: which splats of each level (N,) belong to each computed chunk, by level number.
    """

    parameters: LodgeParameters

    def setup(self, base: Splats | None) -> None:
        p = self.parameters
        if base is not None and p.levels == 1:
            raise LodgsError(
                "Cannot train a single level: the base already is that level.", "Set levels to 2 or more."
            )
        super().setup(base)
        self.levels = p.levels
        coarser = ((number, p.level_steps) for number in range(p.levels - 1, 0, -1))
        self.stages = LevelStages([(p.levels, self.finest_steps), *coarser])
        self.background.end = self.finest_steps  # the finest level already prevents a fit to the background
        self.d_l = {p.levels: 0.0}
        self.finished: dict[int, IndexedLevel] = {}
        self.costs: list[dict] = []
        self._use_chunks(np.zeros((0, 3), np.float32), np.zeros(0, np.float32))
        self.sets: dict[int, list[np.ndarray]] = {}
        self._blocks: BlockIndex | None = None  # blocks of the level in training, as of its last pruning
        self._single_share = p.tune_alone

    @property
    def tuned_steps(self) -> int:
        """Number of steps before the chunks."""
        return self.finest_steps + self.parameters.base_steps

    def level_at(self, step: int) -> int:
        return self.stages.level_at(step)

    def ends_level(self, step: int) -> bool:
        done = step + 1
        if done > self.tuned_steps:
            return done == self.steps
        return done in self.stages.ends

    def stage(self, step: int) -> str:
        if step < self.tuned_steps:
            return super().stage(step)
        return f"chunk {step - self.tuned_steps + 1} of {len(self.centers)}"

    def levels_after(self, step: int) -> list[Level]:
        """Return the finest level once it is trained, each coarser level after tuning, and all after the
        last chunk.
        """
        done, levels = step + 1, []
        if done > self.tuned_steps:
            numbers = sorted(self.finished) if done == self.steps else []
            return [self._make_level(number) for number in numbers]
        if done == max(self.finest_steps, 1):
            self._finish(self.levels)
            levels.append(self._make_level(self.levels))
        if step >= self.finest_steps and done in self.stages.ends:
            levels.insert(0, self._make_level(self.level_at(step)))
        return levels

    def tables(self) -> dict[str, Columns]:
        """Return the table of chunks, if any, and the block table."""
        if not len(self.centers):
            return {}
        x, y, z = self.centers.T
        levels = ((number, self._make_level(number).splats.extras) for number in sorted(self.sets))
        return {
            TABLE: {"x": x, "y": y, "z": z, "radius": self.radii},
            BLOCKS: block_table(RULE.block_bounds, levels),
        }

    def meta(self) -> dict:
        report = {"costs": self.costs} if self.levels <= MAX_CURVES else {}
        return {**super().meta(), "filter_variance": self.parameters.filter_variance, **report}

    # -- steps -----------------------------------------------------------------------------------------

    def shrink(self, step: int) -> float:
        if not (self.refines(step) and self._renders_single(step)):
            return super().shrink(step)
        merges = self.parameters.merges
        return random_reduction(self.seed, step) if merges else self._distance_ratio(self.level_at(step))

    def set_learning_rates(self, step: int) -> None:
        p = self.parameters
        if not (p.merges and self.refines(step)):
            super().set_learning_rates(step)
            return
        self.model.lr = refining_rates(p, self.data.extent, self.stages.share(step), MERGED_RATE)

    def begin_step(self, step: int) -> StepResult | None:
        """Compute a chunk, or prune the level if a round begins."""
        if step >= self.tuned_steps:
            return self._chunk_step(step)
        if step >= self.finest_steps:
            local, p = self.stages.local_step(step), self.parameters
            if local == 0:
                self._begin_level(self.level_at(step))
                if p.merges:
                    self._merge_level(step)
            if not p.merges and local % p.tune_steps == 0:
                self.begin_round(step)
        return None

    def view_index(self, step: int) -> int | None:
        return super().view_index(step) if step < self.tuned_steps else None

    def draw(self, view: TrainingView, step: int) -> Sequence[Drawing]:
        if step < self.finest_steps:
            return super().draw(view, step)
        number, near = self.level_at(step), self.data.near
        level = IndexedLevel.of(self.model.gaussians, self._blocks)
        if self._renders_single(step):
            rows = {number: level.in_view(view.camera, near)}
        else:
            levels, d_l = {**self.finished, number: level}, self.random_distances(step)
            rows = visible_rows(levels, d_l, view.camera, near, self.random_scale(step))
        trained_rows = torch.from_numpy(rows[number]).long().to(self.device)
        optimizer = select_rows(self.model, trained_rows)
        parts = [self._smooth(optimizer.gaussians, number)]
        if len(rows) > 1:
            parts.insert(
                0,
                gather_rows(self.finished, {n: level_rows for n, level_rows in rows.items() if n != number}),
            )
        rendering = self.rasterize_model(view.camera, step, gaussians=Gaussians.concatenated(parts))
        return [Drawing(rendering, optimizer=optimizer)]

    def random_scale(self, step: int) -> float:
        """Draw the rule's factor on distances of a tuning step; 1 if each level has its own."""
        rng, spread = np.random.default_rng([self.seed, step, 8]), self.parameters.tune_range
        return 1.0 if self.parameters.tune_each else 1 / rng.uniform(1 - spread, 1 + spread)

    def random_distances(self, step: int) -> dict[int, float]:
        """Draw the distance of each level in a tuning step, uniform around its own (A.2), finest first.

        A level never begins before the next finer one.
        """
        if not self.parameters.tune_each:
            return self.d_l
        rng, spread = np.random.default_rng([self.seed, step, 8]), self.parameters.tune_range
        drawn, distance = {}, 0.0
        for number in sorted(self.d_l, reverse=True):
            distance = max(self.d_l[number] * rng.uniform(1 - spread, 1 + spread), distance)
            drawn[number] = distance
        return drawn

    # -- levels ----------------------------------------------------------------------------------------

    def begin_round(self, step: int) -> None:
        """Prune the level before a step."""
        number, importance = self.level_at(step), self.importance(self.level_at(step))
        pruning_round = self.stages.local_step(step) // self.parameters.tune_steps
        previous, part = (0.0, *ROUNDS)[pruning_round], ROUNDS[pruning_round]
        keep, thinned = self._select_important(number, importance, previous, part)
        with torch.no_grad():
            log_scales = self.model["log_scales"].cpu().numpy()
            gain = log_scale_gain(log_scales, importance.numpy(), keep.numpy())
            self.model["log_scales"].add_((torch.from_numpy(gain) * thinned).to(self.device)[:, None])
        self.model.keep(keep)
        require_rows(self.model, step, "prune_weight")
        self._blocks = self._smoothed_level(number).blocks

    def _select_important(
        self, number: int, importance: torch.Tensor, previous: float, part: float
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the splats (N,) to keep in a round, and those in blocks that are thinned.

        Args:
            previous, part: fractions of the pruning threshold of the round before and of this one.
        """
        p = self.parameters
        # per spatial block; all rounds together reach the level's fraction of the finest level's splats
        share = p.keep ** ((self.levels - number) * (part - previous))
        threshold = torch.from_numpy(block_quantiles(importance.numpy(), 1 - share))
        weight = max(p.prune_weight * part, self._budget_threshold(number, importance, part))
        return importance >= threshold.clamp_min(weight), threshold > weight

    def _merge_level(self, step: int) -> None:
        """Replace the copy of the finest level by a merge of the next finer level.

        The merge has as many splats as pruning in one round would keep, and at most ``keep`` of that level's.
        """
        p, number = self.parameters, self.level_at(step)
        keep, _ = self._select_important(number, self.importance(number), 0.0, 1.0)
        finer = self._make_level(number + 1).splats
        finer.extras = {}
        count = max(min(int(keep.sum()), round(p.keep * len(finer))), 1)
        merged = merge(drop_invisible(finer, count, self.data, p, self.backend), count)
        tensors = from_splats(merged.select(spatial_order(merged.means)), p.sh_degree, self.device)
        self.model = self.new_model(tensors)
        self._blocks = self._smoothed_level(number).blocks

    def _budget_threshold(self, number: int, importance: torch.Tensor, part: float) -> float:
        """Return the importance threshold of a level that meets the limit ``drawn`` for the training views.

        ``part`` interpolates from all splats to the limit. At least a quarter of the splats drawn in the
        views remain.
        """
        share = 1 - (1 - self.parameters.drawn) * part
        if share == 1:
            return 0.0
        level, finest, near = self._smoothed_level(number), self.finished[self.levels], self.data.near
        levels = {**self.finished, number: level}
        views = np.zeros(len(level), np.int64)
        finest_splats = other_splats = 0
        for camera in pick_evenly(self.data.train, COUNTED_VIEWS):
            finest_splats += camera.sees(finest.means[finest.in_view(camera, near)], near).sum()
            for drawn, rows in visible_rows(levels, self.d_l, camera, near).items():
                in_image = camera.sees(levels[drawn].means[rows], near)
                if drawn == number:
                    views[rows[in_image]] += 1
                else:
                    other_splats += in_image.sum()
        max_views = max(share * finest_splats - other_splats, views.sum() / 4)
        return importance_threshold(importance.numpy(), views, max_views)

    def _max_distance(self, number: int) -> float:
        """Return the maximum distance, in scene units, that leaves room for further levels before the next
        coarser level of fixed distance.
        """
        coarser = self.parameters.distances[number - 1 :: -1]
        steps = next((steps for steps, distance in enumerate(coarser) if distance), None)
        if steps is None:
            return np.inf
        end, begin = coarser[steps] * self.data.median_depth, max(self.d_l.values())
        return max(end / self.parameters.min_ratio**steps, (begin * end) ** 0.5)

    def _begin_level(self, number: int) -> None:
        p, data = self.parameters, self.data
        self._finish(number + 1)
        finest = self.finished[self.levels]
        fixed = p.distances[number - 1] * data.median_depth
        if fixed:
            self.d_l[number] = fixed
        else:
            thresholds = Thresholds(
                data.train, data.near, self.backend, p.prune_weight, self._std, p.antialias, p.min_ratio
            )
            max_distance = self._max_distance(number)
            self.d_l[number], costs = thresholds.choose(self.finished, self.d_l, max_distance)
            self.costs.append({"level": number, **costs})
        if number == self.levels - 1:
            self._place_chunks()
        well_seen = seen_from_distance(finest, data.train, data.near, self.d_l[number], FAR_VIEWS)
        self._single_share = p.tune_alone * (1.0 if p.merges else float((~well_seen).mean()))
        tensors = {name: getattr(finest.gaussians, name).clone() for name in NAMES}
        self.model = self.new_model(tensors)

    def _finish(self, number: int) -> None:
        """Freeze the level in training."""
        if number in self.finished:
            return
        level = self._smoothed_level(number)
        if number == self.levels and self.finest_steps:
            order = torch.from_numpy(spatial_order(level.means))
            level = IndexedLevel.of(level.gaussians.select(order))
        self.finished[number] = level

    @torch.no_grad()
    def _smoothed_level(self, number: int) -> IndexedLevel:
        """Return the model as a level, with the filter for its distance (Eq. 3), which training cannot
        undo.
        """
        return IndexedLevel.of(self._smooth(self.model.gaussians.detach(), number))

    def _smooth(self, gaussians: Gaussians, number: int) -> Gaussians:
        """Apply the filter of a level to its splats; merged levels are not smoothed."""
        d_l = self.d_l[number]
        return gaussians if self.parameters.merges or not d_l else smooth(gaussians, self._std(d_l))

    @torch.no_grad()
    def importance(self, number: int) -> torch.Tensor:
        """Return the maximum share (N,) of a pixel of each splat of the level in training.

        Images are the training views, blended with the finer levels. Splats that too few training views
        see from the level's distance are also measured in views of the level alone from that distance,
        which include the margins.
        """
        data, backend = self.data, self.backend
        level, ratio, near = self._smoothed_level(number), self._distance_ratio(number), data.near
        levels = {**self.finished, number: level}
        stack = LevelStack(levels, self.parameters.antialias)
        blended = ((camera, visible_rows(levels, self.d_l, camera, near)) for camera in data.train)
        importance = stack.importance(blended, near, backend)[stack.slices[number]]
        if not self.parameters.tune_alone:
            return importance
        well_seen = seen_from_distance(level, data.train, near, self.d_l[number], FAR_VIEWS)
        if well_seen.all():
            return importance
        views = (camera.widened(self.parameters.margin).scaled(1 / ratio) for camera in data.train)
        far_views = ((view, {number: level.in_view(view, near)}) for view in views)
        single = LevelStack({number: level}, self.parameters.antialias).importance(far_views, near, backend)
        return torch.where(torch.from_numpy(well_seen), importance, torch.maximum(importance, single))

    # -- chunks ----------------------------------------------------------------------------------------

    def _place_chunks(self) -> None:
        """Place the chunks once the end of the finest level is known (Eq. 5)."""
        positions = np.array([camera.center for camera in self.data.train])
        count = self.parameters.chunks or chunks.chunk_count(positions, self.d_l[self.levels - 1])
        if count >= (2 if self.parameters.chunks else self.parameters.min_chunks):
            self._use_chunks(*chunks.place_chunks(positions, count, self.seed))

    def _use_chunks(self, centers: np.ndarray, radii: np.ndarray) -> None:
        """Set the chunks, (K, 3) and (K,). Each takes a step at the end of the run."""
        self.centers, self.radii = centers, radii
        self.steps = self.tuned_steps + len(centers)

    @torch.no_grad()
    def _chunk_step(self, step: int) -> StepResult:
        """Compute the set of one chunk; the result of the step is an image of a photo's view by this set."""
        p, data, number = self.parameters, self.data, step - self.tuned_steps
        if number == 0:
            self._finish(1)
        levels, center, radius = self.finished, self.centers[number], float(self.radii[number])
        rows = chunks.chunk_rows(levels, self.d_l, center, radius)
        near = chunks.cameras_near(data.train, self.centers, number)
        if p.visible_weight:
            rng = np.random.default_rng([self.seed, number, 11])
            views = [*near, *chunks.turn_cameras(near, rng)]
            rows = chunks.prune_invisible(
                levels, rows, views, p.visible_weight, data.near, self.backend, p.antialias
            )
        for level, rows_of_level in rows.items():
            in_set = np.zeros(len(levels[level]), bool)
            in_set[rows_of_level] = True
            self.sets.setdefault(level, []).append(in_set)
        nearest = min(near or data.train, key=lambda camera: np.linalg.norm(camera.center - center))
        view = data.view(data.train.index(nearest))
        rendering = self.rasterize_model(view.camera, step, gaussians=gather_rows(levels, rows))
        loss = photometric_loss(rendering.image, view.target, p.ssim_weight, backend=self.backend)
        return StepResult(lambda: float(loss), lambda: rendering.image, view.target)

    # -- results ---------------------------------------------------------------------------------------

    def _make_level(self, number: int) -> Level:
        level = self.finished[number] if number in self.finished else self._smoothed_level(number)
        splats = Splats(*(tensor.cpu().numpy().copy() for tensor in vars(level.gaussians).values()))
        if number in self.sets:
            splats.extras = member_columns(np.stack(self.sets[number]))
        return Level(number, splats, {"d_l": self.d_l[number]})

    def _std(self, distance: float) -> float:
        """Return the filter's standard deviation for a distance, in scene units (Eq. 3, as in
        Mip-Splatting).
        """
        return self.parameters.filter_variance**0.5 * distance / self.data.focal

    def _distance_ratio(self, number: int) -> float:
        """Return the distance of a level as a multiple of the median depth; at least 1."""
        return max(self.d_l.get(number, 0.0) / self.data.median_depth, 1.0)

    def _renders_single(self, step: int) -> bool:
        draw = np.random.default_rng([self.seed, step, 9]).random()
        return draw < self._single_share

    # -- checkpoints -----------------------------------------------------------------------------------

    def state_dict(self) -> dict:
        finished = {number: dict(vars(level.gaussians)) for number, level in self.finished.items()}
        blocks = self._blocks
        return {
            **super().state_dict(),
            "d_l": self.d_l, "finished": finished, "costs": self.costs, "alone": self._single_share,
            "blocks": {} if blocks is None else {
                "count": blocks.count, "low": torch.from_numpy(blocks.low),
                "high": torch.from_numpy(blocks.high), "reach": torch.from_numpy(blocks.columns["reach"]),
            },
            "centres": torch.from_numpy(self.centers), "radii": torch.from_numpy(self.radii),
            "sets": {
                number: torch.from_numpy(np.packbits(np.stack(sets), axis=1))
                for number, sets in self.sets.items()
            },
        }  # fmt: skip

    def load_state_dict(self, state: dict) -> None:
        super().load_state_dict(state)
        self.d_l, self.costs, self._single_share = state["d_l"], state["costs"], state["alone"]
        self.finished = {
            number: IndexedLevel.of(Gaussians(**tensors)) for number, tensors in state["finished"].items()
        }
        self._blocks = None
        if blocks := state["blocks"]:
            bounds = (blocks[name].numpy() for name in ("low", "high", "reach"))
            self._blocks = BlockIndex.from_bounds(blocks["count"], *bounds)
        self._use_chunks(state["centres"].numpy(), state["radii"].numpy())
        self.sets = {
            number: [
                members.astype(bool)
                for members in np.unpackbits(bits.numpy(), axis=1, count=len(self.finished[number]))
            ]
            for number, bits in state["sets"].items()
        }

"""LODGE (2025): levels, finest first, each a copy of the finest for a distance; then chunks.

A level is smoothed as its distance allows, pruned of what hardly shows, and tuned beside the finer ones,
which stay as they are (Sec. 3, A.2). The finest is a base, or 3DGS in the first steps. The last steps make
the sets of chunks, one a step.
"""

from __future__ import annotations

import numpy as np
import torch

from ...errors import LodgsError
from ...lod.blocks import Blocks, block_quantiles, spatial_order
from ...lod.partial_read import BLOCKS, block_table
from ...lod.rules.chunks import RULE, TABLE, member_columns
from ...optimize.density_control import require_rows
from ...optimize.method import Drawing, StepResult
from ...optimize.model import NAMES
from ...optimize.pruning import importance_threshold, log_scale_gain
from ...optimize.training_data import TrainingView
from ...rasterize import Gaussians, photometric_loss
from ...scenes.cameras import pick_evenly
from ...splats.gaussians import Splats
from ...splats.levels import Level
from ...splats.ply import Columns
from ..threedgs.refining import Refining
from . import ROUNDS, LodgeParameters, chunks
from .composite import (
    IndexedLevel,
    Stack,
    filtered,
    rows_seen,
    seen_from_afar,
    together,
)  # fmt: skip
from .thresholds import MOST_CURVES, STANDING_APART, Thresholds

VIEWS_COUNTED = 24
"""In so many training views it is counted what they draw."""
FAR_VIEWS = 2
"""A place that so many training views have from a level's distance or farther is tuned and pruned by them."""


class Method(Refining):
    """One run of LODGE.

    Attributes:
        d_l: the distance from which on each level is shown, in scene units, by number; those known so far.
        finished: the levels that no step changes any more, as they are drawn, by number, finest first.
        costs: what finding the distances has told, see ``Thresholds``.
        centres, radii: of the chunks, (K, 3) and (K,) float32, as soon as their number is known.
        sets: which splats of each level (N,) are in the set of each of the chunks so far, by number.
    """

    parameters: LodgeParameters

    def setup(self, base: Splats | None) -> None:
        p = self.parameters
        if base is not None and p.levels == 1:
            raise LodgsError("A base is the one level itself: there is nothing to train.", "Give levels = 2.")
        super().setup(base)
        self.d_l = {p.levels: 0.0}
        self.finished: dict[int, IndexedLevel] = {}
        self.costs: list[dict] = []
        self.centres, self.radii = np.zeros((0, 3), np.float32), np.zeros(0, np.float32)
        self.sets: dict[int, list[np.ndarray]] = {}
        self._blocks: Blocks | None = None  # of the level in training, as it was at its last pruning
        self._alone_share = p.tune_alone

    @property
    def steps(self) -> int:
        return self.tuned_steps + len(self.centres)

    @property
    def tuned_steps(self) -> int:
        """So many steps come before the chunks."""
        return self.finest_steps + self.parameters.base_steps

    @property
    def levels(self) -> int:
        return self.parameters.levels

    def level_at(self, step: int) -> int:
        if step < self.finest_steps:
            return self.levels
        return (
            self.levels - 1 - min((step - self.finest_steps) // self.parameters.level_steps, self.levels - 2)
        )

    def ends_level(self, step: int) -> bool:
        done = step + 1
        if done > self.tuned_steps:
            return done == self.steps
        return done == self.finest_steps or (done > self.finest_steps and self._local(done) == 0)

    def stage(self, step: int) -> str:
        if step < self.tuned_steps:
            return super().stage(step)
        return f"chunk {step - self.tuned_steps + 1} of {len(self.centres)}"

    def levels_after(self, step: int) -> list[Level]:
        """The finest as soon as it is there, each coarser one when it is tuned; all with the last chunk."""
        done, found = step + 1, []
        if done > self.tuned_steps:
            return [self._level(number) for number in sorted(self.finished)] if done == self.steps else []
        if done == max(self.finest_steps, 1):
            self._finish(self.levels)
            found.append(self._level(self.levels))
        if step >= self.finest_steps and self._local(done) == 0:
            found.insert(0, self._level(self.level_at(step)))
        return found

    def tables(self) -> dict[str, Columns]:
        """The chunks, where there are any, and which blocks of rows have splats of them."""
        if not len(self.centres):
            return {}
        x, y, z = self.centres.T
        splats = {number: self._level(number).splats for number in sorted(self.sets)}
        return {
            TABLE: {"x": x, "y": y, "z": z, "radius": self.radii},
            BLOCKS: block_table(RULE, splats),
        }

    def meta(self) -> dict:
        found = {"costs": self.costs} if self.levels <= MOST_CURVES else {}
        return {**super().meta(), "filter_variance": self.parameters.filter_variance, **found}

    # -- a step ----------------------------------------------------------------------------------------

    def shrink(self, step: int) -> float:
        alone = self.refines(step) and self._alone(step)
        return self._farther(self.level_at(step)) if alone else super().shrink(step)

    def choose_view(self, step: int) -> TrainingView:
        if step >= self.finest_steps and self._local(step) % self.parameters.tune_steps == 0:
            self.begin_round(step)
        return super().choose_view(step)

    def planned_view(self, step: int) -> tuple[int, float] | None:
        return super().planned_view(step) if step < self.tuned_steps else None

    def train_step(self, step: int) -> StepResult:
        return super().train_step(step) if step < self.tuned_steps else self._chunk_step(step)

    def draw(self, view: TrainingView, step: int) -> list[Drawing]:
        if step < self.finest_steps:
            return super().draw(view, step)
        number, near = self.level_at(step), self.data.near
        level = IndexedLevel.of(self.model.gaussians, self._blocks)
        if self._alone(step):
            rows = {number: level.in_view(view.camera, near)}
        else:
            rng, spread = np.random.default_rng([self.seed, step, 8]), self.parameters.tune_range
            scale = 1 / rng.uniform(1 - spread, 1 + spread)
            rows = rows_seen({**self.finished, number: level}, self.d_l, view.camera, near, scale)
        own = torch.from_numpy(rows[number]).long().to(self.device)
        shown = [filtered(self.take_rows(own), self._std(self.d_l[number]))]
        if len(rows) > 1:
            shown.insert(0, together(self.finished, {n: some for n, some in rows.items() if n != number}))
        drawn = self.rasterize_model(view.camera, step, gaussians=Gaussians.concatenated(shown))
        return [Drawing(drawn)]

    def background(self, step: int) -> tuple[float, float, float]:
        """Black for the coarser levels, which the finest covers for: what is nothing may be black."""
        return super().background(step) if step < self.finest_steps else (0.0, 0.0, 0.0)

    # -- levels ----------------------------------------------------------------------------------------

    def begin_round(self, step: int) -> None:
        """Before a step: what hardly shows leaves the level; a new level begins as a copy of the finest."""
        p, number, local = self.parameters, self.level_at(step), self._local(step)
        if local == 0:
            self._begin_level(number)
        found, before = self.importance(number), (0.0, *ROUNDS)[local // p.tune_steps]
        part = ROUNDS[local // p.tune_steps]
        # of what stands together, so that the rounds come to the level's share of the finest one's splats
        share = p.keep ** ((self.levels - number) * (part - before))
        least = torch.from_numpy(block_quantiles(found.numpy(), 1 - share))
        weight = max(p.prune_weight * part, self._affordable(number, found, part))
        thinned = least > weight
        kept = found >= least.clamp_min(weight)
        with torch.no_grad():
            wider = log_scale_gain(self.model["log_scales"].cpu().numpy(), found.numpy(), kept.numpy())
            self.model["log_scales"].add_((torch.from_numpy(wider) * thinned).to(self.device)[:, None])
        self.model.keep(kept)
        require_rows(self.model, step, "prune_weight")
        self._blocks = self._smoothed(number).blocks

    def _affordable(self, number: int, importance: torch.Tensor, part: float) -> float:
        """The least importance of those splats of a level that come to what the views may draw (``drawn``).

        A share ``part`` of the way from all of them; at least a quarter of those that the views would draw.
        """
        share = 1 - (1 - self.parameters.drawn) * part
        if share == 1:
            return 0.0
        level, near = self._smoothed(number), self.data.near
        levels = {**self.finished, number: level}
        views, finest, others = np.zeros(len(level), np.int64), 0, 0
        for camera in pick_evenly(self.data.train, VIEWS_COUNTED):
            alone = self.finished[self.levels]
            finest += camera.sees(alone.means[alone.in_view(camera, near)], near).sum()
            for each, rows in rows_seen(levels, self.d_l, camera, near).items():
                seen = camera.sees(levels[each].means[rows], near)
                if each == number:
                    views[rows[seen]] += 1
                else:
                    others += seen.sum()
        most = max(share * finest - others, views.sum() / 4)
        return importance_threshold(importance.numpy(), views, most)

    def _most_distance(self, number: int) -> float:
        """The largest distance, in scene units, that leaves room for further levels before the next coarser
        one that was given a distance."""
        coarser = self.parameters.distances[number - 1 :: -1]
        steps = next((steps for steps, distance in enumerate(coarser) if distance), None)
        if steps is None:
            return np.inf
        end, begin = coarser[steps] * self.data.median_depth, max(self.d_l.values())
        return max(end / STANDING_APART**steps, (begin * end) ** 0.5)

    def _begin_level(self, number: int) -> None:
        p, data = self.parameters, self.data
        self._finish(number + 1)
        finest = self.finished[self.levels]
        given = p.distances[number - 1] * data.median_depth
        if given:
            self.d_l[number] = given
        else:
            thresholds = Thresholds(
                data.train, data.near, self.backend, p.prune_weight, self._std, p.antialias
            )
            most = self._most_distance(number)
            self.d_l[number], costs = thresholds.next(self.finished, self.d_l, most)
            self.costs.append({"level": number, **costs})
        if number == self.levels - 1:
            self._place_chunks()
        known = seen_from_afar(finest, data.train, data.near, self.d_l[number], FAR_VIEWS)
        self._alone_share = p.tune_alone * float((~known).mean())
        tensors = {name: getattr(finest.gaussians, name).clone() for name in NAMES}
        self.model = self.new_model(tensors)

    def _finish(self, number: int) -> None:
        """The level in training is what it is from now on."""
        if number in self.finished:
            return
        level = self._smoothed(number)
        if number == self.levels and self.finest_steps:
            order = torch.from_numpy(spatial_order(level.means))
            level = IndexedLevel.of(level.gaussians.select(order))
        self.finished[number] = level

    @torch.no_grad()
    def _smoothed(self, number: int) -> IndexedLevel:
        """The model as a level: with the filter of its distance (Eq. 3), which no step can undo."""
        gaussians, d_l = self.model.gaussians.detach(), self.d_l[number]
        return IndexedLevel.of(filtered(gaussians, self._std(d_l)) if d_l else gaussians)

    @torch.no_grad()
    def importance(self, number: int) -> torch.Tensor:
        """The largest share (N,) of a pixel that each splat of the level in training has.

        In the training views, beside the finer levels. Those of its splats that too few training views see
        from its distance are also asked for in views from as far away, of the level alone, which see what
        continues the photographs, too.
        """
        data, backend = self.data, self.backend
        level, farther, near = self._smoothed(number), self._farther(number), data.near
        levels = {**self.finished, number: level}
        stack = Stack(levels, self.parameters.antialias)
        beside = ((camera, rows_seen(levels, self.d_l, camera, near)) for camera in data.train)
        found = stack.importance(beside, near, backend)[stack.part[number]]
        if not self.parameters.tune_alone:
            return found
        known = seen_from_afar(level, data.train, near, self.d_l[number], FAR_VIEWS)
        if known.all():
            return found
        views = (camera.widened(self.parameters.margin).scaled(1 / farther) for camera in data.train)
        away = ((view, {number: level.in_view(view, near)}) for view in views)
        alone = Stack({number: level}, self.parameters.antialias).importance(away, near, backend)
        return torch.where(torch.from_numpy(known), found, torch.maximum(found, alone))

    # -- chunks ----------------------------------------------------------------------------------------

    def _place_chunks(self) -> None:
        """Where chunks are, as soon as it is known where the finest level ends (Eq. 5)."""
        centers = np.array([camera.center for camera in self.data.train])
        wanted = self.parameters.chunks or chunks.chunk_count(centers, self.d_l[self.levels - 1])
        if wanted >= (2 if self.parameters.chunks else chunks.FEWEST):
            self.centres, self.radii = chunks.place_chunks(centers, wanted, self.seed)

    @torch.no_grad()
    def _chunk_step(self, step: int) -> StepResult:
        """One chunk's set; what is told of the step is how a photograph in it looks by the set alone."""
        p, data, number = self.parameters, self.data, step - self.tuned_steps
        if number == 0:
            self._finish(1)
        levels, centre, radius = self.finished, self.centres[number], float(self.radii[number])
        rows = chunks.members(levels, self.d_l, centre, radius)
        near = chunks.cameras_near(data.train, self.centres, number)
        if p.visible_weight:
            rng = np.random.default_rng([self.seed, number, 11])
            views = [*near, *chunks.turned(near, rng)]
            rows = chunks.visible(levels, rows, views, p.visible_weight, data.near, self.backend, p.antialias)
        for level, some in rows.items():
            members = np.zeros(len(levels[level]), bool)
            members[some] = True
            self.sets.setdefault(level, []).append(members)
        nearest = min(near or data.train, key=lambda camera: np.linalg.norm(camera.center - centre))
        view = data.view(data.train.index(nearest))
        drawn = self.rasterize_model(view.camera, step, gaussians=together(levels, rows))
        loss = photometric_loss(drawn.image, view.target, p.ssim_weight, backend=self.backend)
        return StepResult(float(loss), lambda: drawn.image, view.target)

    # -- levels ----------------------------------------------------------------------------------------

    def _level(self, number: int) -> Level:
        level = self.finished[number] if number in self.finished else self._smoothed(number)
        splats = Splats(*(tensor.cpu().numpy().copy() for tensor in vars(level.gaussians).values()))
        if number in self.sets:
            splats.extras = member_columns(np.stack(self.sets[number]))
        return Level(number, splats, {"d_l": self.d_l[number]})

    def _local(self, step: int) -> int:
        """Steps that the level in training has seen before a step."""
        return (step - self.finest_steps) % self.parameters.level_steps

    def _std(self, distance: float) -> float:
        """The filter's standard deviation for a distance, in scene units (Eq. 3, as Mip-Splatting has it)."""
        return self.parameters.filter_variance**0.5 * distance / self.data.focal

    def _farther(self, number: int) -> float:
        """How many times farther away than the median depth a level begins; at least 1."""
        return max(self.d_l.get(number, 0.0) / self.data.median_depth, 1.0)

    def _alone(self, step: int) -> bool:
        draw = np.random.default_rng([self.seed, step, 9]).random()
        return draw < self._alone_share

    # -- what lasts ------------------------------------------------------------------------------------

    def state_dict(self) -> dict:
        finished = {number: dict(vars(level.gaussians)) for number, level in self.finished.items()}
        blocks = self._blocks
        return {
            **super().state_dict(),
            "d_l": self.d_l, "finished": finished, "costs": self.costs, "alone": self._alone_share,
            "blocks": {} if blocks is None else {
                "count": blocks.count, "low": torch.from_numpy(blocks.low),
                "high": torch.from_numpy(blocks.high), "reach": torch.from_numpy(blocks.reach),
            },
            "centres": torch.from_numpy(self.centres), "radii": torch.from_numpy(self.radii),
            "sets": {
                number: torch.from_numpy(np.packbits(np.stack(sets), axis=1))
                for number, sets in self.sets.items()
            },
        }  # fmt: skip

    def load_state_dict(self, state: dict) -> None:
        super().load_state_dict(state)
        self.d_l, self.costs, self._alone_share = state["d_l"], state["costs"], state["alone"]
        self.finished = {
            number: IndexedLevel.of(Gaussians(**tensors)) for number, tensors in state["finished"].items()
        }
        self._blocks = None
        if blocks := state["blocks"]:
            self._blocks = Blocks(blocks["count"], *(blocks[n].numpy() for n in ("low", "high", "reach")))
        self.centres, self.radii = state["centres"].numpy(), state["radii"].numpy()
        self.sets = {
            number: [
                one.astype(bool)
                for one in np.unpackbits(bits.numpy(), axis=1, count=len(self.finished[number]))
            ]
            for number, bits in state["sets"].items()
        }

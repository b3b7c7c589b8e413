"""State of a viewport between redraws, and the upload of its splats in small steps.

The worker thread computes arrangements (``arrangement``). Their splats are uploaded over several redraws, so
that no redraw takes long. The previous arrangement stays visible until all splats of the new one are
uploaded. Without a previous one, the uploaded part is drawn.
"""

from __future__ import annotations

import time
import weakref
from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field

import gpu
import numpy as np
from mathutils import Matrix

from . import resident, splats
from .arrangement import Arrangement, Request
from .resident import Cloud, Resident, Store

LOADING = 0.01, 0.02
"""Minimum and maximum seconds a redraw spends on uploads. A started batch is completed; fast redraws stay
below 0.05 seconds."""
SLOW, SLOW_FACTOR = 0.08, 5.0
"""Seconds between redraws from which they spend more on uploads, as with software rendering, and at most this
factor more."""
FLUENT = 1 / 30
"""Seconds to draw the splats of a view up to which it keeps its resolution in motion."""
SMOOTH = 0.2
"""Seconds per redraw above which a smaller budget is suggested, and a moving view is simplified."""
MOTION = 0.08
"""Seconds to draw the splats of a simplified view; Blender needs the rest of SMOOTH."""
MIN_MOTION = 50_000
"""Smallest number of splats of a simplified view."""
COST_CHANGE = 0.1
"""Relative change of the number of splats from which a view is measured again."""
SLOWER = 1.25
"""Maximum factor between two measurements of a view."""
COST_AGE = 3.0
"""Seconds after which a view is measured again."""
MIN_BUDGET = 10_000
"""Smallest suggested budget."""
GROWTH = 1.5
"""Factor of uploaded splats at which an incomplete arrangement is listed again."""


@dataclass(eq=False)
class ViewState:
    """State of one viewport.

    Attributes:
        resident, arrangement: splats and arrangement that are drawn, perhaps in part.
        store: store with the drawn splats.
        instances, count: list of drawn splats on the graphics card.
        uploaded: number of uploaded splats of the arrangement.
        pending: arrangement that is being computed, with its splats and request.
        loading: arrangement whose splats are being uploaded.
        missing: its splats (M,) that are not uploaded yet, with their store.
        loaded: time of the last upload.
        matrix: world to clip space at the last redraw.
        moved: time of the last movement.
        moving: the view moves.
        arrived: number of updates of streams that the last requested arrangement contains.
        resolution: resolution of the splats relative to the viewport.
        marks: drawn marks, see ``resident.Resident``.
        shows_marks: draw selected splats and previewed clutter in their colours.
        cost: number of drawn splats and seconds to draw them, measured at rest.
        motion_cost: the same while the view moves; zeros before the first motion.
        measured: time of the last of these measurements.
        stated: values that header and panel state, see ``views.reduced_counts``, :func:`suggest_budget` and
            :func:`simplified_counts`.
    """

    canvas: splats.Canvas = field(default_factory=splats.Canvas)
    resident: Resident | None = None
    arrangement: Arrangement | None = None
    store: Store | None = None
    instances: gpu.types.GPUTexture | None = None
    count: int = 0
    uploaded: int = 0
    pending: tuple[Resident, Request, Future[Arrangement]] | None = None
    loading: Arrangement | None = None
    missing: tuple[Store, np.ndarray] | None = None
    loaded: float = 0.0
    matrix: Matrix | None = None
    moved: float = 0.0
    moving: bool = False
    arrived: int = 0
    resolution: float = 1.0
    marks: np.ndarray | None = None
    shows_marks: bool = False
    cost: tuple[int, float] = (0, 0.0)
    motion_cost: tuple[int, float] = (0, 0.0)
    measured: float = 0.0
    stated: tuple | None = None
    _lists: dict[bool, tuple[gpu.types.GPUTexture, int]] = field(default_factory=dict)

    def is_cost_outdated(self) -> bool:
        """Return True if the view should be measured, which waits for the graphics card."""
        if not self.moving and self.arrangement is not None and self.arrangement.request.moving:
            return False  # a resting view will draw all splats soon
        count = (self.motion_cost if self.moving else self.cost)[0]
        has_changed = abs(self.count - count) > COST_CHANGE * count
        return has_changed or time.monotonic() > self.measured + COST_AGE

    def set_cost(self, seconds: float) -> None:
        """Store the time to draw the current list. Slow redraws of a busy computer count little by little."""
        self.measured = time.monotonic()
        count, previous = self.motion_cost if self.moving else self.cost
        if count:
            seconds = min(seconds, SLOWER * previous * max(self.count / count, 1.0))
        if self.moving:
            self.motion_cost = self.count, seconds
        else:
            self.cost = self.count, seconds

    def motion_resolution(self, lowered: float) -> float:
        """Return the lowered resolution if the view moves and is slow, else 1: fast views do not change."""
        slow = max(self.cost[1], self.motion_cost[1]) > FLUENT
        return lowered if self.moving and slow else 1.0

    def motion_limit(self) -> int | None:
        """Return the number of splats that this computer draws smoothly in motion; None if it draws all."""
        count, seconds = self.motion_cost if self.motion_cost[0] else self.cost
        if self.arrangement is None or not seconds:
            return None
        limit = int(float(f"{count * MOTION / seconds:.1g}"))
        return max(limit, MIN_MOTION) if limit < self.arrangement.count else None

    def reset(self) -> None:
        """Stop drawing."""
        self.resident = self.arrangement = self.store = self.instances = None
        self.pending = self.loading = self.missing = None

    def uses(self, source: Resident) -> bool:
        """Return True while splats of a source are uploaded or arranged, so that they must not change."""
        uploading = self.loading is not None and self.loading.serial == source.pool.serial
        return uploading or (self.pending is not None and self.pending[0] is source)

    def used_splats(self, source: Resident) -> list[np.ndarray]:
        """Return the drawn splats (M,) of a source, and those that are being uploaded."""
        drawn = self.arrangement if self.resident is source else None
        arrangements = drawn, self.loading if self.loading is not drawn else None
        return [arrangement.splats for arrangement in arrangements if arrangement is not None]

    def accept(self, source: Resident, arrangement: Arrangement) -> None:
        """Start to load a computed arrangement, unless its splats have been replaced since."""
        while source.pool.changed:
            changed = source.pool.changed.pop()
            if source.store is not None:
                source.store.invalidate(changed)
        if arrangement.serial == source.pool.serial:
            self.loading = arrangement
            self.missing = None

    def load(self, source: Resident, clouds: Sequence[Cloud | None], wait: bool) -> None:
        """Upload splats of the arrangement that is being loaded, and draw it once all are uploaded.

        Args:
            wait: upload all of them.
        """
        now = time.monotonic()
        idle = self.loading is None and not any(view.pending for view in active_views)
        if idle and self.resident is source and self.store is not source.store:
            self.loading = self.arrangement  # another viewport has replaced the store
        loading = self.loading
        if loading is None or loading.serial != source.pool.serial:
            self.loading = None
            return
        if self._has_splats_of(source, loading):
            self._show(source, loading, source.store, loading.splats[:0])
            return
        store, missing = self.missing or (None, None)
        started = store is not None and store is source.store
        if started:  # another viewport may have uploaded some of them; second slots would exceed the store
            missing = missing[store.slots[missing] < 0]
        else:
            store = source.reserve([rows for view in active_views for rows in view.used_splats(source)])
            missing = store.missing(loading.splats)
        # slow redraws load more, so that loading keeps its speed
        interval = now - self.loaded if started else 0
        longest = LOADING[1] * min(max(interval / SLOW, 1.0), SLOW_FACTOR)
        end = now + min(max(interval, LOADING[0]), longest)
        self.loaded = now
        begin = 0
        is_drawn = started and self._show(source, loading, store, missing)  # uploads of earlier redraws
        while begin < len(missing) and (
            wait or (started and not is_drawn and not begin) or time.monotonic() < end
        ):
            batch = missing[begin : begin + resident.UPLOAD_BATCH]
            batch = batch[: source.count_in_first_cloud(batch)]
            records = source.read(clouds, batch)
            if records is None:  # the cloud has changed: request a new arrangement
                self.loading = self.arrangement = self.missing = None
                return
            store.insert(batch, records)
            begin += len(batch)
        missing = missing[begin:]
        self.missing = store, missing
        if wait or (not is_drawn and not len(missing) and time.monotonic() < end):
            self._show(source, loading, store, missing)

    def _has_splats_of(self, source: Resident, loading: Arrangement) -> bool:
        """Return True if an arrangement has the drawn splats in another order, and all are uploaded."""
        drawn = self.arrangement
        return (
            drawn is not None
            and drawn.splats is loading.splats
            and drawn.serial == loading.serial
            and self.store is source.store
            and self.uploaded == len(drawn.splats)
        )

    def _show(self, source: Resident, loading: Arrangement, store: Store, missing: np.ndarray) -> bool:
        """Draw an arrangement if its splats are uploaded.

        If nothing else can be drawn, draw the uploaded part, as soon as it has grown enough.

        Args:
            missing: splats (M,) that are not uploaded yet.

        Returns:
            True if the arrangement is drawn from now on.
        """
        in_part = self.arrangement is loading and self.store is store
        uploaded = len(loading.splats) - len(missing)
        has_grown = in_part and uploaded > GROWTH * self.uploaded
        if len(missing) and not has_grown and self.arrangement is not None:
            return False
        self.resident = source
        self.arrangement = loading
        self.store = store
        self.uploaded = uploaded
        self.list_instances()
        drawn = [view.arrangement for view in active_views if view.store is store and view.arrangement]
        if all(arrangement.serial == loading.serial for arrangement in drawn):
            store.release()
        if not len(missing):
            self.loading = self.missing = None
        return True

    def list_instances(self) -> None:
        """Upload the list of drawn splats again."""
        self._lists.clear()
        self.marks = self.displayed_marks()
        self.choose_list()

    def choose_list(self) -> None:
        """Choose the list for the moving or resting view; upload it if needed."""
        assert self.arrangement is not None and self.store is not None
        simplified = self.arrangement.motion if self.moving else None
        key = simplified is not None
        if key not in self._lists:
            table = self.arrangement.instances if simplified is None else simplified
            self._lists[key] = splats.instances_texture(table, self.store.slots, self.marks)
        self.instances, self.count = self._lists[key]

    def displayed_marks(self) -> np.ndarray | None:
        """Return the marks to draw; None if they are hidden or there are none."""
        return self.resident.marks if self.resident is not None and self.shows_marks else None


active_views: weakref.WeakSet[ViewState] = weakref.WeakSet()
"""Views with splats in the store: viewports, and renders while they last."""


def suggest_budget() -> tuple[int, float, int] | None:
    """Return the splats and seconds of the slowest viewport at rest, and a budget for quick redraws.

    Returns:
        None if all viewports are fast enough.
    """
    costs = [view.cost for view in active_views]
    count, seconds = max(costs, key=lambda cost: cost[1], default=(0, 0.0))
    if seconds <= SMOOTH or count <= MIN_BUDGET:
        return None
    return count, seconds, max(int(float(f"{count * SMOOTH / seconds:.1g}")), MIN_BUDGET)


def simplified_counts() -> tuple[int, int] | None:
    """Return the splats in motion and at rest of the viewport that motion simplifies most; None if none.

    Those in motion are the requested number. The drawn number differs with each view, and stating it would
    redraw the panel as often.
    """
    counts = [
        (arrangement.request.motion[0], arrangement.count)
        for view in active_views
        if (arrangement := view.arrangement) is not None
        and arrangement.motion is not None
        and arrangement.request.motion is not None
    ]
    return min(counts, key=lambda pair: pair[0] / pair[1], default=None)

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
SMOOTH = 0.2
"""Seconds per redraw of a moving view above which a smaller budget is suggested."""
COST_CHANGE = 0.1
"""Relative change of the number of splats from which a view is measured again."""
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
        pending: arrangement that is being computed, with its splats and request.
        loading: arrangement whose splats are being uploaded.
        missing: its splats (M,) that are not uploaded yet, with their store.
        loaded: time of the last upload.
        matrix: world to clip space at the last redraw.
        moved: time of the last movement.
        arrived: number of updates of streams that the last requested arrangement contains.
        resolution: resolution of the splats relative to the viewport.
        marks: drawn marks, see ``resident.Resident``.
        shows_marks: draw selected splats and previewed clutter in their colours.
        cost: number of drawn splats and seconds to draw them, measured while the view moved.
        stated: values that header and panel state, see ``views.reduced_counts`` and :func:`suggest_budget`.
    """

    canvas: splats.Canvas = field(default_factory=splats.Canvas)
    resident: Resident | None = None
    arrangement: Arrangement | None = None
    store: Store | None = None
    instances: gpu.types.GPUTexture | None = None
    count: int = 0
    pending: tuple[Resident, Request, Future[Arrangement]] | None = None
    loading: Arrangement | None = None
    missing: tuple[Store, np.ndarray] | None = None
    loaded: float = 0.0
    matrix: Matrix | None = None
    moved: float = 0.0
    arrived: int = 0
    resolution: float = 1.0
    marks: np.ndarray | None = None
    shows_marks: bool = False
    cost: tuple[int, float] | None = None
    stated: tuple[tuple[int, int] | None, tuple[int, float] | None] = (None, None)

    def is_cost_outdated(self) -> bool:
        """Return True if the view should be measured, which waits for the graphics card."""
        return self.cost is None or abs(self.count - self.cost[0]) > COST_CHANGE * self.cost[0]

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

    def _show(self, source: Resident, loading: Arrangement, store: Store, missing: np.ndarray) -> bool:
        """Draw an arrangement if its splats are uploaded.

        If nothing else can be drawn, draw the uploaded part, as soon as it has grown enough.

        Args:
            missing: splats (M,) that are not uploaded yet.

        Returns:
            True if the arrangement is drawn from now on.
        """
        in_part = self.arrangement is loading and self.store is store
        has_grown = in_part and len(loading.splats) - len(missing) > GROWTH * self.count
        if len(missing) and not has_grown and self.arrangement is not None:
            return False
        self.resident = source
        self.arrangement = loading
        self.store = store
        self.list_instances()
        drawn = [view.arrangement for view in active_views if view.store is store and view.arrangement]
        if all(arrangement.serial == loading.serial for arrangement in drawn):
            store.release()
        if not len(missing):
            self.loading = self.missing = None
        return True

    def list_instances(self) -> None:
        """Upload the list of drawn splats."""
        assert self.arrangement is not None and self.store is not None
        self.marks = self.displayed_marks()
        self.instances, self.count = splats.instances_texture(self.arrangement, self.store.slots, self.marks)

    def displayed_marks(self) -> np.ndarray | None:
        """Return the marks to draw; None if they are hidden or there are none."""
        return self.resident.marks if self.resident is not None and self.shows_marks else None


active_views: weakref.WeakSet[ViewState] = weakref.WeakSet()
"""Views with splats in the store: viewports, and renders while they last."""


def suggest_budget() -> tuple[int, float, int] | None:
    """Return the splats and seconds of the slowest viewport while it moves, and a budget for smooth motion.

    Returns:
        None if all viewports are fast enough.
    """
    costs = [view.cost for view in active_views if view.cost]
    count, seconds = max(costs, key=lambda cost: cost[1], default=(0, 0.0))
    if seconds <= SMOOTH or count <= MIN_BUDGET:
        return None
    return count, seconds, max(int(float(f"{count * SMOOTH / seconds:.1g}")), MIN_BUDGET)

"""Splats on a device, projected and binned for a view: what pictures, gradients and weights are made from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..rendering import Settings, View
from .bin import TILE, Pairs, bin_splats, groups_of
from .device import Buffer, Device

ROW = 12
"""Numbers of a projected splat (``Row`` in common.wgsl)."""
SPLAT, BY_SPLAT = 13, 16
"""Numbers of a splat on the device, and of its gradient (project.wgsl)."""
SUMS, PAIR_SUMS = 8, 11
"""Numbers that blending's backward pass sums up for a splat, and for a pair (common.wgsl)."""
GEOMETRY = 6
"""Those of a splat without the absolute gradients, in which features have no part."""
TILES = 1024
"""That a device blends at a time, so that it gets to other work in between."""


@dataclass
class Scene:
    """M splats as a view sees them.

    Attributes:
        count: M.
        lens: what project.wgsl knows of the view.
        splats, sh: (M, SPLAT) and (M, coefficients, 3).
        rows, colours, radii: (M, ROW), (M, 4) and (M,), projected.
        pairs: with the tiles that they touch.
    """

    device: Device
    view: View
    count: int
    lens: tuple
    splats: Buffer
    sh: Buffer
    rows: Buffer
    colours: Buffer
    radii: Buffer
    pairs: Pairs

    @classmethod
    def of(cls, device: Device, splats: Buffer, sh: Buffer, settings: Settings) -> Scene:
        """Projects and bins; LodgsError where the device was lost, or has too little memory."""
        view, count = settings.view, splats.shape[0]
        lens = (_lens_of(view), settings.min_scale, count, settings.degree, sh.shape[1])
        rows, colours = device.empty(np.float32, count, ROW), device.empty(np.float32, count, 4)
        depths, radii = device.empty(np.uint32, count), device.empty(np.float32, count)
        device.run(
            "project", "forward", groups_of(count), lens, splats=splats, sh=sh, rows=rows, colours=colours,
            depths=depths, radii=radii,
        )  # fmt: skip
        pairs = bin_splats(device, rows, depths, view.width, view.height)
        return cls(device, view, count, lens, splats, sh, rows, colours, radii, pairs)

    @property
    def tiles(self) -> int:
        """How many the image has."""
        return self.pairs.ranges.shape[0]

    def blend(
        self,
        entry: str,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        limited: bool = False,
        absolute: bool = False,
        **buffers: Buffer,
    ) -> None:
        """Record a function of blend.wgsl for every tile."""
        size = self.view.width, self.view.height, -(-self.view.width // TILE)
        numbers = (*background, 0.0, *size, int(limited), int(absolute))
        rows, owners = self.rows, self.pairs.owners
        self.device.run("blend", entry, self.tiles, numbers, TILES, rows=rows, owners=owners, **buffers)

    def gather(self, columns: int, pair_sums: Buffer, sums: Buffer, by_colours: Buffer) -> None:
        """Record that pairs' sums are added up for each splat, of so many columns of them."""
        self.device.run(
            "gather", "gradients", groups_of(self.count), (self.count, columns), spans=self.pairs.spans,
            pair_sums=pair_sums, sums=sums, by_colours=by_colours,
        )  # fmt: skip

    def backward(self, sums: Buffer, by_colours: Buffer, by_splats: Buffer, by_sh: Buffer) -> None:
        """Record how what :meth:`gather` has found reaches splats that were drawn: these rows are written."""
        self.device.run(
            "project", "backward", groups_of(self.count), self.lens, splats=self.splats, sh=self.sh,
            projected=self.rows, seen_colours=self.colours, sums=sums, by_colours=by_colours,
            by_splats=by_splats, by_sh=by_sh,
        )  # fmt: skip


def _lens_of(view: View) -> np.ndarray:
    """The view as project.wgsl takes it, as far as ``near``."""
    pose = np.column_stack([view.rotation, view.translation])
    limits = np.array([view.x_limits, view.y_limits]).T
    numbers = 0, view.fx, view.fy, view.cx, view.cy, *limits.flat, view.width, view.height, view.near
    return np.concatenate([pose.flat, view.eye, numbers], dtype=np.float32)

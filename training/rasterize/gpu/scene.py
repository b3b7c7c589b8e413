"""Splats on a device, projected and binned for a view: what pictures, gradients and weights are made from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..rendering import KernelCamera, RasterSettings
from .bin import TILE, Band, bin_splats, groups_of
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

BLACK = 0.0, 0.0, 0.0
"""The background where none is meant."""


@dataclass
class Scene:
    """M splats as a view sees them.

    Attributes:
        count: M.
        lens, degree: what project.wgsl knows of the view, and of harmonics.
        splats, sh: (M, SPLAT) and (M, coefficients, 3).
        rows, colours, radii: (M, ROW), (M, 4) and (M,), projected.
        bands: with the tiles that they touch; no more than a device takes gradients of at a time.
        ranges: (tiles, 2) where the pairs of each tile begin and end in its band.
    """

    device: Device
    view: KernelCamera
    count: int
    lens: np.ndarray
    degree: int
    splats: Buffer
    sh: Buffer
    rows: Buffer
    colours: Buffer
    radii: Buffer
    bands: list[Band]
    ranges: Buffer

    @classmethod
    def of(cls, device: Device, splats: Buffer, sh: Buffer, settings: RasterSettings) -> Scene:
        """Projects and bins; LodgsError where the device was lost, or has too little memory."""
        view, count = settings.view, splats.shape[0]
        lens = np.append(_lens_of(view), np.float32(settings.min_scale))
        rows, colours = device.empty(np.float32, count, ROW), device.empty(np.float32, count, 4)
        depths, radii = device.empty(np.uint32, count), device.empty(np.float32, count)
        _project(
            device, "forward", lens, settings.degree, splats=splats, sh=sh, rows=rows, colours=colours,
            depths=depths, radii=radii,
        )  # fmt: skip
        most = device.most_bytes // (4 * PAIR_SUMS)
        bands, ranges = bin_splats(device, rows, depths, view.width, view.height, most)
        return cls(
            device, view, count, lens, settings.degree, splats, sh, rows, colours, radii, bands, ranges
        )

    def draw(
        self, background: tuple[float, float, float], limited: bool, colours: Buffer, **buffers: Buffer
    ) -> None:
        """Record ``forward`` of blend.wgsl."""
        for band in self.bands:
            self._blend("forward", band, background, limited, colours=colours, ranges=self.ranges, **buffers)

    def weigh(self) -> Buffer:
        """Record how much each splat shows, (M, 3): its largest weight, their sum, and how many pixels."""
        found = self.device.empty(np.float32, self.count, 3)
        for band in self.bands:
            shares = self.device.empty(np.float32, band.count, 3)
            self._blend(
                "weigh", band, ranges=self.ranges, sorted_pairs=band.sorted_pairs, pair_weights=shares
            )
            self.device.run(
                "gather", "contributions", groups_of(self.count), (self.count, 0), spans=band.spans,
                pair_weights=shares, weights=found,
            )  # fmt: skip
        return found

    def differentiate(
        self,
        columns: int,
        absolute: bool,
        sums: Buffer,
        by_colours: Buffer,
        walked: Buffer,
        **buffers: Buffer,
    ) -> None:
        """Record ``backward`` of blend.wgsl, and that sums get so many columns of what it finds for pairs."""
        for band in self.bands:
            pair_sums = self.device.empty(np.float32, band.count, PAIR_SUMS)
            self._blend(
                "backward", band, BLACK, False, absolute, ranges=walked, sorted_pairs=band.sorted_pairs,
                pair_sums=pair_sums, **buffers,
            )  # fmt: skip
            self.device.run(
                "gather", "gradients", groups_of(self.count), (self.count, columns), spans=band.spans,
                pair_sums=pair_sums, sums=sums, by_colours=by_colours,
            )  # fmt: skip

    def backward(self, sums: Buffer, by_colours: Buffer, by_splats: Buffer, by_sh: Buffer) -> None:
        """Record how sums of :meth:`differentiate` reach splats that were drawn: these rows are written."""
        _project(
            self.device, "backward", self.lens, self.degree, splats=self.splats, sh=self.sh,
            projected=self.rows, seen_colours=self.colours, sums=sums, by_colours=by_colours,
            by_splats=by_splats, by_sh=by_sh,
        )  # fmt: skip

    def _blend(
        self,
        entry: str,
        band: Band,
        background: tuple[float, float, float] = BLACK,
        limited: bool = False,
        absolute: bool = False,
        /,
        **buffers: Buffer,
    ) -> None:
        size = self.view.width, self.view.height, -(-self.view.width // TILE)
        numbers = (*background, 0.0, *size, int(limited), int(absolute))
        self.device.run(
            "blend", entry, len(band.tiles), numbers, TILES, band.tiles.start, rows=self.rows,
            owners=band.owners, **buffers,
        )  # fmt: skip


def _project(device: Device, entry: str, lens: np.ndarray, degree: int, **buffers: Buffer) -> None:
    """Record a function of project.wgsl, for all splats."""
    for part in device.parts(**buffers):
        count, terms, _ = part["sh"].shape
        device.run("project", entry, groups_of(count), (lens, count, degree, terms), **part)


def _lens_of(view: KernelCamera) -> np.ndarray:
    """The view as project.wgsl takes it, as far as ``near``."""
    pose = np.column_stack([view.rotation, view.translation])
    limits = np.array([view.x_limits, view.y_limits]).T
    numbers = 0, view.fx, view.fy, view.cx, view.cy, *limits.flat, view.width, view.height, view.near
    return np.concatenate([pose.flat, view.eye, numbers], dtype=np.float32)

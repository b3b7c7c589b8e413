"""Splats on a device, projected and binned for a view; the input of images, gradients and weights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..rendering import KernelCamera, RasterSettings
from .bin import TILE, Band, bin_splats, group_count
from .device import Buffer, Device

ROW = 12
"""Size of a projected splat (``Row`` in common.wgsl)."""
SPLAT, BY_SPLAT = 13, 16
"""Sizes of a splat and of its gradient on the device (project.wgsl)."""
SUMS, PAIR_SUMS = 8, 11
"""Numbers of sums per splat and per pair in blending's backward pass (common.wgsl)."""
GEOMETRY = 6
"""Number of sums per splat without absolute gradients, which exclude features."""
TILES = 1024
"""Tiles per dispatch, so that the device can do other work in between."""

Background = tuple[float, float, float] | np.ndarray
BLACK = 0.0, 0.0, 0.0
"""Background of passes without one."""


@dataclass
class ProjectedScene:
    """M splats, projected and binned for a view.

    Attributes:
        count: number of splats M.
        lens, degree: view and degree of the harmonics, as project.wgsl reads them.
        splats, sh: (M, SPLAT) and (M, coefficients, 3).
        rows, colours, radii: (M, ROW), (M, 4) and (M,), projected splats.
        bands: pairs of splats and tiles, in bands whose gradients fit into one buffer.
        ranges: (tiles, 2), range of each tile's pairs in its band.
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
    def of(
        cls,
        device: Device,
        splats: Buffer,
        sh: Buffer,
        settings: RasterSettings,
        capacity: int | None = None,
    ) -> ProjectedScene:
        """Project and bin splats; LodgsError if the device was lost or has too little memory.

        Args:
            capacity: see ``bin_splats``.
        """
        view = settings.view
        count = splats.shape[0]
        lens = lens_of(settings)
        rows, colours = device.scratch(np.float32, count, ROW), device.scratch(np.float32, count, 4)
        depths, radii = device.scratch(np.uint32, count), device.scratch(np.float32, count)
        _project(
            device, "forward", lens, settings.degree, splats=splats, sh=sh, rows=rows, colours=colours,
            depths=depths, radii=radii,
        )  # fmt: skip
        max_pairs = device.binding_bytes // (4 * PAIR_SUMS)
        bands, ranges = bin_splats(device, rows, depths, view.width, view.height, max_pairs, capacity)
        return cls(
            device, view, count, lens, settings.degree, splats, sh, rows, colours, radii, bands, ranges
        )

    def draw(self, background: Background, limited: bool, colours: Buffer, **buffers: Buffer) -> None:
        """Record the function ``forward`` of blend.wgsl."""
        for band in self.bands:
            self._blend("forward", band, background, limited, colours=colours, ranges=self.ranges, **buffers)

    def weigh(self) -> Buffer:
        """Record the weights of splats, (M, 3): largest weight, sum of weights, and number of pixels."""
        weights = self.device.empty(np.float32, self.count, 3)
        for band in self.bands:
            shares = self.device.empty(np.float32, band.count, 3)
            self._blend(
                "weigh", band, ranges=self.ranges, sorted_pairs=band.sorted_pairs, pair_weights=shares
            )
            self.device.run(
                "gather", "contributions", group_count(self.count), (self.count, 0), spans=band.spans,
                pair_weights=shares, weights=weights,
            )  # fmt: skip
        return weights

    def differentiate(
        self,
        columns: int,
        absolute: bool,
        sums: Buffer,
        by_colours: Buffer,
        visited: Buffer,
        **buffers: Buffer,
    ) -> None:
        """Record ``backward`` of blend.wgsl, and add ``columns`` columns of its pair sums to ``sums``."""
        for band in self.bands:
            pair_sums = self.device.empty(np.float32, band.count, PAIR_SUMS)
            self._blend(
                "backward", band, BLACK, False, absolute, ranges=visited, sorted_pairs=band.sorted_pairs,
                pair_sums=pair_sums, **buffers,
            )  # fmt: skip
            self.device.run(
                "gather", "gradients", group_count(self.count), (self.count, columns), spans=band.spans,
                pair_sums=pair_sums, sums=sums, by_colours=by_colours,
            )  # fmt: skip

    def backward(self, sums: Buffer, by_colours: Buffer, by_splats: Buffer, by_sh: Buffer) -> None:
        """Record the gradients of drawn splats from the sums of :meth:`differentiate`; other rows stay."""
        _project(
            self.device, "backward", self.lens, self.degree, splats=self.splats, sh=self.sh,
            projected=self.rows, projected_colours=self.colours, sums=sums, by_colours=by_colours,
            by_splats=by_splats, by_sh=by_sh,
        )  # fmt: skip

    def _blend(
        self,
        entry: str,
        band: Band,
        background: Background = BLACK,
        limited: bool = False,
        absolute: bool = False,
        /,
        **buffers: Buffer,
    ) -> None:
        size = self.view.width, self.view.height, -(-self.view.width // TILE)
        numbers = (np.asarray(background, np.float32), 0.0, *size, int(limited), int(absolute))
        self.device.run(
            "blend", entry, len(band.tiles), numbers, TILES, band.tiles.start, rows=self.rows,
            owners=band.owners, **buffers,
        )  # fmt: skip


def _project(device: Device, entry: str, lens: np.ndarray, degree: int, **buffers: Buffer) -> None:
    """Record a function of project.wgsl for all splats."""
    for part in device.parts(**buffers):
        count, terms, _ = part["sh"].shape
        device.run("project", entry, group_count(count), (lens, count, degree, terms), **part)


def lens_of(settings: RasterSettings) -> np.ndarray:
    """Convert a view to the first numbers of project.wgsl's uniform, up to ``min_scale``."""
    view = settings.view
    pose = np.column_stack([view.rotation, view.translation])
    limits = np.array([view.x_limits, view.y_limits]).T
    size = view.width, view.height
    numbers = 0, view.fx, view.fy, view.cx, view.cy, *limits.flat, *size, view.near, settings.min_scale
    return np.concatenate([pose.flat, view.position, numbers], dtype=np.float32)

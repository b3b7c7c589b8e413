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
PAIR_SUMS = 11
"""Sums per splat and per pair in blending's backward pass (common.wgsl)."""
TRAINING_NUMBERS = 180
"""Size of the end of project.wgsl's uniform: Adam's constants, two numbers of the step, and the rates."""
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
    colors: Buffer
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
        lens = lens_of(view, settings.min_scale)
        rows, colors = device.scratch(np.float32, count, ROW), device.scratch(np.float32, count, 4)
        depths, order = device.scratch(np.uint32, count), device.scratch(np.uint32, count)
        radii = device.scratch(np.float32, count)
        _project(
            device, "forward", lens, settings.degree, splats=splats, sh=sh, rows=rows, colors=colors,
            depths=depths, radii=radii, order=order,
        )  # fmt: skip
        max_pairs = device.binding_bytes // (4 * PAIR_SUMS)
        bands, ranges = bin_splats(device, rows, depths, order, view.width, view.height, max_pairs, capacity)
        return cls(device, view, count, lens, settings.degree, splats, sh, rows, colors, radii, bands, ranges)

    def draw(self, background: Background, limited: bool, colors: Buffer, **buffers: Buffer) -> None:
        """Record the function ``forward`` of blend.wgsl."""
        for band in self.bands:
            self._blend("forward", band, background, limited, colors=colors, ranges=self.ranges, **buffers)

    def weigh(self) -> Buffer:
        """Record the weights of splats, (M, 3): largest weight, sum of weights, and number of pixels."""
        weights = self.device.empty(np.float32, self.count, 3)
        for band in self.bands:
            shares = self.device.empty(np.float32, band.count, 3)
            self._blend("weigh", band, ranges=self.ranges, pair_weights=shares)
            self.device.run(
                "gather", "contributions", group_count(self.count), (self.count, 0), spans=band.spans,
                pair_weights=shares, weights=weights,
            )  # fmt: skip
        return weights

    def differentiate(
        self,
        sums: Buffer,
        visited: Buffer,
        absolute: bool = False,
        by_features: Buffer | None = None,
        **buffers: Buffer,
    ) -> None:
        """Record ``backward`` of blend.wgsl, and write its sums per splat to ``sums`` (M, PAIR_SUMS).

        Args:
            by_features: (M, 3), takes the gradient by colour of a pass that blends features. Its other sums
                are added to ``sums``.
        """
        entry, targets = "gradients", {"sums": sums}
        if by_features is not None:
            entry, targets = "feature_gradients", targets | {"by_features": by_features}
        for k, band in enumerate(self.bands):
            adds = k > 0 or by_features is not None
            pair_sums = self.device.scratch(np.float32, band.count, PAIR_SUMS)
            self._blend(
                "backward", band, BLACK, False, absolute, ranges=visited, all_ranges=self.ranges,
                pair_sums=pair_sums, **buffers,
            )  # fmt: skip
            self.device.run(
                "gather", entry, group_count(self.count), (self.count, int(adds)), spans=band.spans,
                pair_sums=pair_sums, **targets,
            )  # fmt: skip

    def backward(self, sums: Buffer, by_splats: Buffer, by_sh: Buffer) -> None:
        """Record the gradients of drawn splats from the sums of :meth:`differentiate`; other rows stay."""
        _project(
            self.device, "backward", self.lens, self.degree, splats=self.splats, sh=self.sh,
            projected=self.rows, sums=sums, by_splats=by_splats, by_sh=by_sh,
        )  # fmt: skip

    def train(self, sums: Buffer, training: np.ndarray, report: Buffer, **buffers: Buffer) -> None:
        """Record statistics and an Adam step from the sums of :meth:`differentiate`.

        Args:
            training: (TRAINING_NUMBERS,) float32.
            report: tells if the step had too many pairs (common.wgsl).
            buffers: moments and statistics, with a row per splat.
        """
        _project(
            self.device, "train", self.lens, self.degree, training, {"report": report}, splats=self.splats,
            sh=self.sh, projected=self.rows, sums=sums, **buffers,
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
            entries=band.entries, **buffers,
        )  # fmt: skip


def _project(
    device: Device,
    entry: str,
    lens: np.ndarray,
    degree: int,
    training: np.ndarray | None = None,
    shared: dict[str, Buffer] | None = None,
    **buffers: Buffer,
) -> None:
    """Record a function of project.wgsl for all splats; ``shared`` has buffers without a row per splat."""
    if training is None:
        training = np.zeros(TRAINING_NUMBERS, np.float32)
    first = 0
    for part in device.parts(**buffers):
        count, terms, _ = part["sh"].shape
        numbers = lens, count, degree, terms, first, training
        device.run("project", entry, group_count(count), numbers, **part, **(shared or {}))
        first += count


def lens_of(view: KernelCamera, min_scale: float) -> np.ndarray:
    """Convert a view to the first numbers of project.wgsl's uniform, up to ``min_scale``."""
    numbers = np.zeros(28, np.float32)
    pose = numbers[:12].reshape(3, 4)
    pose[:, :3] = view.rotation
    pose[:, 3] = view.translation
    numbers[12:15] = view.position
    (left, right), (top, bottom) = view.x_limits, view.y_limits
    size = view.width, view.height
    numbers[16:] = (view.fx, view.fy, view.cx, view.cy, left, top, right, bottom, *size, view.near, min_scale)
    return numbers

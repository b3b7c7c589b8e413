"""Train splats in device memory; a step transfers only a few numbers between host and device.

A device model stores parameters, moments and density statistics on the device. Photos stay there too, with
eight bits per value, as long as their ``Target`` exists.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, MutableMapping

import numpy as np
import torch

from ...scenes.cameras import Camera
from ..adam import Adam
from ..rendering import KernelCamera, RasterSettings, Target
from .bin import group_count
from .device import Buffer, Device
from .loss import combine_loss, sums_and_gradient
from .scene import BY_SPLAT, SPLAT, SUMS, ProjectedScene

COLUMNS = {
    "means": slice(0, 3),
    "opacity_logits": slice(3, 4),
    "quats": slice(4, 8),
    "log_scales": slice(8, 11),
}
"""Columns of a splat's parameters (project.wgsl)."""
TRAINED = 11
"""Number of trained columns; weight and filter flag follow."""
STATS = ("gradient_sum", "seen", "gradient_max", "radius_max", "opacity_sum")
"""Statistics that a device collects (train.wgsl)."""
STATE = ("_splats", "_sh", "_splat_moments", "_sh_moments", "_stat_sums")
"""Attributes with buffers that persist between steps."""


def pack_splats(
    means: np.ndarray,
    quats: np.ndarray,
    log_scales: np.ndarray,
    logits: np.ndarray,
    weights: np.ndarray | float,
    filtered: np.ndarray | bool,
) -> np.ndarray:
    """Pack arrays (M, ...) to the splats (M, SPLAT) of shaders; the last two may be numbers."""
    packed = np.empty((len(means), SPLAT), np.float32)
    for column, array in zip(COLUMNS.values(), (means, logits[:, None], quats, log_scales), strict=True):
        packed[:, column] = array
    packed[:, TRAINED] = weights
    packed[:, TRAINED + 1] = filtered
    return packed


class GpuModel:
    """N splats in device memory; the host's copy is out of date until :meth:`copy_to_host`.

    Args:
        adam: optimizer whose tensors ``COLUMNS`` and ``sh`` are copied to the device.
        stats: (N,) statistics by names of STATS; :meth:`copy_to_host` replaces them.
        antialias: see ``rasterize``.

    Raises:
        LodgsError: the device was lost or has too little memory; the host's data is still valid. Methods
            raise it as the ``DeviceModel`` of :mod:`training.rasterize` says.
    """

    def __init__(
        self, device: Device, adam: Adam, stats: MutableMapping[str, torch.Tensor], antialias: bool
    ) -> None:
        self.device = device
        self._adam = adam
        self._stats = stats
        self._antialias = antialias
        self._weighted = False
        arrays = {name: tensor.detach().numpy() for name, tensor in adam.tensors.items()}
        moments = {name: [m.numpy() for m in state] for name, state in adam.state.items()}
        count = len(arrays["means"])
        splat_moments = np.empty((count, TRAINED, 2), np.float32)
        for name, column in COLUMNS.items():
            for k, moment in enumerate(moments[name]):
                splat_moments[:, column, k] = moment.reshape(count, -1)
        stat_sums = np.zeros((count, len(STATS)), np.float32)
        for name, values in stats.items():
            stat_sums[:, STATS.index(name)] = values.numpy()
        geometry = (arrays[name] for name in ("means", "quats", "log_scales", "opacity_logits"))
        with device.lock:
            self._splats = device.upload(pack_splats(*geometry, weights=1, filtered=antialias))
            self._sh = device.upload(arrays["sh"])
            self._splat_moments = device.upload(splat_moments)
            self._sh_moments = device.upload(np.stack(moments["sh"], -1))
            self._stat_sums = device.upload(stat_sums)
            self._allocate_gradients()
        self.drawn = device.empty(np.float32, 0, 0, 4)

    def __len__(self) -> int:
        return self._splats.shape[0]

    def step(
        self,
        camera: Camera,
        target: Target,
        *,
        near: float,
        sh_degree: int,
        background: tuple[float, float, float],
        ssim_weight: float,
        weights: torch.Tensor | None = None,
        min_scale: float = 0.0,
        shrink: float | None = None,
    ) -> float:
        """Make one step with the photometric loss, and return the loss.

        Args:
            target: opaque photo without a mask.
            shrink: factor by which the photo was downscaled, for the statistics; None collects none.
            camera, near, sh_degree, background, weights, min_scale: see ``rasterize``.
            ssim_weight: see ``photometric_loss``.

        Raises:
            LodgsError: the device was lost or has too little memory. The splats are lost with it.
        """
        device = self.device
        count = len(self)
        settings = RasterSettings(
            KernelCamera.of(camera, near), min_scale, self._antialias, background, sh_degree
        )
        with device.lock:
            self._set_weights(weights)
            scene = ProjectedScene.of(device, self._splats, self._sh, settings)
            size = camera.height, camera.width
            self.drawn = device.empty(np.float32, *size, 4)
            visited = device.empty(np.uint32, *scene.ranges.shape)
            scene.draw(
                background, False, colours=scene.colours, visited=visited, drawn=self.drawn,
                limit=device.empty(np.float32, 1), median=device.empty(np.int32, *size),
            )  # fmt: skip
            sums_of_loss, by_image = self._loss(target, ssim_weight)
            sums, by_colours = device.empty(np.float32, count, SUMS), device.empty(np.float32, count, 3)
            scene.differentiate(
                SUMS, False, sums, by_colours, visited, colours=scene.colours, image=self.drawn,
                by_image=by_image,
            )  # fmt: skip
            scene.backward(sums, by_colours, self._by_splats, self._by_sh)
            if shrink is not None:
                self._run(
                    "collect_stats", {"shrink": shrink}, radii=scene.radii, by_rows=self._by_splats,
                    stats=self._stat_sums, values=self._splats,
                )  # fmt: skip
            self._adam_step(scene.radii, 3 * (sh_degree + 1) ** 2)
            l1, ssim = device.read(sums_of_loss)
        return combine_loss(l1, ssim, 3 * size[0] * size[1], ssim_weight)

    def last_image(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the last step's image (H, W, 3) and alpha (H, W)."""
        drawn = torch.from_numpy(self.device.read(self.drawn))
        return drawn[..., :3], 1 - drawn[..., 3]

    def read(self, name: str) -> torch.Tensor:
        """Copy the current values of a tensor or statistic to the host."""
        device = self.device
        with device.lock:
            if name == "sh":
                return torch.from_numpy(device.read(self._sh))
            values = self._splats
            columns = COLUMNS.get(name)
            if columns is None:
                values = self._stat_sums
                columns = slice(STATS.index(name), STATS.index(name) + 1)
            copied = device.empty(np.float32, len(self), _width(columns))
            numbers = {"width": _width(columns), "stride": values.shape[1], "slot": columns.start}
            self._run("read_columns", numbers, values=values, totals=copied)
            return _as_tensor(device.read(copied))

    def read_rows(self, index: torch.Tensor) -> dict[str, torch.Tensor]:
        """Copy the tensors' values at indices (M,) to the host, by name."""
        with self.device.lock:
            rows = self.device.upload(index.numpy().astype(np.uint32))
            splats = self.device.read(self._select_rows(self._splats, rows))
            sh = self.device.read(self._select_rows(self._sh, rows))
        tensors = {name: _as_tensor(splats[:, columns]) for name, columns in COLUMNS.items()}
        return tensors | {"sh": torch.from_numpy(sh)}

    def select(self, index: torch.Tensor) -> None:
        """Keep only the splats at indices (M,), at least one, in this order."""
        with self.device.lock:
            rows = self.device.upload(index.numpy().astype(np.uint32))
            self._replace_state(lambda name, buffer: self._select_rows(buffer, rows))

    def append(self, rows: Mapping[str, torch.Tensor]) -> None:
        """Append at least one splat, with zero moments and statistics."""
        arrays = {name: tensor.detach().numpy() for name, tensor in rows.items()}
        geometry = (arrays[name] for name in ("means", "quats", "log_scales", "opacity_logits"))
        added = {"_splats": pack_splats(*geometry, weights=1, filtered=self._antialias), "_sh": arrays["sh"]}
        count = len(arrays["means"])
        with self.device.lock:
            self._replace_state(lambda name, buffer: self.device.extended(buffer, count, added.get(name)))

    def assign(self, name: str, values: torch.Tensor) -> None:
        """Replace a tensor's values and reset its moments to zero."""
        device = self.device
        with device.lock:
            uploaded = device.upload(values.numpy())
            if name == "sh":
                self._sh = uploaded
                self._sh_moments = device.empty(np.float32, *self._sh_moments.shape)
                return
            columns = COLUMNS[name]
            numbers = {"width": _width(columns), "slot": columns.start}
            self._run("write_columns", numbers, parts=uploaded, values=self._splats)
            numbers = {"width": 2 * _width(columns), "stride": 2 * TRAINED, "slot": 2 * columns.start}
            zeros = device.empty(np.float32, len(self), numbers["width"])
            self._run("write_columns", numbers, parts=zeros, values=self._splat_moments)

    def reset_stats(self) -> None:
        """Reset all statistics to zero."""
        self._stat_sums = self.device.empty(np.float32, *self._stat_sums.shape)

    def raise_log_scales(self, minimum: torch.Tensor) -> None:
        """Raise every log-scale of a splat to at least its minimum (N,)."""
        lowest = minimum.numpy().clip(np.finfo(np.float32).min)  # not every device supports infinity
        with self.device.lock:
            self._run("raise_log_scales", {}, parts=self.device.upload(lowest), values=self._splats)

    def copy_to_host(self) -> None:
        """Replace the host's tensors, moments and statistics by the device's values."""
        with self.device.lock:
            splats, sh, splat_moments, sh_moments, stat_sums = (
                self.device.read(getattr(self, name)) for name in STATE
            )
        for name, columns in COLUMNS.items():
            values, *moments = map(
                _as_tensor,
                (splats[:, columns], splat_moments[:, columns, 0], splat_moments[:, columns, 1]),
            )
            self._adam.replace(name, values.requires_grad_(), *moments)
        first, second = (torch.from_numpy(sh_moments[..., k].copy()) for k in range(2))
        self._adam.replace("sh", torch.from_numpy(sh).requires_grad_(), first, second)
        for name in self._stats:
            self._stats[name] = torch.from_numpy(stat_sums[:, STATS.index(name)].copy())

    def _allocate_gradients(self) -> None:
        """Allocate the gradients of all splats."""
        self._by_splats = self.device.empty(np.float32, len(self), BY_SPLAT)
        self._by_sh = self.device.empty(np.float32, *self._sh.shape)

    def _replace_state(self, make: Callable[[str, Buffer], Buffer]) -> None:
        """Replace the buffers of STATE one by one, so that at most one exists twice."""
        del self._by_splats, self._by_sh
        for name in STATE:
            setattr(self, name, make(name, getattr(self, name)))
            self.device.wait()
        self._allocate_gradients()

    def _select_rows(self, buffer: Buffer, index: Buffer) -> Buffer:
        """Copy the rows of a buffer at indices (M,)."""
        device = self.device
        row = buffer.shape[1:]
        width = int(np.prod(row))
        selected = device.empty(np.float32, *index.shape, *row)
        for source in device.parts(source=buffer):
            first = (source["source"].offset - buffer.offset) // (4 * width)
            end = first + source["source"].shape[0]
            for part in device.parts(index=index, selected=selected):
                count = width * part["index"].shape[0]
                numbers = count, width, first, end
                device.run("gather", "select_rows", group_count(count), numbers, **source, **part)
        return selected

    def _set_weights(self, weights: torch.Tensor | None) -> None:
        """Set the splats' weights; None sets 1."""
        if weights is None and not self._weighted:
            return
        if weights is None:
            array = np.ones(len(self), np.float32)
        else:
            array = weights.numpy().astype(np.float32, copy=False)
        self._weighted = weights is not None
        self._run("write_columns", {"slot": TRAINED}, parts=self.device.upload(array), values=self._splats)

    def _loss(self, target: Target, ssim_weight: float) -> tuple[Buffer, Buffer]:
        """Compute the sums of L1 and SSIM (2,), and the gradient (H, W, 4) by the image."""
        device = self.device
        height, width, _ = self.drawn.shape
        image, truth = (device.empty(np.float32, 3, height, width) for _ in range(2))
        groups = group_count(height * width)
        numbers = _numbers(height * width)
        device.run(
            "train", "unpack", groups, numbers, photo=_upload_photo(device, target), drawn=self.drawn,
            image=image, truth=truth,
        )  # fmt: skip
        *sums, gradient = sums_and_gradient(device, image, truth, ssim_weight)
        by_image = device.empty(np.float32, height, width, 4)
        totals = device.empty(np.float32, 2)
        device.run("train", "pack", groups, numbers, gradient=gradient, by_image=by_image)
        for slot, parts in enumerate(sums):
            device.run("train", "total", 1, _numbers(parts.shape[0], slot=slot), parts=parts, totals=totals)
        return totals, by_image

    def _adam_step(self, radii: Buffer, harmonics: int) -> None:
        """Make the Adam step; ``harmonics`` is the number of active numbers in a splat's harmonics."""
        adam = self._adam
        coefficients = self._sh.shape[1]
        rates = {}
        for name in (*COLUMNS, "sh"):
            adam.steps[name] += 1
            first, second = (1 - beta ** adam.steps[name] for beta in adam.betas)
            shape = (coefficients, 3) if name == "sh" else (_width(COLUMNS[name]),)
            rate = np.broadcast_to(np.asarray(adam.lr[name], np.float32) / np.float32(first), shape)
            rates[name] = np.stack([rate.ravel(), np.full(rate.size, 1 / second, np.float32)], 1)
        splat_rates = np.concatenate([rates[name] for name in COLUMNS])
        for values, moments, gradient, stride, by_stride, trained, rate in (
            (self._splats, self._splat_moments, self._by_splats, SPLAT, BY_SPLAT, TRAINED, splat_rates),
            (self._sh, self._sh_moments, self._by_sh, *[3 * coefficients] * 2, harmonics, rates["sh"]),
        ):
            numbers = {
                "width": len(rate), "stride": stride, "by_stride": by_stride, "trained": trained,
                "adam": (*adam.betas, adam.eps),
            }  # fmt: skip
            shared = {"rates": self.device.upload(rate)}
            self._run("adam", numbers, shared, radii=radii, by_rows=gradient, values=values, moments=moments)

    def _run(
        self, entry: str, numbers: Mapping, shared: Mapping[str, Buffer] | None = None, **rows: Buffer
    ) -> None:
        """Record a function of train.wgsl for all rows of buffers with one row per splat."""
        for part in self.device.parts(**rows):
            count = numbers.get("width", 1) * next(iter(part.values())).shape[0]
            buffers = {**part, **(shared or {})}
            self.device.run("train", entry, group_count(count), _numbers(count, **numbers), **buffers)


def _numbers(
    count: int,
    width: int = 1,
    stride: int = SPLAT,
    by_stride: int = BY_SPLAT,
    trained: int = 0,
    slot: int = 0,
    adam: tuple[float, float, float] = (0.0, 0.0, 0.0),
    shrink: float = 1.0,
) -> tuple:
    """Return the uniform of train.wgsl."""
    return count, width, stride, by_stride, trained, slot, *adam, float(shrink)


def _as_tensor(values: np.ndarray) -> torch.Tensor:
    """Copy columns (M, C) of splats to a tensor, (M,) if C is 1."""
    return torch.from_numpy(np.ascontiguousarray(values[:, 0] if values.shape[1] == 1 else values))


def _width(columns: slice) -> int:
    return columns.stop - columns.start


def _upload_photo(device: Device, target: Target) -> Buffer:
    """Upload a photo (H, W) with one byte per colour; it is cached in its target."""
    if target.cache.get("device_model", (None,))[0] is not device:
        bytes_ = np.zeros((*target.image.shape[:2], 4), np.uint8)
        bytes_[..., :3] = np.rint(255 * target.image.numpy())
        target.cache["device_model"] = device, device.upload(bytes_.view("<u4")[..., 0])
    return target.cache["device_model"][1]

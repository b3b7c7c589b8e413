"""Splats that are trained where they are drawn: a step moves a few numbers between computer and device.

A twin has the parameters of a model of splats, their moments and the statistics of density control on the
device. Photographs stay there too, with eight bits a value, as long as their ``Target`` is kept here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, MutableMapping

import numpy as np
import torch

from ...scenes.cameras import Camera
from ..adam import Adam
from ..rendering import KernelCamera, RasterSettings, Target
from .bin import groups_of
from .device import Buffer, Device
from .loss import loss_of, sums_and_gradient
from .scene import BY_SPLAT, SPLAT, SUMS, Scene

COLUMNS = {
    "means": slice(0, 3),
    "opacity_logits": slice(3, 4),
    "quats": slice(4, 8),
    "log_scales": slice(8, 11),
}
"""Where a splat's numbers stand (project.wgsl)."""
TRAINED = 11
"""So many of them are trained; the weight and the filter follow."""
STATS = ("gradient_sum", "seen", "gradient_max", "radius_max", "opacity_sum")
"""The statistics that a device adds up (train.wgsl)."""
STATE = ("_splats", "_sh", "_splat_moments", "_sh_moments", "_counted")
"""A twin's buffers of what lasts from step to step."""


def packed(
    means: np.ndarray,
    quats: np.ndarray,
    log_scales: np.ndarray,
    logits: np.ndarray,
    weights: np.ndarray | float,
    filtered: np.ndarray | bool,
) -> np.ndarray:
    """(M, SPLAT) of arrays (M, ...) or, of the last two, of one number for all: as shaders take splats."""
    found = np.empty((len(means), SPLAT), np.float32)
    for column, array in zip(COLUMNS.values(), (means, logits[:, None], quats, log_scales), strict=True):
        found[:, column] = array
    found[:, TRAINED], found[:, TRAINED + 1] = weights, filtered
    return found


class GpuModel:
    """N splats on a device. What is here in the meantime is what they were; see :meth:`copy_to_host`.

    Args:
        adam: of what is trained, of which ``COLUMNS`` and ``sh`` go along.
        stats: (N,) of each splat, by names of STATS; those that are brought home take their places.
        antialias: as of ``rasterize``.

    Raises:
        LodgsError: the device was lost, or has too little memory. Then what is here is still whole. Methods
            raise it as the ``DeviceModel`` of :mod:`training.rasterize` says.
    """

    def __init__(
        self, device: Device, adam: Adam, stats: MutableMapping[str, torch.Tensor], antialias: bool
    ) -> None:
        self.device, self._adam, self._stats, self._antialias = device, adam, stats, antialias
        arrays = {name: tensor.detach().numpy() for name, tensor in adam.tensors.items()}
        moments = {name: [m.numpy() for m in state] for name, state in adam.state.items()}
        count, self._weighted = len(arrays["means"]), False
        of_splats = np.empty((count, TRAINED, 2), np.float32)
        for name, column in COLUMNS.items():
            for k, moment in enumerate(moments[name]):
                of_splats[:, column, k] = moment.reshape(count, -1)
        counted = np.zeros((count, len(STATS)), np.float32)
        for name, values in stats.items():
            counted[:, STATS.index(name)] = values.numpy()
        geometry = (arrays[name] for name in ("means", "quats", "log_scales", "opacity_logits"))
        with device.lock:
            self._splats = device.upload(packed(*geometry, weights=1, filtered=antialias))
            self._sh = device.upload(arrays["sh"])
            self._splat_moments = device.upload(of_splats)
            self._sh_moments = device.upload(np.stack(moments["sh"], -1))
            self._counted = device.upload(counted)
            self._make_room()
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
        """One step by the photometric loss, which it returns.

        Args:
            target: opaque and without a mask.
            shrink: the statistics are added up, of a photograph that is so many times smaller; None: they
                stay as they are.
            others: as of ``rasterize`` and ``photometric_loss``.

        Raises:
            LodgsError: the device was lost, or has too little memory. The splats are lost with it.
        """
        device, count = self.device, len(self)
        settings = RasterSettings(
            KernelCamera.of(camera, near), min_scale, self._antialias, background, sh_degree
        )
        with device.lock:
            self._weigh(weights)
            scene = Scene.of(device, self._splats, self._sh, settings)
            size = camera.height, camera.width
            self.drawn, walked = (
                device.empty(np.float32, *size, 4), device.empty(np.uint32, *scene.ranges.shape),
            )  # fmt: skip
            scene.draw(
                background, False, colours=scene.colours, walked=walked, drawn=self.drawn,
                limit=device.empty(np.float32, 1), median=device.empty(np.int32, *size),
            )  # fmt: skip
            told, by_picture = self._loss(target, ssim_weight)
            sums, by_colours = device.empty(np.float32, count, SUMS), device.empty(np.float32, count, 3)
            scene.differentiate(
                SUMS, False, sums, by_colours, walked, colours=scene.colours, picture=self.drawn,
                by_picture=by_picture,
            )  # fmt: skip
            scene.backward(sums, by_colours, self._by_splats, self._by_sh)
            if shrink is not None:
                self._run(
                    "count", {"shrink": shrink}, radii=scene.radii, by_rows=self._by_splats,
                    stats=self._counted, values=self._splats,
                )  # fmt: skip
            self._move(scene.radii, 3 * (sh_degree + 1) ** 2)
            l1, ssim = device.read(told)
        return loss_of(l1, ssim, 3 * size[0] * size[1], ssim_weight)

    def last_image(self) -> tuple[torch.Tensor, torch.Tensor]:
        """The last step's (H, W, 3), and its alpha (H, W)."""
        drawn = torch.from_numpy(self.device.read(self.drawn))
        return drawn[..., :3], 1 - drawn[..., 3]

    def read(self, name: str) -> torch.Tensor:
        """A tensor's values, or a statistic's, as they are now, a copy."""
        device = self.device
        with device.lock:
            if name == "sh":
                return torch.from_numpy(device.read(self._sh))
            values, at = self._splats, COLUMNS.get(name)
            if at is None:
                values, at = self._counted, slice(STATS.index(name), STATS.index(name) + 1)
            found = device.empty(np.float32, len(self), _width(at))
            numbers = {"width": _width(at), "stride": values.shape[1], "slot": at.start}
            self._run("look", numbers, values=values, totals=found)
            return _as_trained(device.read(found))

    def read_rows(self, index: torch.Tensor) -> dict[str, torch.Tensor]:
        """Tensors' values at indices (M,), by name, a copy."""
        with self.device.lock:
            wanted = self.device.upload(index.numpy().astype(np.uint32))
            splats, sh = (self.device.read(self._taken(each, wanted)) for each in (self._splats, self._sh))
        found = {name: _as_trained(splats[:, at]) for name, at in COLUMNS.items()}
        return found | {"sh": torch.from_numpy(sh)}

    def select(self, index: torch.Tensor) -> None:
        """Only the splats at indices (M,), at least one, stay, in this order."""
        with self.device.lock:
            wanted = self.device.upload(index.numpy().astype(np.uint32))
            self._change(lambda name, buffer: self._taken(buffer, wanted))

    def append(self, rows: Mapping[str, torch.Tensor]) -> None:
        """Adds splats at the end, at least one, with moments and statistics of zero."""
        arrays = {name: tensor.detach().numpy() for name, tensor in rows.items()}
        geometry = (arrays[name] for name in ("means", "quats", "log_scales", "opacity_logits"))
        added = {"_splats": packed(*geometry, weights=1, filtered=self._antialias), "_sh": arrays["sh"]}
        count = len(arrays["means"])
        with self.device.lock:
            self._change(lambda name, buffer: self.device.extended(buffer, count, added.get(name)))

    def assign(self, name: str, values: torch.Tensor) -> None:
        """Gives a tensor new values and zero moments."""
        device = self.device
        with device.lock:
            given = device.upload(values.numpy())
            if name == "sh":
                self._sh, self._sh_moments = given, device.empty(np.float32, *self._sh_moments.shape)
                return
            at = COLUMNS[name]
            self._run("put", {"width": _width(at), "slot": at.start}, parts=given, values=self._splats)
            numbers = {"width": 2 * _width(at), "stride": 2 * TRAINED, "slot": 2 * at.start}
            blank = device.empty(np.float32, len(self), numbers["width"])
            self._run("put", numbers, parts=blank, values=self._splat_moments)

    def reset_stats(self) -> None:
        """Begins anew with what is added up."""
        self._counted = self.device.empty(np.float32, *self._counted.shape)

    def raise_log_scales(self, minimum: torch.Tensor) -> None:
        """No log-scale of a splat is below its least one (N,) from here."""
        lowest = minimum.numpy().clip(np.finfo(np.float32).min)  # not every device knows an infinity
        with self.device.lock:
            self._run("widen", {}, parts=self.device.upload(lowest), values=self._splats)

    def copy_to_host(self) -> None:
        """Makes tensors, moments and statistics here what they are on the device."""
        with self.device.lock:
            splats, sh, of_splats, of_sh, counted = map(
                self.device.read,
                (self._splats, self._sh, self._splat_moments, self._sh_moments, self._counted),
            )
        found = {
            name: (splats[:, at], of_splats[:, at, 0], of_splats[:, at, 1]) for name, at in COLUMNS.items()
        }
        for name, arrays in found.items():
            values, *moments = map(_as_trained, arrays)
            self._adam.replace(name, values.requires_grad_(), *moments)
        first, second = (torch.from_numpy(of_sh[..., k].copy()) for k in range(2))
        self._adam.replace("sh", torch.from_numpy(sh).requires_grad_(), first, second)
        for name in self._stats:
            self._stats[name] = torch.from_numpy(counted[:, STATS.index(name)].copy())

    def _make_room(self) -> None:
        """For gradients of as many splats as there are."""
        self._by_splats = self.device.empty(np.float32, len(self), BY_SPLAT)
        self._by_sh = self.device.empty(np.float32, *self._sh.shape)

    def _change(self, make: Callable[[str, Buffer], Buffer]) -> None:
        """Puts others in the places of the buffers of STATE, one after the other: so few are there twice."""
        del self._by_splats, self._by_sh
        for name in STATE:
            setattr(self, name, make(name, getattr(self, name)))
            self.device.wait()
        self._make_room()

    def _taken(self, buffer: Buffer, index: Buffer) -> Buffer:
        """The rows of a buffer at indices (M,)."""
        device, row = self.device, buffer.shape[1:]
        found, width = device.empty(np.float32, *index.shape, *row), int(np.prod(row))
        for given in device.parts(source=buffer):
            first = (given["source"].offset - buffer.offset) // (4 * width)
            end = first + given["source"].shape[0]
            for part in device.parts(index=index, taken=found):
                count = width * part["index"].shape[0]
                device.run("gather", "take", groups_of(count), (count, width, first, end), **given, **part)
        return found

    def _weigh(self, weights: torch.Tensor | None) -> None:
        """Gives splats their weights; None: ones."""
        if weights is None and not self._weighted:
            return
        ones = np.ones(len(self), np.float32)
        given = ones if weights is None else weights.numpy().astype(np.float32, copy=False)
        self._weighted = weights is not None
        self._run("put", {"slot": TRAINED}, parts=self.device.upload(given), values=self._splats)

    def _loss(self, target: Target, ssim_weight: float) -> tuple[Buffer, Buffer]:
        """What L1 and SSIM add up to (2,), and the gradient (H, W, 4) by the picture."""
        device, (height, width, _) = self.device, self.drawn.shape
        image, truth = (device.empty(np.float32, 3, height, width) for _ in range(2))
        groups, numbers = groups_of(height * width), _numbers(height * width)
        device.run(
            "train", "unpack", groups, numbers, photograph=_photograph(device, target), drawn=self.drawn,
            image=image, truth=truth,
        )  # fmt: skip
        *sums, gradient = sums_and_gradient(device, image, truth, ssim_weight)
        by_picture, told = device.empty(np.float32, height, width, 4), device.empty(np.float32, 2)
        device.run("train", "pack", groups, numbers, gradient=gradient, by_picture=by_picture)
        for slot, each in enumerate(sums):
            device.run("train", "total", 1, _numbers(each.shape[0], slot=slot), parts=each, totals=told)
        return told, by_picture

    def _move(self, radii: Buffer, harmonics: int) -> None:
        """Adam's step, of so many numbers of each splat's harmonics."""
        adam, coefficients = self._adam, self._sh.shape[1]
        rates = {}
        for name in (*COLUMNS, "sh"):
            adam.steps[name] += 1
            first, second = (1 - beta ** adam.steps[name] for beta in adam.betas)
            shape = (coefficients, 3) if name == "sh" else (_width(COLUMNS[name]),)
            rate = np.broadcast_to(np.asarray(adam.lr[name], np.float32) / np.float32(first), shape)
            rates[name] = np.stack([rate.ravel(), np.full(rate.size, 1 / second, np.float32)], 1)
        of_splats = np.concatenate([rates[name] for name in COLUMNS])
        for values, moments, gradient, stride, by_stride, trained, rate in (
            (self._splats, self._splat_moments, self._by_splats, SPLAT, BY_SPLAT, TRAINED, of_splats),
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
        """Record a function of train.wgsl, for all rows of buffers that have one for each splat."""
        for part in self.device.parts(**rows):
            count = numbers.get("width", 1) * next(iter(part.values())).shape[0]
            given = {**part, **(shared or {})}
            self.device.run("train", entry, groups_of(count), _numbers(count, **numbers), **given)


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
    """What train.wgsl is told."""
    return count, width, stride, by_stride, trained, slot, *adam, float(shrink)


def _as_trained(values: np.ndarray) -> torch.Tensor:
    """Columns (M, C) of splats as a tensor of its own, (M,) where there is but one."""
    return torch.from_numpy(np.ascontiguousarray(values[:, 0] if values.shape[1] == 1 else values))


def _width(columns: slice) -> int:
    return columns.stop - columns.start


def _photograph(device: Device, target: Target) -> Buffer:
    """A photograph (H, W) with a byte for each colour, which stays as long as its target."""
    if target.cache.get("twin", (None,))[0] is not device:
        bytes_ = np.zeros((*target.image.shape[:2], 4), np.uint8)
        bytes_[..., :3] = np.rint(255 * target.image.numpy())
        target.cache["twin"] = device, device.upload(bytes_.view("<u4")[..., 0])
    return target.cache["twin"][1]

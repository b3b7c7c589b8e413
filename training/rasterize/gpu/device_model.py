"""Train splats in device memory; a step transfers only a few numbers between host and device.

A device model stores parameters, moments and density statistics on the device. Photos stay there too, with
eight bits per value, as long as their ``Target`` exists.

The dispatches of a step are recorded once per image size and number of splats, and replayed. The host does
not wait for them: it reads losses when they are asked for, or after PENDING steps. Buffers for pairs of
splats and tiles have a capacity. A step with more pairs changes nothing, nor do the steps after it. The host
notices when it reads losses, enlarges the buffers and repeats these steps, with the same bits.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, MutableMapping
from typing import Any

import numpy as np
import torch

from ...scenes.cameras import Camera
from ..adam import Adam
from ..rendering import KernelCamera, RasterSettings, StepOptions, Target
from .bin import group_count
from .device import Buffer, Device
from .loss import combine_loss, record_loss
from .scene import PAIR_SUMS, SPLAT, TRAINING_NUMBERS, ProjectedScene, lens_of
from .steps import LOSSES, Inputs, Step

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
"""Statistics that a device collects (project.wgsl)."""
STATE = ("_splats", "_sh", "_moments", "_stat_sums")
"""Attributes with buffers that persist between steps."""

PENDING = 32
"""Maximum number of steps whose losses the host has not read."""
RECORDINGS = 8
"""Maximum number of recorded steps, which differ in image size or degree. They share buffers."""
PAIRS_PER_SPLAT, MIN_PAIRS, GROWTH = 4, 1 << 14, 1.5
"""Initial capacity for pairs, and its growth over the number of pairs of a step that has more."""


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
        packed = np.empty((count, TRAINED + arrays["sh"][0].size, 2), np.float32)
        for name, columns in {**COLUMNS, "sh": slice(TRAINED, None)}.items():
            for k, moment in enumerate(moments[name]):
                packed[:, columns, k] = moment.reshape(count, -1)
        stat_sums = np.zeros((count, len(STATS)), np.float32)
        for name, values in stats.items():
            stat_sums[:, STATS.index(name)] = values.numpy()
        geometry = (arrays[name] for name in ("means", "quats", "log_scales", "opacity_logits"))
        with device.lock:
            self._splats = device.upload(pack_splats(*geometry, weights=1, filtered=antialias))
            self._sh = device.upload(arrays["sh"])
            self._moments = device.upload(packed)
            self._stat_sums = device.upload(stat_sums)
            self._report = device.empty(np.uint32, LOSSES + 2 * PENDING)
        self.drawn = device.empty(np.float32, 0, 0, 4)
        self._numbers = np.zeros(TRAINING_NUMBERS, np.float32)
        rates = self._numbers[8 : 8 + 2 * self._moments.shape[1]].reshape(-1, 2)
        self._rates = {name: rates[columns] for name, columns in COLUMNS.items()}
        self._rates["sh"] = rates[TRAINED:].reshape(-1, 3, 2)
        self._pending: list[Step] = []
        self._recorded: dict[tuple, Inputs] = {}
        self._shared: list[Any] = []  # buffers of all recorded steps
        self._diverged: float | None = None
        self._max_pairs = device.binding_bytes // (4 * PAIR_SUMS)
        self._capacity: int | None = min(max(PAIRS_PER_SPLAT * count, MIN_PAIRS), self._max_pairs)

    def __len__(self) -> int:
        return self._splats.shape[0]

    def step(self, camera: Camera, target: Target, options: StepOptions) -> Callable[[], float]:
        """Make one step; return a function that reads the loss from the device."""
        view, lens = _view(target, camera, options.near, options.min_scale)
        settings = RasterSettings(
            view, options.min_scale, self._antialias, options.background, options.sh_degree
        )
        weights = None if options.weights is None else options.weights.numpy().astype(np.float32)
        with self.device.lock:
            if len(self._pending) == PENDING:
                self._settle()
            photo = _upload_photo(self.device, target)
            numbers = self._next_numbers(options)
            step = Step(settings, photo, lens, options.ssim_weight, weights, numbers)
            self._start(step)

        def loss() -> float:
            with self.device.lock:
                if step.loss is None:
                    self._settle()
            assert step.loss is not None
            return step.loss if self._diverged is None else self._diverged

        return loss

    def _start(self, step: Step) -> None:
        """Submit a step, whose loss is then pending."""
        device = self.device
        self._set_weights(step.weights)
        if self._capacity is None:  # the pairs are counted in the middle of the step
            inputs = self._dispatch(step, None)
            device.submit()
        else:
            inputs = self._recorded.pop(step.key, None) or self._record(step)
            self._recorded[step.key] = inputs
            inputs.set(step, len(self._pending))
            assert inputs.recording is not None
            device.replay(inputs.recording, [(step.photo, inputs.photo)])
        self.drawn = inputs.drawn
        self._pending.append(step)

    def _record(self, step: Step) -> Inputs:
        """Prepare the dispatches of a step."""
        if len(self._recorded) == RECORDINGS:
            self._recorded.pop(next(iter(self._recorded)))
        with self.device.record(self._shared) as recording:
            inputs = self._dispatch(step, self._capacity)
        inputs.recording = recording
        return inputs

    def _dispatch(self, step: Step, capacity: int | None) -> Inputs:
        """Run or record the dispatches of a step.

        Args:
            capacity: maximum number of pairs; None counts them, which cannot be recorded.
        """
        device = self.device
        count = len(self)
        view = step.settings.view
        size = view.height, view.width
        photo = step.photo if capacity is None else device.scratch(np.uint32, *size)
        scene = ProjectedScene.of(device, self._splats, self._sh, step.settings, capacity)
        inputs = Inputs(
            photo, scene.lens, np.zeros(3, np.float32), np.zeros(TRAINING_NUMBERS, np.float32),
            np.zeros(1, np.uint32), device.scratch(np.float32, *size, 4),
        )  # fmt: skip
        inputs.set(step, len(self._pending))
        visited = device.scratch(np.uint32, *scene.ranges.shape)
        scene.draw(
            inputs.background, False, colors=scene.colors, visited=visited, drawn=inputs.drawn,
            limit=device.scratch(np.float32, 1), median=device.scratch(np.int32, *size),
        )  # fmt: skip
        losses, by_image = record_loss(device, inputs.drawn, photo, step.ssim_weight)
        pairs = (1 << 32) - 1 if capacity is None else capacity
        device.run(
            "train", "report_step", 1, (count, pairs, losses.shape[0], inputs.slot), losses=losses,
            starts=scene.bands[0].starts, report=self._report,
        )  # fmt: skip
        sums = device.scratch(np.float32, count, PAIR_SUMS)
        scene.differentiate(sums, visited, colors=scene.colors, image=inputs.drawn, by_image=by_image)
        scene.train(sums, inputs.training, self._report, moments=self._moments, stats=self._stat_sums)
        return inputs

    def _settle(self) -> None:
        """Wait for all pending steps and read their losses; repeat steps that had too many pairs."""
        while self._pending:
            report = self.device.read(self._report)
            needed, completed = report[:LOSSES].tolist()
            losses = report[LOSSES:].view(np.float32).reshape(-1, 2)
            steps, repeated = self._pending[:completed], self._pending[completed:]
            self._pending = []
            for step, (l1, ssim) in zip(steps, losses, strict=False):
                size = 3 * step.photo.shape[0] * step.photo.shape[1]
                step.loss = combine_loss(l1, ssim, size, step.ssim_weight)
                if self._diverged is None and not np.isfinite(step.loss):
                    self._diverged = step.loss
            self.device.write(self._report, np.zeros(LOSSES, np.uint32))
            if needed:
                fits = needed <= self._max_pairs
                self._capacity = min(int(GROWTH * needed), self._max_pairs) if fits else None
                self._forget_recordings()
            for step in repeated:
                self._start(step)

    def last_image(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the last step's image (H, W, 3) and alpha (H, W)."""
        with self.device.lock:
            self._settle()
            drawn = torch.from_numpy(self.device.read(self.drawn))
        return drawn[..., :3], 1 - drawn[..., 3]

    def read(self, name: str) -> torch.Tensor:
        """Copy the current values of a tensor or statistic to the host."""
        device = self.device
        with device.lock:
            self._settle()
            if name == "sh":
                return torch.from_numpy(device.read(self._sh))
            values = self._splats
            columns = COLUMNS.get(name)
            if columns is None:
                values = self._stat_sums
                columns = slice(STATS.index(name), STATS.index(name) + 1)
            copied = device.empty(np.float32, len(self), _width(columns))
            self._run("read_columns", columns, values=values, totals=copied)
            return _as_tensor(device.read(copied))

    def read_rows(self, index: torch.Tensor) -> dict[str, torch.Tensor]:
        """Copy the tensors' values at indices (M,) to the host, by name."""
        with self.device.lock:
            self._settle()
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

    def assign(self, name: str, values: torch.Tensor, keep_moments: bool = False) -> None:
        """Replace a tensor's values; reset its moments to zero unless ``keep_moments``."""
        device = self.device
        with device.lock:
            self._settle()
            uploaded = device.upload(values.numpy())
            columns = COLUMNS.get(name) or slice(TRAINED, self._moments.shape[1])
            if name == "sh":
                self._forget_recordings()
                self._sh = uploaded
            else:
                self._run("write_columns", columns, parts=uploaded, values=self._splats)
            if keep_moments:
                return
            zeros = device.empty(np.float32, len(self), 2 * _width(columns))
            pairs = slice(2 * columns.start, 2 * columns.stop)
            self._run("write_columns", pairs, parts=zeros, values=self._moments)

    def reset_stats(self) -> None:
        """Reset all statistics to zero."""
        with self.device.lock:
            self._settle()
            self.device.clear(self._stat_sums)

    def raise_log_scales(self, minimum: torch.Tensor) -> None:
        """Raise every log-scale of a splat to at least its minimum (N,)."""
        self._limit_log_scales("raise_columns", minimum)

    def lower_log_scales(self, maximum: torch.Tensor) -> None:
        """Lower every log-scale of a splat to at most its maximum (N,)."""
        self._limit_log_scales("lower_columns", maximum)

    def _limit_log_scales(self, entry: str, limits: torch.Tensor) -> None:
        finite = torch.nan_to_num(limits).numpy()  # not every device supports infinity
        with self.device.lock:
            self._settle()
            self._run(entry, COLUMNS["log_scales"], parts=self.device.upload(finite), values=self._splats)

    def copy_to_host(self) -> None:
        """Replace the host's tensors, moments and statistics by the device's values."""
        with self.device.lock:
            self._settle()
            splats, sh, packed, stat_sums = (self.device.read(getattr(self, name)) for name in STATE)
        for name, columns in COLUMNS.items():
            values, *moments = map(
                _as_tensor, (splats[:, columns], packed[:, columns, 0], packed[:, columns, 1])
            )
            self._adam.replace(name, values.requires_grad_(), *moments)
        moments = [_as_tensor(packed[:, TRAINED:, k]).reshape(sh.shape) for k in range(2)]
        self._adam.replace("sh", torch.from_numpy(sh).requires_grad_(), *moments)
        for name in self._stats:
            self._stats[name] = torch.from_numpy(stat_sums[:, STATS.index(name)].copy())

    def _replace_state(self, make: Callable[[str, Buffer], Buffer]) -> None:
        """Replace the buffers of STATE one by one, so that at most one exists twice."""
        self._settle()
        self._forget_recordings()
        for name in STATE:
            setattr(self, name, make(name, getattr(self, name)))
            self.device.wait()

    def _forget_recordings(self) -> None:
        self._recorded.clear()
        self._shared.clear()

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

    def _set_weights(self, weights: np.ndarray | None) -> None:
        """Set the splats' weights; None sets 1."""
        if weights is None and not self._weighted:
            return
        array = np.ones(len(self), np.float32) if weights is None else weights
        self._weighted = weights is not None
        columns = slice(TRAINED, TRAINED + 1)
        self._run("write_columns", columns, parts=self.device.upload(array), values=self._splats)

    def _next_numbers(self, options: StepOptions) -> np.ndarray:
        """Count a step of Adam; return the numbers of its ``ProjectedScene.train``."""
        adam = self._adam
        numbers = self._numbers
        numbers[:4] = *adam.betas, adam.eps, options.shrink or 0.0
        numbers[4:6] = options.drawn_only, options.sparse_sh
        for name, columns in self._rates.items():
            rate, betas, _, step = adam.count_step(name)
            first, second = (1 - beta**step for beta in betas)
            columns[..., 0] = (rate if isinstance(rate, float) else np.asarray(rate)) / first
            columns[..., 1] = 1 / second
        return numbers.copy()

    def _run(self, entry: str, columns: slice, values: Buffer, **rows: Buffer) -> None:
        """Record a function of train.wgsl for columns of ``values`` and buffers with as many rows."""
        stride = int(np.prod(values.shape[1:]))
        for part in self.device.parts(values=values, **rows):
            count = _width(columns) * part["values"].shape[0]
            numbers = count, _width(columns), stride, columns.start
            self.device.run("train", entry, group_count(count), numbers, **part)


def _as_tensor(values: np.ndarray) -> torch.Tensor:
    """Copy columns (M, C) of splats to a tensor, (M,) if C is 1."""
    return torch.from_numpy(np.ascontiguousarray(values[:, 0] if values.shape[1] == 1 else values))


def _width(columns: slice) -> int:
    return columns.stop - columns.start


def _view(target: Target, camera: Camera, near: float, min_scale: float) -> tuple[KernelCamera, np.ndarray]:
    """Return the view of a photo and its :func:`lens_of`; they are cached in its target."""
    key = near, min_scale
    cached = target.cache.get("device_view")
    if cached is None or cached[0] is not camera or cached[1] != key:
        view = KernelCamera.of(camera, near)
        cached = target.cache["device_view"] = camera, key, view, lens_of(view, min_scale)
    return cached[2:]


def _upload_photo(device: Device, target: Target) -> Buffer:
    """Upload a photo (H, W) with one byte per colour; it is cached in its target."""
    if target.cache.get("device_model", (None,))[0] is not device:
        bytes_ = np.zeros((*target.image.shape[:2], 4), np.uint8)
        bytes_[..., :3] = np.rint(255 * target.image.numpy())
        target.cache["device_model"] = device, device.upload(bytes_.view("<u4")[..., 0])
    return target.cache["device_model"][1]

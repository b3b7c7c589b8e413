"""Trainable rows (splats or anchors of splats) with Adam's state.

Splats are parametrised as in 3DGS files (``training.splats.gaussians``), as torch tensors.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import log
from typing import cast

import numpy as np
import torch
from torch.nn import functional

from ..rasterize import Adam, DeviceModel, Gaussians, Rendering, StepModel, make_step_model
from ..rasterize.adam import LearningRate
from ..rasterize.stats import PEAK_STATS, accumulate_stats
from ..splats.gaussians import Splats
from ..splats.morton import spatial_order
from .parameters import DensityParameters, Parameters
from .schedules import annealing, log_linear

NAMES = ("means", "quats", "log_scales", "opacity_logits", "sh")
"""Tensors of every splat. A model of splats may train further tensors, (N,), under other names."""
FROZEN = "held"
"""Column that marks rows excluded from training with 1. Only present if there are any."""


class Model:
    """N splats (or anchors of splats) under optimisation.

    The backend can train plain splats on its device (:meth:`step_model`). Access to the optimizer, a tensor
    or ``stats`` copies them to the host first. All other methods (:meth:`read`, :meth:`read_rows`,
    :meth:`keep`, ...) leave them on the device.

    Attributes:
        adam: optimizer with the trained tensors and their moments by name, among them ``means``.
        lr: learning rates by name.
        columns: further values of each row by name, not trained; zero for new rows that lack them.
        stats: sums of each row since the last reset, by name, always with ``gradient_sum`` and ``seen``.

    Args:
        tensors: tensors to train, N rows each.
        lr: learning rate of each tensor.
        columns: see the attribute.
        stats: initial stats besides ``gradient_sum`` and ``seen``, or these two in a shape other than (N,).
        peaks: also keep the stats ``gradient_max`` and ``radius_max``.
    """

    def __init__(
        self,
        tensors: Mapping[str, torch.Tensor],
        lr: Mapping[str, LearningRate],
        columns: Mapping[str, torch.Tensor] | None = None,
        stats: Mapping[str, torch.Tensor] | None = None,
        peaks: bool = False,
    ) -> None:
        self._device_model: DeviceModel | None = None
        self._adam = Adam({name: tensor.requires_grad_(True) for name, tensor in tensors.items()}, lr=lr)
        self.columns = dict(columns or {})
        zeros = self["means"].detach().new_zeros(len(self))
        self.stats = {"gradient_sum": zeros, "seen": zeros.clone(), **(stats or {})}
        if peaks:
            self.stats |= {name: zeros.clone() for name in PEAK_STATS}

    def __len__(self) -> int:
        return len(self._adam.tensors["means"] if self._device_model is None else self._device_model)

    def __getitem__(self, name: str) -> torch.Tensor:
        return self.adam.tensors[name]

    @property
    def adam(self) -> Adam:
        """Optimizer, after copying the trained tensors to the host."""
        self._copy_to_host()
        return self._adam

    @property
    def stats(self) -> dict[str, torch.Tensor]:
        """Stats by name, after copying them to the host."""
        self._copy_to_host()
        return self._stats

    @stats.setter
    def stats(self, stats: dict[str, torch.Tensor]) -> None:
        self._copy_to_host()
        self._stats = stats

    @property
    def lr(self) -> dict[str, LearningRate]:
        """Learning rates of the optimizer. Does not copy tensors."""
        return self._adam.lr

    @lr.setter
    def lr(self, rates: dict[str, LearningRate]) -> None:
        self._adam.lr = rates

    def step_model(self, backend: str, antialias: bool) -> StepModel | None:
        """Return the model in a form whose steps need no autograd, or None if there is none.

        See ``make_step_model``. A model on a device is in use until :attr:`adam`, :attr:`stats` or a tensor
        is accessed.
        """
        if self._device_model is not None or FROZEN in self.columns:
            return self._device_model
        model = make_step_model(backend, self._adam, self._stats, antialias=antialias)
        if hasattr(model, "copy_to_host"):  # isinstance with a protocol is slow
            self._device_model = cast(DeviceModel, model)
        return model

    def read(self, name: str) -> torch.Tensor:
        """Return a read-only copy or view of a trained tensor or stat (N, ...), without moving the model."""
        if self._device_model is not None and (name in NAMES or name in self._stats):
            return self._device_model.read(name)
        return self._stats[name] if name in self._stats else self._adam.tensors[name].detach()

    @property
    def _host_tensors(self) -> list[str]:
        """Names of the trained tensors on the host."""
        return [name for name in self._adam.tensors if self._device_model is None or name not in NAMES]

    @property
    def _host_columns(self) -> list[dict[str, torch.Tensor]]:
        """Tables of untrained values on the host: columns, and stats unless they are on the device."""
        return [self.columns, self._stats] if self._device_model is None else [self.columns]

    def _copy_to_host(self) -> None:
        device_model, self._device_model = self._device_model, None
        if device_model is not None:
            device_model.copy_to_host()

    @property
    def gaussians(self) -> Gaussians:
        """Tensors of a model of splats as rasterizer input."""
        return Gaussians(*(self[name] for name in NAMES))

    def read_rows(self, index: torch.Tensor) -> dict[str, torch.Tensor]:
        """Copy the trained tensors at indices (M,), by name."""
        rows = {name: self._adam.tensors[name].detach()[index] for name in self._host_tensors}
        return rows if self._device_model is None else rows | self._device_model.read_rows(index)

    def keep(self, mask: torch.Tensor) -> None:
        """Remove the rows where ``mask`` (N,), on any device, is False."""
        if not mask.all():
            self._select(torch.nonzero(mask).squeeze(1))

    def sort(self) -> None:
        """Sort the rows by space: steps then read and write neighbours in memory."""
        self._select(torch.from_numpy(spatial_order(self.read("means").cpu().numpy())))

    @torch.no_grad()
    def _select(self, rows: torch.Tensor) -> None:
        """Keep only rows (M,) int64, in this order."""
        rows = rows.to(self._adam.tensors["means"].device)
        if not len(rows):
            self._copy_to_host()
        if self._device_model is not None:
            self._device_model.select(rows)
        for name in self._host_tensors:
            tensors = self._adam.tensors[name], *self._adam.state[name]
            self._replace(name, *(tensor.index_select(0, rows) for tensor in tensors))
        for table in self._host_columns:
            table.update({name: column.index_select(0, rows) for name, column in table.items()})

    @torch.no_grad()
    def append(self, rows: Mapping[str, torch.Tensor]) -> None:
        """Add rows (M, ...) of all trained tensors, and optionally columns, with zero moments as in 3DGS."""
        count = len(rows["means"])
        if self._device_model is not None and count:
            self._device_model.append({name: rows[name] for name in NAMES})
        for table in self._host_columns:
            for name, column in table.items():
                zeros = column.new_zeros(count, *column.shape[1:])
                table[name] = torch.cat([column, rows.get(name, zeros)])
        for name in self._host_tensors:
            first, second = self._adam.state[name]
            zeros = torch.zeros_like(rows[name])
            self._replace(
                name,
                torch.cat([self._adam.tensors[name], rows[name]]),
                torch.cat([first, zeros]),
                torch.cat([second, zeros]),
            )

    @torch.no_grad()
    def assign(self, name: str, values: torch.Tensor) -> None:
        """Replace a trained tensor by one of the same shape and reset its moments to zero."""
        if self._device_model is not None and name in NAMES:
            self._device_model.assign(name, values)
        else:
            self._replace(name, values, torch.zeros_like(values), torch.zeros_like(values))

    @torch.no_grad()
    def fade(self, share: float) -> None:
        """Reduce all opacities by a share. Moments stay the same."""
        logits = self.read("opacity_logits")
        faded = log(1 - share) + functional.logsigmoid(logits) - ((share - 1) * logits.sigmoid()).log1p()
        if self._device_model is None:
            self["opacity_logits"].copy_(faded)
        else:
            self._device_model.assign("opacity_logits", faded, keep_moments=True)

    @torch.no_grad()
    def raise_log_scales(self, minimum: torch.Tensor) -> None:
        """Raise each splat's log-scales to its minimum (N,)."""
        if self._device_model is None:
            self["log_scales"].copy_(torch.maximum(self["log_scales"], minimum[:, None]))
        else:
            self._device_model.raise_log_scales(minimum)

    @torch.no_grad()
    def lower_log_scales(self, maximum: torch.Tensor) -> None:
        """Lower each splat's log-scales to its maximum (N,), on the CPU."""
        if self._device_model is None:
            self["log_scales"].clamp_max_(maximum.to(self["log_scales"])[:, None])
        else:
            self._device_model.lower_log_scales(maximum)

    def freeze_rows(self, rows: torch.Tensor) -> None:
        """Exclude rows, (N,) bool, from training from now on."""
        self.columns[FROZEN] = rows.to(self["means"])

    def freeze_gradients(self) -> None:
        """Zero the gradients of frozen rows, after ``backward``."""
        if FROZEN in self.columns:
            frozen = self.columns[FROZEN] > 0
            for tensor in self.adam.tensors.values():
                if tensor.grad is not None:
                    tensor.grad[frozen] = 0

    def accumulate_stats(self, rendering: Rendering, shrink: float = 1) -> None:
        """Add image-plane gradient norms and draw counts to the stats, after ``backward``.

        Also adds the opacities of drawn splats to ``opacity_sum``, if kept, and raises ``PEAK_STATS``, if
        kept, to the largest gradient and radius.

        Args:
            shrink: factor by which the image was reduced, which enlarged gradients by the same factor (see
                ``TrainingData.threshold_scale``).
        """
        logits = self.adam.tensors.get("opacity_logits")
        accumulate_stats(self.stats, rendering.grad2d, rendering.radii, logits, shrink)

    def reset_stats(self) -> None:
        """Set all stats to zero."""
        if self._device_model is not None:
            self._device_model.reset_stats()
            return
        for name, column in self.stats.items():
            self.stats[name] = torch.zeros_like(column)

    def mean_gradient(self) -> torch.Tensor:
        """Return the mean image-plane gradient norm (N,) over the views that drew each splat.

        It has the shape of the stats if these are not (N,).
        """
        return self.read("gradient_sum") / self.read("seen").clamp_min(1)

    def _replace(self, name: str, tensor: torch.Tensor, first: torch.Tensor, second: torch.Tensor) -> None:
        self._adam.replace(name, tensor.requires_grad_(True), first, second)

    def state_dict(self) -> dict:
        """Return tensors and numbers, as read by ``torch.load(weights_only=True)``."""
        return {
            "tensors": {name: tensor.detach() for name, tensor in self.adam.tensors.items()},
            "columns": self.columns,
            "stats": self.stats,
            "adam": self.adam.state_dict(),
        }

    def load_state_dict(self, state: dict) -> None:
        """Restore a state. An invalid state leaves the model unchanged.

        Raises:
            ValueError: the state is of another model, or inconsistent.
        """
        tensors, columns, stats, adam = (state[name] for name in ("tensors", "columns", "stats", "adam"))
        count = len(tensors["means"])
        for expected, loaded in (
            (self.adam.tensors, tensors),
            ({name: first for name, (first, _) in self.adam.state.items()}, adam["m"]),
            ({name: second for name, (_, second) in self.adam.state.items()}, adam["v"]),
            (self.columns, columns),
            (self.stats, stats),
        ):
            _check_compatible(expected, loaded, count)
        if not tensors.keys() == adam["steps"].keys() == self.adam.steps.keys():
            raise ValueError(f"steps of {sorted(adam['steps'])} do not match tensors {sorted(tensors)}")
        for name, tensor in tensors.items():
            self.adam.replace(name, tensor.requires_grad_(True))
        self.columns = columns
        self.stats = stats
        self.adam.load_state_dict(adam)

    def splats(self, min_scale: float = 0.0) -> Splats:
        """Copy the splats to arrays, with ``min_scale`` (FLoD, Eq. 4) baked into the scales.

        Trained tensors besides NAMES become ``extras``, float32.
        """
        arrays = {name: tensor.detach().cpu().numpy().copy() for name, tensor in self.adam.tensors.items()}
        if min_scale > 0:
            arrays["log_scales"] = np.log(np.exp(arrays["log_scales"]) + np.float32(min_scale))
        extras = {name: arrays.pop(name) for name in list(arrays) if name not in NAMES}
        return Splats(**arrays, extras=extras)


class RowOptimizer:
    """Apply Adam to the rows that one image was rendered from.

    Args:
        adam: optimizer of all rows.
        rows: (M,) int64 indices of the rows.
        leaves: their values by name, the leaves of the image's gradient graph.

    Attributes:
        gaussians: the rows as splats, for rendering.
    """

    def __init__(self, adam: Adam, rows: torch.Tensor, leaves: dict[str, torch.Tensor]) -> None:
        self._adam, self._rows, self._leaves = adam, rows, leaves
        self.gaussians = Gaussians(**leaves)

    def step(self) -> None:
        """Update these rows by one step."""
        self._adam.step_rows(self._rows, {name: leaf.grad for name, leaf in self._leaves.items()})

    def zero_grad(self) -> None:
        """Do nothing; the next image has other rows."""


def select_rows(model: Model, rows: torch.Tensor) -> RowOptimizer:
    """Select (M,) int64 rows of a model for rendering. The drawing with this optimizer updates only them."""
    leaves = {name: tensor.requires_grad_() for name, tensor in model.read_rows(rows).items()}
    return RowOptimizer(model.adam, rows, leaves)


def splat_rates(parameters: Parameters, extent: float) -> dict[str, LearningRate]:
    """Return the learning rates of NAMES by a method's parameters, positions times the scene extent."""
    p = parameters
    higher_degrees = [[p.lr_sh / 20]] * ((p.sh_degree + 1) ** 2 - 1)
    return {
        "means": p.lr_means * extent,
        "quats": p.lr_quats,
        "log_scales": p.lr_scales,
        "opacity_logits": p.lr_opacities,
        "sh": torch.tensor([[p.lr_sh], *higher_degrees]),
    }


def rates_at(parameters: DensityParameters, extent: float, step: int, steps: int) -> dict[str, LearningRate]:
    """Return the learning rates of NAMES at a step of a level, by the schedules of a method.

    Args:
        extent: scene extent, the unit of the rates of positions.
        step, steps: completed steps of the level, and all of them.
    """
    p = parameters
    factor = annealing(step / steps, p.lr_final)
    rates = {name: rate * factor for name, rate in splat_rates(p, extent).items()}
    means = log_linear(p.lr_means, p.lr_means_final, step / (p.lr_means_steps or steps))
    return rates | {"means": means * extent}


def _check_compatible(
    expected: Mapping[str, torch.Tensor], loaded: Mapping[str, torch.Tensor], count: int
) -> None:
    """Raise ValueError unless loaded tensors have ``count`` rows and match expected shapes and types."""
    if missing := expected.keys() - loaded.keys():
        raise ValueError(f"{sorted(missing)} are missing")
    for name, tensor in loaded.items():
        like = expected.get(name, tensor)
        if tensor.shape != (count, *like.shape[1:]) or tensor.dtype != like.dtype:
            raise ValueError(f"{name} is {tuple(tensor.shape)} of {tensor.dtype}, for {count} rows")
        if not tensor.is_contiguous():
            raise ValueError(f"{name} is not contiguous")

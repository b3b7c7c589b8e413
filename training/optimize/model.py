"""Trainable rows (splats, or anchors of splats) that come and go, with Adam's state in step.

The parametrisation of splats is that of 3DGS files (``training.splats.gaussians``), as torch tensors.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch

from ..rasterize import Adam, DeviceModel, Gaussians, Rendering, make_device_model
from ..rasterize.adam import LearningRate
from ..splats.gaussians import Splats
from .parameters import Parameters

NAMES = ("means", "quats", "log_scales", "opacity_logits", "sh")
"""The tensors that every splat has; a model of splats may train further ones, (N,), under other names."""
PEAK_STATS = ("gradient_max", "radius_max")
"""Stats that densification by maxima needs: as ``gradient_sum``, and in pixels, since the last reset."""


OUTSIDE = "outside"
"""Column of the rows beside which none are added, 1, where only a region is trained in detail."""
FROZEN = "held"
"""Column of the rows that stay as they are, 1, where there are such: what they are beside is trained."""


class Model:
    """N splats (or anchors of splats) under optimisation.

    Plain splats may be trained by the backend itself (:meth:`twin`). Whoever asks for the optimizer, a tensor
    or ``stats`` has them brought home before; all else (:meth:`look`, :meth:`rows`, :meth:`keep`, ...) leaves
    them there.

    Attributes:
        adam: the optimizer, which holds the trained tensors by name and their moments; ``means`` is one.
        lr: its learning rates by name.
        columns: what else is kept of every row and not trained, by name: zero for rows that come without it.
        stats: what is added up of every row between two resets, by name. ``gradient_sum`` and ``seen`` are
            always there.

    Args:
        tensors: the tensors to train, N rows each.
        lr: the learning rate of each.
        columns: as the attribute.
        stats: further ones than ``gradient_sum`` and ``seen``, or these in another shape than (N,); zeros.
        peaks: keep the stats ``gradient_max`` and ``radius_max`` as well.
    """

    def __init__(
        self,
        tensors: Mapping[str, torch.Tensor],
        lr: Mapping[str, LearningRate],
        columns: Mapping[str, torch.Tensor] | None = None,
        stats: Mapping[str, torch.Tensor] | None = None,
        peaks: bool = False,
    ) -> None:
        self._twin: DeviceModel | None = None
        self._adam = Adam({name: tensor.requires_grad_(True) for name, tensor in tensors.items()}, lr=lr)
        self.columns = dict(columns or {})
        blank = self["means"].detach().new_zeros(len(self))
        self.stats = {"gradient_sum": blank, "seen": blank.clone(), **(stats or {})}
        if peaks:
            self.stats |= {name: blank.clone() for name in PEAK_STATS}

    def __len__(self) -> int:
        return len(self._adam.tensors["means"] if self._twin is None else self._twin)

    def __getitem__(self, name: str) -> torch.Tensor:
        return self.adam.tensors[name]

    @property
    def adam(self) -> Adam:
        """The optimizer, with what is trained at home."""
        self._come_home()
        return self._adam

    @property
    def stats(self) -> dict[str, torch.Tensor]:
        """What is added up, by name, at home."""
        self._come_home()
        return self._stats

    @stats.setter
    def stats(self, stats: dict[str, torch.Tensor]) -> None:
        self._come_home()
        self._stats = stats

    @property
    def lr(self) -> dict[str, LearningRate]:
        """The optimizer's learning rates; what is trained stays where it is."""
        return self._adam.lr

    @lr.setter
    def lr(self, rates: dict[str, LearningRate]) -> None:
        self._adam.lr = rates

    def device_model(self, backend: str, antialias: bool) -> DeviceModel | None:
        """What a backend trains in the model's place, until somebody asks for what it is; see ``make_device_model``."""
        if self._twin is None and FROZEN not in self.columns:
            self._twin = make_device_model(backend, self._adam, self._stats, antialias=antialias)
        return self._twin

    def read(self, name: str) -> torch.Tensor:
        """A trained tensor's or a statistic's values, to read only: what is trained elsewhere stays there."""
        if self._twin is not None and (name in NAMES or name in self._stats):
            return self._twin.read(name)
        return self._stats[name] if name in self._stats else self._adam.tensors[name].detach()

    @property
    def _here(self) -> list[str]:
        """The trained tensors that are at home."""
        return [name for name in self._adam.tensors if self._twin is None or name not in NAMES]

    @property
    def _columns_here(self) -> list[dict[str, torch.Tensor]]:
        """What is kept of every row at home beside them."""
        return [self.columns, self._stats] if self._twin is None else [self.columns]

    def _come_home(self) -> None:
        twin, self._twin = self._twin, None
        if twin is not None:
            twin.copy_to_host()

    @property
    def gaussians(self) -> Gaussians:
        """The tensors as the rasterizer takes them, of a model of splats."""
        return Gaussians(*(self[name] for name in NAMES))

    def read_rows(self, index: torch.Tensor) -> dict[str, torch.Tensor]:
        """A copy of the trained tensors at indices (M,), by name."""
        here = {name: self._adam.tensors[name].detach()[index] for name in self._here}
        return here if self._twin is None else here | self._twin.read_rows(index)

    @torch.no_grad()
    def keep(self, mask: torch.Tensor) -> None:
        """Removes the rows where ``mask`` (N,), on any device, is False."""
        mask = mask.to(self._adam.tensors["means"].device)
        if not mask.any():
            self._come_home()
        if self._twin is not None and not mask.all():
            self._twin.select(torch.nonzero(mask).squeeze(1))
        for name in self._here:
            first, second = self._adam.state[name]
            self._replace(name, self._adam.tensors[name][mask], first[mask], second[mask])
        for kept in self._columns_here:
            kept.update({name: column[mask] for name, column in kept.items()})

    @torch.no_grad()
    def append(self, rows: Mapping[str, torch.Tensor]) -> None:
        """Adds rows at the end: every trained tensor's, and columns. Moments start at zero, as in 3DGS."""
        added = len(rows["means"])
        if self._twin is not None and added:
            self._twin.append({name: rows[name] for name in NAMES})
        for kept in self._columns_here:
            for name, column in kept.items():
                blank = column.new_zeros(added, *column.shape[1:])
                kept[name] = torch.cat([column, rows.get(name, blank)])
        for name in self._here:
            first, second = self._adam.state[name]
            blank = torch.zeros_like(rows[name])
            self._replace(
                name,
                torch.cat([self._adam.tensors[name], rows[name]]),
                torch.cat([first, blank]),
                torch.cat([second, blank]),
            )

    @torch.no_grad()
    def assign(self, name: str, values: torch.Tensor) -> None:
        """Gives a trained tensor new values and zero moments."""
        if self._twin is not None and name in NAMES:
            self._twin.assign(name, values)
        else:
            self._replace(name, values, torch.zeros_like(values), torch.zeros_like(values))

    @torch.no_grad()
    def raise_log_scales(self, least: torch.Tensor) -> None:
        """No log-scale of a splat is below its least one (N,) from here."""
        if self._twin is None:
            self["log_scales"].copy_(torch.maximum(self["log_scales"], least[:, None]))
        else:
            self._twin.raise_log_scales(least)

    def freeze_rows(self, rows: torch.Tensor) -> None:
        """From now on these rows, (N,) bool, stay as they are."""
        self.columns[FROZEN] = rows.to(self["means"])

    def freeze_gradients(self) -> None:
        """After ``backward``: rows that are held have no part in the step."""
        if FROZEN in self.columns:
            held = self.columns[FROZEN] > 0
            for tensor in self.adam.tensors.values():
                if tensor.grad is not None:
                    tensor.grad[held] = 0

    def accumulate_stats(self, rendering: Rendering, shrink: float = 1) -> None:
        """After ``backward``: adds up image-plane gradients' norms, and how often each splat was drawn.

        Where there are ``PEAKS``, these rise to the largest gradient and radius.

        Args:
            shrink: how many times smaller the photograph was, which made gradients as many times larger (see
                ``TrainingData.threshold_scale``).
        """
        gradient = rendering.grad2d.norm(dim=1) / shrink
        self.stats["gradient_sum"] += gradient
        self.stats["seen"] += rendering.radii > 0
        for name, now in zip(PEAK_STATS, (gradient, rendering.radii), strict=True):
            if name in self.stats:
                self.stats[name] = torch.maximum(self.stats[name], now)

    def reset_stats(self) -> None:
        """Begins anew with what is added up."""
        if self._twin is not None:
            self._twin.reset_stats()
            return
        for name, column in self.stats.items():
            self.stats[name] = torch.zeros_like(column)

    def mean_gradient(self) -> torch.Tensor:
        """Mean norm of the image-plane gradient over the views that drew each splat; as ``gradient_sum``."""
        return self.read("gradient_sum") / self.read("seen").clamp_min(1)

    def _replace(self, name: str, tensor: torch.Tensor, first: torch.Tensor, second: torch.Tensor) -> None:
        self._adam.replace(name, tensor.requires_grad_(True), first, second)

    def state_dict(self) -> dict:
        """Tensors and numbers, as ``torch.load(weights_only=True)`` reads them."""
        return {
            "tensors": {name: tensor.detach() for name, tensor in self.adam.tensors.items()},
            "columns": self.columns,
            "stats": self.stats,
            "adam": self.adam.state_dict(),
        }

    def load_state_dict(self, state: dict) -> None:
        """Becomes what ``state_dict`` gave, or stays as it is.

        Raises:
            ValueError: it is of another model, or its parts do not fit together.
        """
        tensors, columns, stats, adam = (state[name] for name in ("tensors", "columns", "stats", "adam"))
        count = len(tensors["means"])
        for ours, theirs in (
            (self.adam.tensors, tensors),
            ({name: first for name, (first, _) in self.adam.state.items()}, adam["m"]),
            ({name: second for name, (_, second) in self.adam.state.items()}, adam["v"]),
            (self.columns, columns),
            (self.stats, stats),
        ):
            _check_alike(ours, theirs, count)
        if not tensors.keys() == adam["steps"].keys() == self.adam.steps.keys():
            raise ValueError(f"there are steps of {sorted(adam['steps'])}, tensors {sorted(tensors)}")
        for name, tensor in tensors.items():
            self.adam.replace(name, tensor.requires_grad_(True))
        self.columns, self.stats = columns, stats
        self.adam.load_state_dict(adam)

    def splats(self, min_scale: float = 0.0) -> Splats:
        """A copy as plain arrays, with ``min_scale`` (FLoD, Eq. 4) baked into the scales.

        What is trained beside NAMES becomes ``extras``, float32.
        """
        arrays = {name: tensor.detach().cpu().numpy().copy() for name, tensor in self.adam.tensors.items()}
        if min_scale > 0:
            arrays["log_scales"] = np.log(np.exp(arrays["log_scales"]) + np.float32(min_scale))
        extras = {name: arrays.pop(name) for name in list(arrays) if name not in NAMES}
        return Splats(**arrays, extras=extras)


def splat_rates(parameters: Parameters, extent: float) -> dict[str, LearningRate]:
    """The learning rates of NAMES by a method's parameters, positions' times the scene extent."""
    p = parameters
    further = [[p.lr_sh / 20]] * ((p.sh_degree + 1) ** 2 - 1)
    return {
        "means": p.lr_means * extent,
        "quats": p.lr_quats,
        "log_scales": p.lr_scales,
        "opacity_logits": p.lr_opacities,
        "sh": torch.tensor([[p.lr_sh], *further]),
    }


def _check_alike(ours: Mapping[str, torch.Tensor], theirs: Mapping[str, torch.Tensor], count: int) -> None:
    """Raises ValueError unless tensors have ``count`` rows each, and those that others have are like them."""
    if missing := ours.keys() - theirs.keys():
        raise ValueError(f"{sorted(missing)} are missing")
    for name, tensor in theirs.items():
        like = ours.get(name, tensor)
        if tensor.shape != (count, *like.shape[1:]) or tensor.dtype != like.dtype:
            raise ValueError(f"{name} is {tuple(tensor.shape)} of {tensor.dtype}, for {count} rows")
        if not tensor.is_contiguous():
            raise ValueError(f"{name} is not contiguous")

"""Trainable splats, with plain functions that add and remove rows and keep Adam's state in step.

The parametrisation is that of 3DGS files (``training.splats.gaussians``), as torch tensors.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import KDTree

from ..errors import LodgsError
from ..rasterize import Adam, Rendering
from ..rasterize.features import rotation_matrices
from ..splats.gaussians import Splats
from .parameters import Parameters

NAMES = ("means", "quats", "log_scales", "opacity_logits", "sh")
SH_C0 = 0.28209479177387814


class Model:
    """N splats (or anchors of splats) under optimisation: tensors of N rows, ``means`` among them.

    Attributes:
        adam: the optimizer, which holds the tensors by name and their moments.
        columns: what else is kept of every row and not trained, by name: they follow when rows go, and are
            zero for rows that come without them. ``gradient_sum`` and ``seen`` are always there.
    """

    def __init__(
        self, tensors: dict[str, torch.Tensor], lr: dict, columns: dict[str, torch.Tensor] | None = None
    ) -> None:
        self.adam = Adam({name: tensor.requires_grad_(True) for name, tensor in tensors.items()}, lr=lr)
        self.columns = dict(columns or {})
        self.forget()

    def __len__(self) -> int:
        return len(self["means"])

    def __getitem__(self, name: str) -> torch.Tensor:
        return self.adam.tensors[name]

    @torch.no_grad()
    def keep(self, mask: torch.Tensor) -> None:
        """Removes the splats where ``mask`` (N,), on any device, is False."""
        mask = mask.to(self["means"].device)
        for name in list(self.adam.tensors):
            first, second = self.adam.state[name]
            self._replace(name, self[name][mask], first[mask], second[mask])
        self.columns = {name: column[mask] for name, column in self.columns.items()}

    @torch.no_grad()
    def append(self, rows: dict[str, torch.Tensor]) -> None:
        """Adds splats at the end; their moments start at zero, as in 3DGS."""
        added = len(rows["means"])
        for name, column in self.columns.items():
            blank = column.new_zeros(added, *column.shape[1:])
            self.columns[name] = torch.cat([column, rows.get(name, blank)])
        for name in list(self.adam.tensors):
            first, second = self.adam.state[name]
            blank = torch.zeros_like(rows[name])
            self._replace(
                name,
                torch.cat([self[name], rows[name]]),
                torch.cat([first, blank]),
                torch.cat([second, blank]),
            )

    @torch.no_grad()
    def assign(self, name: str, values: torch.Tensor) -> None:
        """Gives a parameter new values and forgets its moments."""
        self._replace(name, values, torch.zeros_like(values), torch.zeros_like(values))

    def forget(self) -> None:
        """Begins anew with what :meth:`remember` adds up."""
        for name in ("gradient_sum", "seen"):
            shape = self.columns[name].shape[1:] if name in self.columns else ()
            self.columns[name] = torch.zeros(len(self), *shape, device=self["means"].device)

    def remember(self, rendering: Rendering) -> None:
        """After ``backward``: adds up image-plane gradients' norms, and how often each splat was drawn."""
        self.columns["gradient_sum"] += rendering.grad2d.norm(dim=1)
        self.columns["seen"] += rendering.radii > 0

    def mean_gradient(self) -> torch.Tensor:
        """Mean norm of the image-plane gradient over the views that drew each splat; as ``gradient_sum``."""
        return self.columns["gradient_sum"] / self.columns["seen"].clamp_min(1)

    def _replace(self, name: str, tensor: torch.Tensor, first: torch.Tensor, second: torch.Tensor) -> None:
        self.adam.replace(name, tensor.requires_grad_(True), first, second)

    def state_dict(self) -> dict:
        """Tensors and numbers, as ``torch.load(weights_only=True)`` reads them."""
        return {
            "tensors": {name: tensor.detach() for name, tensor in self.adam.tensors.items()},
            "columns": self.columns,
            "adam": self.adam.state_dict(),
        }

    def load_state_dict(self, state: dict) -> None:
        """Becomes what ``state_dict`` gave."""
        for name, tensor in state["tensors"].items():
            self.adam.replace(name, tensor.requires_grad_(True))
        self.columns = state["columns"]
        self.adam.load_state_dict(state["adam"])

    def splats(self, min_scale: float = 0.0) -> Splats:
        """A copy as plain arrays, with ``min_scale`` (FLoD, Eq. 4) baked into the scales."""
        arrays = {name: self[name].detach().cpu().numpy().copy() for name in NAMES}
        if min_scale > 0:
            arrays["log_scales"] = np.log(np.exp(arrays["log_scales"]) + np.float32(min_scale))
        return Splats(**arrays, extras={})


def splat_model(
    tensors: dict[str, torch.Tensor],
    parameters: Parameters,
    extent: float,
    columns: dict[str, torch.Tensor] | None = None,
) -> Model:
    """A model of splats with the learning rates of the parameters, positions' times the scene extent."""
    p = parameters
    further = [[p.lr_sh / 20]] * ((p.sh_degree + 1) ** 2 - 1)
    lr = {
        "means": p.lr_means * extent,
        "quats": p.lr_quats,
        "log_scales": p.lr_scales,
        "opacity_logits": p.lr_opacities,
        "sh": torch.tensor([[p.lr_sh], *further]),
    }
    return Model(tensors, lr, columns)


def means_rate(parameters: Parameters, share: float, extent: float) -> float:
    """The positions' learning rate after a share of the steps: log-linear from the first to the last."""
    share = min(share, 1.0)
    return float(parameters.lr_means ** (1 - share) * parameters.lr_means_final**share) * extent


def distinct(points: np.ndarray, colors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points without exact repetitions, which have no distance to take a scale from."""
    points, index = np.unique(points, axis=0, return_index=True)
    if len(points) < 4:
        raise LodgsError(
            f"The scene has {len(points)} distinct 3D points; training needs at least 4 to begin with.",
            "Run COLMAP's triangulation again, or choose another model.",
        )
    return points, colors[index]


def neighbour_distances(means: np.ndarray, neighbours: int = 3) -> np.ndarray:
    """Distances to the nearest other points, (N, neighbours), in the unit of ``means``.

    With fewer points than neighbours, the missing ones are infinitely far.
    """
    distances, _ = KDTree(means).query(means, k=neighbours + 1, workers=-1)
    return distances[:, 1:]


def neighbour_scale(points: np.ndarray) -> np.ndarray:
    """Root mean square distance (N,) of the three nearest neighbours, above 0."""
    distances = neighbour_distances(points)
    finite = np.isfinite(distances)
    squared = np.where(finite, distances, 0) ** 2
    scale = np.sqrt(squared.sum(1) / np.maximum(finite.sum(1), 1))
    return np.maximum(scale, 1e-7 * max(float(np.ptp(points)), 1e-30))


def from_points(
    points: np.ndarray, colors: np.ndarray, sh_degree: int, device: torch.device | str = "cpu"
) -> dict[str, torch.Tensor]:
    """Splats from structure-from-motion points, as 3DGS begins: round, nearly transparent, coloured.

    Args:
        points: (N, 3) world coordinates, at least two distinct ones.
        colors: (N, 3) uint8, display-coded.
        sh_degree: the degree for which coefficients are made; those above 0 start at zero.
        device: where the tensors are made.

    Returns:
        Tensors by name; scales are the root mean square distance of the three nearest neighbours.
    """
    scale = neighbour_scale(points)
    count = len(points)
    sh = np.zeros((count, (sh_degree + 1) ** 2, 3), np.float32)
    sh[:, 0] = (colors.astype(np.float32) / 255 - 0.5) / SH_C0
    quats = np.zeros((count, 4), np.float32)
    quats[:, 0] = 1
    tensors = {
        "means": torch.tensor(points, dtype=torch.float32),
        "quats": torch.from_numpy(quats),
        "log_scales": torch.from_numpy(np.repeat(np.log(scale)[:, None], 3, 1).astype(np.float32)),
        "opacity_logits": torch.full((count,), float(np.log(0.1 / 0.9))),
        "sh": torch.from_numpy(sh),
    }
    return {name: tensor.to(device) for name, tensor in tensors.items()}


@torch.no_grad()
def densify(
    model: Model,
    gradients: torch.Tensor,
    *,
    threshold: float,
    clone_below: float,
    max_splats: int,
    min_scale: float,
    rng: np.random.Generator,
) -> int:
    """Clones small and splits large splats whose image-plane gradient is large (3DGS, Sec. 5.2).

    Args:
        gradients: (N,) mean norm of the image-plane gradient over the views that saw each splat.
        threshold: the gradient above which a splat is densified.
        clone_below: largest scale (scene units) that is cloned; larger ones are split in two.
        max_splats: the largest gradients come first until this number is reached.
        min_scale: FLoD's s_min; the scale that counts is exp(log_scales) + min_scale.
        rng: places the children of a split.

    Returns:
        How many splats were added.
    """
    chosen = torch.nonzero(gradients > threshold).squeeze(1)
    room = max(max_splats - len(model), 0)
    if len(chosen) > room:
        order = torch.argsort(gradients[chosen], descending=True, stable=True)
        chosen = chosen[order[:room]].sort().values
    if len(chosen) == 0:
        return 0
    scales = model["log_scales"][chosen].exp() + min_scale
    small = scales.amax(1) <= clone_below
    clones = {name: model[name][chosen[small]] for name in NAMES}
    parents, scales = chosen[~small], scales[~small]
    children = {name: model[name][parents].repeat((2,) + (1,) * (model[name].dim() - 1)) for name in NAMES}
    local = torch.from_numpy(rng.standard_normal((2 * len(parents), 3), np.float32)).to(scales)
    local = local * scales.repeat(2, 1)
    children["means"] += torch.einsum("nij,nj->ni", rotation_matrices(children["quats"]), local)
    children["log_scales"] = constrained_log(scales / 1.6, min_scale).repeat(2, 1)
    alive = torch.ones(len(model), dtype=torch.bool, device=parents.device)
    alive[parents] = False
    model.keep(alive)
    model.append({name: torch.cat([clones[name], children[name]]) for name in NAMES})
    return len(chosen)


def constrained_log(scales: torch.Tensor, min_scale: float, floor: float = 0.05) -> torch.Tensor:
    """s_opt with exp(s_opt) + min_scale = scales (FLoD, Eq. 5), where that is possible.

    The published code clamps the difference at 1e-7, from which a splat hardly ever grows again (its
    gradient is proportional to the difference); a share of ``min_scale`` leaves it free to move.
    """
    return (scales - min_scale).clamp_min(max(floor * min_scale, 1e-9)).log()

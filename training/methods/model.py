"""Trainable splats, with plain functions that add and remove rows and keep Adam's state in step.

The parametrisation is that of 3DGS files (``training.splats.gaussians``), as torch tensors.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import KDTree

from ..rasterize import Adam
from ..rasterize.features import rotation_matrices
from ..splats.gaussians import Splats

NAMES = ("means", "quats", "log_scales", "opacity_logits", "sh")
SH_C0 = 0.28209479177387814


class Model:
    """N splats under optimisation.

    Attributes:
        adam: the optimizer, which holds the tensors by name and their moments.
    """

    def __init__(self, tensors: dict[str, torch.Tensor], lr: dict) -> None:
        self.adam = Adam({name: tensor.requires_grad_(True) for name, tensor in tensors.items()}, lr=lr)

    def __len__(self) -> int:
        return len(self["means"])

    def __getitem__(self, name: str) -> torch.Tensor:
        return self.adam.tensors[name]

    @torch.no_grad()
    def keep(self, mask: torch.Tensor) -> None:
        """Removes the splats where ``mask`` (N,) is False."""
        for name in NAMES:
            first, second = self.adam.state[name]
            self._replace(name, self[name][mask], first[mask], second[mask])

    @torch.no_grad()
    def append(self, rows: dict[str, torch.Tensor]) -> None:
        """Adds splats at the end; their moments start at zero, as in 3DGS."""
        for name in NAMES:
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

    def _replace(self, name: str, tensor: torch.Tensor, first: torch.Tensor, second: torch.Tensor) -> None:
        self.adam.replace(name, tensor.requires_grad_(True), first, second)

    def state_dict(self) -> dict:
        """Tensors and numbers, as ``torch.load(weights_only=True)`` reads them."""
        return {"tensors": {name: self[name].detach() for name in NAMES}, "adam": self.adam.state_dict()}

    def load_state_dict(self, state: dict) -> None:
        """Becomes what ``state_dict`` gave."""
        for name, tensor in state["tensors"].items():
            self.adam.replace(name, tensor.requires_grad_(True))
        self.adam.load_state_dict(state["adam"])

    def splats(self, min_scale: float = 0.0) -> Splats:
        """A copy as plain arrays, with ``min_scale`` (FLoD, Eq. 4) baked into the scales."""
        columns = {name: self[name].detach().cpu().numpy().copy() for name in NAMES}
        if min_scale > 0:
            columns["log_scales"] = np.log(np.exp(columns["log_scales"]) + np.float32(min_scale))
        return Splats(**columns, extras={})


def neighbour_distances(means: np.ndarray, neighbours: int = 3) -> np.ndarray:
    """Distances to the nearest other points, (N, neighbours), in the unit of ``means``.

    With fewer points than neighbours, the missing ones are infinitely far.
    """
    distances, _ = KDTree(means).query(means, k=neighbours + 1, workers=-1)
    return distances[:, 1:]


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
    distances = neighbour_distances(points)
    finite = np.isfinite(distances)
    squared = np.where(finite, distances, 0) ** 2
    scale = np.sqrt(squared.sum(1) / np.maximum(finite.sum(1), 1))
    scale = np.maximum(scale, 1e-7 * max(float(np.ptp(points)), 1e-30))
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

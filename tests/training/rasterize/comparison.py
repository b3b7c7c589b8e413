"""Scenes that hold every backend against the reference, and everything that is compared on them."""

import numpy as np
import torch

from training.rasterize import OUTPUTS, Gaussians, contributions, rasterize

SCENES = [
    "degree 0", "degree 1", "degree 2", "degree 3", "degree 4", "active degree",
    "one", "antialiased", "antialiased some", "needles", "screen-filling", "behind and near", "caps", "crowd",
]  # fmt: skip
CONTRIBUTING = ["degree 3", "antialiased", "antialiased some", "needles", "screen-filling", "caps", "crowd"]


def scene(name, make_splats):
    """Splats and keyword arguments of ``rasterize``."""
    if name.startswith("degree"):
        return make_splats(250, coefficients=(int(name[-1]) + 1) ** 2), {}
    splats = make_splats({"one": 1, "crowd": 3000}.get(name, 250), seed=len(name))
    count = len(splats)
    random = np.random.default_rng(9)
    if name.startswith("antialiased"):
        splats.log_scales.sub_(1)
        splats.log_scales[::2, 0] += 2
    if name == "one":
        splats.means[:] = torch.tensor([[0.1, -0.2, 3.0]])
        splats.opacity_logits[:] = 1
    elif name == "needles":
        splats.log_scales[:, 0] = torch.from_numpy(random.uniform(-1, 0.5, count))
        splats.log_scales[:, 1:] = torch.from_numpy(random.uniform(-7, -5, (count, 2)))
    elif name == "screen-filling":
        splats.log_scales[::5] = 1.5
        splats.opacity_logits[::5] -= 2
    elif name == "behind and near":
        splats.means[:, 2] = torch.from_numpy(random.uniform(-1, 1, count))
    elif name == "caps":
        splats.opacity_logits[:] = torch.from_numpy(random.choice([-12.0, 3.0, 15.0], count))
    elif name == "crowd":
        splats.log_scales.add_(3)
        splats.opacity_logits[:] = torch.from_numpy(random.uniform(-5.1, -4.5, count))
    elif name == "active degree":
        return splats, {"sh_degree": 1}
    elif name == "antialiased some":
        return splats, {"antialias": torch.arange(count) % 3 == 0}
    return splats, {"antialias": name == "antialiased"}


def drawn_and_differentiated(name, make_splats, camera, backend, kind, device="cpu"):
    """Every output of ``rasterize``, and the gradients of a loss that all of them have a part in."""
    splats, options = scene(name, make_splats)
    random = torch.Generator().manual_seed(1)
    weights = 1.25 * torch.rand(len(splats), generator=random).double()  # some make opacities more than 1
    weights[3::7] = 0
    shade = torch.rand(50, 75, 3, generator=random).double().to(device, kind)
    tensors = (*vars(splats).values(), weights)
    *leaves, weights = (t.to(device, kind, copy=True).requires_grad_() for t in tensors)
    leaves = Gaussians(*leaves)
    drawn = rasterize(
        leaves, camera, weights=weights, background=(0.1, 0.5, 0.3), min_scale=0.01,
        near=0.2, outputs=OUTPUTS, backend=backend, **options,
    )  # fmt: skip
    loss = ((drawn.image - shade) ** 2).mean() + (drawn.alpha * shade[..., 0]).mean()
    loss = loss + 0.1 * (drawn.depth * shade[..., 1]).mean() + (drawn.normals * shade).mean()
    loss.backward()
    found = {name: leaf.grad for name, leaf in (vars(leaves) | {"weights": weights}).items()}
    found |= {name: getattr(drawn, name) for name in ("image", "alpha", "depth", "normals", "radii")}
    found |= {name: getattr(drawn, name) for name in ("grad2d", "absgrad2d", "tile_counts")}
    return {name: tensor.detach().cpu().double() for name, tensor in found.items()}


def contributed(name, make_splats, camera, backend, kind, device="cpu"):
    """``contributions`` of a scene's first splats, and Σ alpha of the picture that they make."""
    splats, options = scene(name, make_splats)
    splats = splats.select(slice(400)).to(device, kind)
    options.pop("sh_degree", None)
    weights = torch.linspace(0, 1, len(splats)).to(device, kind)
    options |= {"weights": weights, "min_scale": 0.01, "near": 0.2, "backend": backend}
    drawn = rasterize(splats, camera, **options)
    found = contributions(splats, [camera], **options)
    return {name: tensor.cpu() for name, tensor in vars(found).items()}, drawn.alpha.sum().item()

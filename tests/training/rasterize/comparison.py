"""Scenes and results that compare every backend with the reference."""

import math

import numpy as np
import torch

from training.rasterize import OUTPUTS, Gaussians, contributions, rasterize, reference

SH_C0 = 0.28209479177387814
SCENES = [
    "degree 0", "degree 1", "degree 2", "degree 3", "degree 4", "active degree",
    "one", "antialiased", "antialiased some", "needles", "screen-filling", "behind and near", "caps", "crowd",
]  # fmt: skip
CONTRIBUTING = ["degree 3", "antialiased", "antialiased some", "needles", "screen-filling", "caps", "crowd"]


def scene(name, make_splats):
    """Return splats and keyword arguments of ``rasterize`` by the scene's name."""
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
    """Return every output of ``rasterize``, and the gradients of a loss on all of them."""
    splats, options = scene(name, make_splats)
    random = torch.Generator().manual_seed(1)
    weights = 1.25 * torch.rand(len(splats), generator=random).double()  # some opacities exceed 1
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
    results = {name: leaf.grad for name, leaf in (vars(leaves) | {"weights": weights}).items()}
    results |= {name: getattr(drawn, name) for name in ("image", "alpha", "depth", "normals", "radii")}
    results |= {name: getattr(drawn, name) for name in ("grad2d", "absgrad2d", "tile_counts")}
    return {name: tensor.detach().cpu().double() for name, tensor in results.items()}


_exact: dict[tuple[str, float], dict[str, torch.Tensor]] = {}


def exact_results(name, make_splats, camera):
    """Return ``drawn_and_differentiated`` of the float64 reference, computed once for each scene."""
    key = name, reference.ALPHA_MAX
    if key not in _exact:
        _exact[key] = drawn_and_differentiated(name, make_splats, camera, "reference", torch.float64)
    return _exact[key]


def contributed(name, make_splats, camera, backend, kind, device="cpu"):
    """Return the contributions of a scene's first splats, and Σ alpha of their image."""
    splats, options = scene(name, make_splats)
    splats = splats.select(slice(400)).to(device, kind)
    options.pop("sh_degree", None)
    weights = torch.linspace(0, 1, len(splats)).to(device, kind)
    options |= {"weights": weights, "min_scale": 0.01, "near": 0.2, "backend": backend}
    drawn = rasterize(splats, camera, **options)
    measured = contributions(splats, [camera], **options)
    return {name: tensor.cpu() for name, tensor in vars(measured).items()}, drawn.alpha.sum().item()


def isotropic(depths, sigma, opacities, colours, kind=torch.float32):
    """Create isotropic splats on the z axis."""
    count = len(depths)
    means = torch.zeros(count, 3)
    means[:, 2] = torch.tensor(depths)
    quats = torch.tensor([[2.0, 0.0, 0.0, 0.0]]).repeat(count, 1)
    logits = torch.logit(torch.tensor(opacities))
    sh = (torch.tensor(colours).reshape(count, 1, 3) - 0.5) / SH_C0
    log_scales = torch.full((count, 3), math.log(sigma))
    return Gaussians(means, quats, log_scales, logits, sh).map(lambda t: t.to(kind).requires_grad_())


def squared_distance():
    """Return the squared distances from image point (16, 16) to the pixel centres of a 32x32 image."""
    offset = np.arange(32) + 0.5 - 16
    return offset[None, :] ** 2 + offset[:, None] ** 2

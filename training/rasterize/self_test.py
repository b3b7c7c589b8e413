"""Whether a graphics device draws what the reference draws: tried before it is first used."""

from __future__ import annotations

import hashlib
import json
import sys
import traceback
from contextlib import suppress
from dataclasses import replace
from functools import cache
from importlib import metadata
from pathlib import Path
from types import ModuleType

import numpy as np
import torch

from ..documents import read_json
from ..errors import LodgsError
from ..files import atomic_write, cache_folder
from ..scenes.cameras import Camera
from . import gpu, reference
from .gaussians import Gaussians
from .gpu.device import Adapter
from .rendering import KernelCamera, RasterSettings, Target

ANSWERS = "devices.json"
"""File in the user's cache folder that keeps the answers."""
PICTURE_TOLERANCE, GRADIENT_TOLERANCE = 2e-3, 1e-2
"""Most that a device may differ by, of the norm of what the reference has. A pixel whose alpha is rounded
across its threshold differs by a 255th."""

MOST_REASON = 300
"""Characters that are told of a failure; all of it goes to standard error."""


@cache
def failure(adapter: Adapter) -> str:
    """In what the chosen device's pictures or gradients differ from the reference's; empty if in nothing.

    A device is tested once for each of its drivers and each state of this backend; the answer is kept.

    Raises:
        LodgsError: it was lost, or is out of memory.
    """
    key, answers = _key(adapter), cache_folder() / ANSWERS
    with suppress(LodgsError):
        if isinstance(known := read_json(answers).get(key), str):
            return known
    return run_self_test(adapter)


def run_self_test(adapter: Adapter) -> str:
    """:func:`failure`, found anew."""
    try:
        found = _compared()
    except LodgsError:
        raise
    except Exception as error:  # of a driver's compiler, which nobody has seen
        traceback.print_exc(file=sys.stderr)
        found = f"it failed ({' '.join(f'{type(error).__name__}: {error}'.split())[:MOST_REASON]})"
    with suppress(LodgsError):
        _remember(_key(adapter), found)
    return found


def _compared() -> str:
    """What the device that is chosen does otherwise than the reference."""
    ours, again = (_drawn(gpu, torch.float32) for _ in range(2))
    for name, truth in _truth().items():
        most = PICTURE_TOLERANCE if name == "pictures" else GRADIENT_TOLERANCE
        off = ((ours[name] - truth).norm() / truth.norm()).item()
        if not off <= most:  # not a number is neither
            return f"its {name} are {off:.0%} off"
        if not torch.equal(ours[name], again[name]):
            return f"its {name} change from run to run"
    return ""


@cache
def _truth() -> dict[str, torch.Tensor]:
    return _drawn(reference, torch.float64)


def _drawn(backend: ModuleType, kind: torch.dtype) -> dict[str, torch.Tensor]:
    """Pictures of some splats, and the gradients of what they lack of a photograph."""
    random, count, size = np.random.default_rng(0), 200, (50, 75)
    arrays = {
        "means": random.uniform((-1, -1, 2), (1, 1, 4), (count, 3)),
        "quats": random.normal(size=(count, 4)),
        "log_scales": random.normal(-2.5, 0.8, (count, 3)),
        "opacity_logits": random.normal(0, 2, count),
        "sh": random.normal(0, 0.4, (count, 16, 3)),
        "weights": random.uniform(0, 1, count),
        "features": random.normal(size=(count, 2)),
    }
    leaves = {
        name: torch.tensor(array, dtype=torch.float32).to(kind).requires_grad_()
        for name, array in arrays.items()
    }
    weights, features = leaves["weights"], leaves["features"]
    splats = Gaussians(*(leaves[name] for name in Gaussians.__dataclass_fields__))
    camera = Camera("", size[1], size[0], 60.0, 66.0, 33.0, 27.5, np.eye(4))
    view = RasterSettings(KernelCamera.of(camera, 0.2), 0.01, False, (0.1, 0.5, 0.3), degree=3, absolute=True)
    plain, sharp = (
        backend.rasterize(splats, weights, features, settings)
        for settings in (view, replace(view, antialias=True, degree=1))
    )
    target = Target(torch.tensor(random.uniform(0, 1, (*size, 3)), dtype=torch.float32).to(kind))
    loss = backend.photometric_loss(plain.image, target, 0.2) + sharp.image.square().mean()
    (loss + plain.alpha.mean() + (plain.features * sharp.features).mean()).backward()
    pictures = (plain.image, plain.features, sharp.image, sharp.alpha[..., None])
    found = {"pictures": torch.cat(pictures, 2).detach()}
    found |= {f"gradients of {name}": leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}
    found["gradients in the picture"] = torch.cat([plain.grad2d, plain.absgrad2d], 1)
    return {name: tensor.double() for name, tensor in found.items()}


@cache
def _key(adapter: Adapter) -> str:
    """What an answer counts for: an adapter with its driver, wgpu, and this backend as it is."""
    digest = hashlib.sha256("\n".join([*adapter, metadata.version("wgpu")]).encode())
    for path in sorted((Path(__file__).parent / "gpu").rglob("*.*")):
        if path.suffix in (".py", ".wgsl"):
            digest.update(path.read_bytes())
    return digest.hexdigest()[:32]


def _remember(key: str, found: str) -> None:
    path, known = cache_folder() / ANSWERS, {}
    with suppress(LodgsError):
        known = read_json(path)
    newest = dict(list({**known, key: found}.items())[-50:])
    with atomic_write(path) as temporary:
        Path(temporary).write_text(json.dumps(newest), encoding="utf-8")

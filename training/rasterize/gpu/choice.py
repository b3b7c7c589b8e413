"""Which graphics device draws, and whether it draws what the reference draws."""

from __future__ import annotations

import hashlib
import json
import os
from contextlib import suppress
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import ModuleType

import numpy as np
import torch

from ...documents import read_json
from ...errors import LodgsError
from ...files import atomic_write, cache_folder
from ...scenes.cameras import Camera
from ..gaussians import Gaussians
from ..rendering import Settings, Target, View
from .device import Adapter, Device, adapters, open_device

VARIABLE = "LODGS_GPU"
"""Environment variable with the name of the device to use, or a part of it; or "software"."""
ANSWERS = "devices.json"
"""File in the user's cache folder that keeps the self-test's answers."""
PICTURE_TOLERANCE, GRADIENT_TOLERANCE = 2e-3, 1e-2
"""Most that a device may differ by, of the norm of what the reference has. A pixel whose alpha is rounded
across its threshold differs by a 255th."""


def chosen() -> Adapter:
    """The device that is used: the one that ``LODGS_GPU`` names, else the best that is no software.

    Raises:
        LodgsError: there is none.
    """
    wanted, found = os.environ.get(VARIABLE, "").strip().casefold(), adapters()
    for adapter in found:
        if wanted in (adapter.name.casefold(), adapter.kind):
            return adapter
    for adapter in found:
        if wanted in adapter.name.casefold() if wanted else not adapter.software:
            return adapter
    names = ", ".join(adapter.name for adapter in found)
    if wanted:
        raise LodgsError(
            f'There is no graphics device "{wanted}" here, as {VARIABLE} has it.', f"There are: {names}."
        )
    raise LodgsError(
        f"This computer has no graphics device that helps: {names} runs on the processor, slower than the "
        "cpu backend.",
        "Train on the CPU (Train On in Blender, backend = auto or cpu in a job), or install the driver of "
        "your graphics card.",
    )


def open_chosen() -> Device:
    """:func:`chosen`, opened once; LodgsError as there, or it cannot be opened."""
    return open_device(chosen().name)


@cache
def difference(adapter: Adapter) -> str:
    """In what the chosen device's pictures or gradients differ from the reference's; empty if in nothing.

    A device is tested once for each of its drivers and each state of this backend; the answer is kept.

    Raises:
        LodgsError: it was lost, or is out of memory.
    """
    key, answers = _key(adapter), cache_folder() / ANSWERS
    with suppress(LodgsError):
        if isinstance(known := read_json(answers).get(key), str):
            return known
    return test(adapter)


def test(adapter: Adapter) -> str:
    """:func:`difference`, found anew."""
    from .. import gpu, reference

    theirs = _drawn(reference, torch.float64)
    ours, again = (_drawn(gpu, torch.float32) for _ in range(2))
    found = ""
    for name, truth in theirs.items():
        most = PICTURE_TOLERANCE if name == "pictures" else GRADIENT_TOLERANCE
        off = ((ours[name] - truth).norm() / truth.norm()).item()
        if not off <= most:  # not a number is neither
            found = f"its {name} are {off:.0%} off"
            break
        if not torch.equal(ours[name], again[name]):
            found = f"its {name} change from run to run"
            break
    with suppress(LodgsError):
        _remember(_key(adapter), found)
    return found


def _drawn(backend: ModuleType, kind: torch.dtype) -> dict[str, torch.Tensor]:
    """Pictures of some splats, and the gradients of what they lack of a photograph."""
    random, count, size = np.random.default_rng(0), 400, (50, 75)
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
    view = Settings(View.of(camera, 0.2), 0.01, False, (0.1, 0.5, 0.3), degree=3, absolute=True)
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
    from importlib import metadata

    digest = hashlib.sha256("\n".join([*adapter, metadata.version("wgpu")]).encode())
    for path in sorted(Path(__file__).parent.rglob("*.*")):
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

"""Self-tests of graphics devices: compare their results with the reference before their first use."""

from __future__ import annotations

import hashlib
import json
import sys
import traceback
from collections.abc import Sequence
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

RESULTS = "devices.json"
"""File in the user's cache folder that stores the results."""
IMAGE_TOLERANCE, GRADIENT_TOLERANCE = 2e-3, 1e-2
"""Maximum L2 errors relative to the reference. A pixel whose alpha is rounded across its threshold differs by
1/255."""

REASON_LENGTH = 300
"""Maximum length of a reported failure; standard error gets all of it."""


@cache
def find_failure(adapter: Adapter) -> str:
    """Return why the default device of the gpu backend fails the self-test; empty if it passes.

    The result is stored, so each version of driver and backend is tested once.

    Raises:
        LodgsError: the device was lost or is out of memory.
    """
    stored = _stored_result(result_key(adapter))
    return run_self_test(adapter) if stored is None else stored


def run_self_test(adapter: Adapter) -> str:
    """Run the self-test and store its result; see :func:`find_failure`."""
    try:
        reason = _compare(gpu, "cpu", repeatable=True)
    except LodgsError:
        raise
    except Exception as error:  # shader compilers of drivers fail in unpredictable ways
        traceback.print_exc(file=sys.stderr)
        reason = f"it failed ({' '.join(f'{type(error).__name__}: {error}'.split())[:REASON_LENGTH]})"
    store_result(RESULTS, result_key(adapter), reason)
    return reason


def find_difference(backend: ModuleType, device: str, parts: Sequence[str]) -> str:
    """Return why a backend's results differ from the reference's; empty if they are close.

    Args:
        device: torch device of its tensors.
        parts: texts that identify the device, its software and the kernels. A passed test is stored for them.
            A failed one is repeated in the next process, because they do not name the driver.
    """
    key = hashlib.sha256("\n".join(parts).encode()).hexdigest()[:32]
    if _stored_result(key) == "":
        return ""
    difference = _compare(backend, device, repeatable=False)
    if not difference:
        store_result(RESULTS, key, "")
    return difference


def _stored_result(key: str) -> str | None:
    with suppress(LodgsError):
        if isinstance(stored := read_json(cache_folder() / RESULTS).get(key), str):
            return stored
    return None


def _compare(backend: ModuleType, device: str, repeatable: bool) -> str:
    """Return the difference between a backend's results and the reference's; empty if acceptable.

    Args:
        device: torch device of the backend's tensors.
        repeatable: also require equal bits of two runs.
    """
    first = _results(backend, torch.float32, device)
    second = _results(backend, torch.float32, device) if repeatable else first
    for name, truth in _reference_results().items():
        tolerance = IMAGE_TOLERANCE if name == "images" else GRADIENT_TOLERANCE
        error = ((first[name] - truth).norm() / truth.norm()).item()
        if not error <= tolerance:  # also if NaN
            return f"its {name} are {error:.0%} off"
        if not torch.equal(first[name], second[name]):
            return f"its {name} change from run to run"
    return ""


@cache
def _reference_results() -> dict[str, torch.Tensor]:
    return _results(reference, torch.float64)


def _results(backend: ModuleType, kind: torch.dtype, device: str = "cpu") -> dict[str, torch.Tensor]:
    """Render random splats and differentiate a loss; return images and gradients by name."""
    random = np.random.default_rng(0)
    count = 200
    size = 50, 75
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
        name: torch.tensor(array, dtype=torch.float32).to(device, kind).requires_grad_()
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
    target = Target(torch.tensor(random.uniform(0, 1, (*size, 3)), dtype=torch.float32).to(device, kind))
    loss = backend.photometric_loss(plain.image, target, 0.2) + sharp.image.square().mean()
    (loss + plain.alpha.mean() + (plain.features * sharp.features).mean()).backward()
    images = (plain.image, plain.features, sharp.image, sharp.alpha[..., None])
    results = {"images": torch.cat(images, 2).detach()}
    results |= {f"gradients of {name}": leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}
    results["image-plane gradients"] = torch.cat([plain.grad2d, plain.absgrad2d], 1)
    return {name: tensor.cpu().double() for name, tensor in results.items()}


@cache
def result_key(adapter: Adapter) -> str:
    """Return a key of a result: a digest of adapter, driver, wgpu and this backend's source."""
    digest = hashlib.sha256("\n".join([*adapter, metadata.version("wgpu")]).encode())
    folder = Path(__file__).parent
    for path in (folder / "source.py", *sorted((folder / "gpu").rglob("*.*"))):
        if path.suffix in (".py", ".wgsl"):
            digest.update(path.read_bytes())
    return digest.hexdigest()[:32]


def store_result(name: str, key: str, result: object) -> None:
    """Store a result in a file of the cache folder, if possible; the file keeps the newest 50."""
    path = cache_folder() / name
    results = {}
    with suppress(LodgsError):
        results = read_json(path)
    newest = dict(list({**results, key: result}.items())[-50:])
    with suppress(LodgsError), atomic_write(path) as temporary:
        Path(temporary).write_text(json.dumps(newest), encoding="utf-8")

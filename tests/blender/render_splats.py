"""Render splats with the trainer's cpu rasterizer, as independent truth for viewports.

The trainer's Python runs it, from the repository. For each line "IN.npz<tab>OUT.npy" on standard input it
renders an image and answers with a line. IN has the arguments of ``training.rasterize.rasterize`` as arrays,
and the camera's size, intrinsics and world_to_camera.
"""

import sys
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from training.rasterize import Gaussians, rasterize
from training.scenes.cameras import Camera

NAMES = ("means", "quats", "log_scales", "opacity_logits", "sh")


def render(arguments) -> np.ndarray:
    """Return the image (H, W, 3) of arguments in arrays."""
    size, intrinsics = map(int, arguments["size"]), map(float, arguments["intrinsics"])
    camera = Camera("view", *size, *intrinsics, arguments["world_to_camera"])
    tensors = [torch.tensor(arguments[name], dtype=torch.float32) for name in NAMES]
    weights = torch.tensor(arguments["weights"], dtype=torch.float32) if "weights" in arguments else None
    antialias = torch.tensor(arguments["antialias"]) if "antialias" in arguments else False
    return rasterize(
        Gaussians(*tensors), camera, weights=weights, near=float(arguments["near"]),
        antialias=antialias, backend="cpu",
    ).image.numpy()  # fmt: skip


for line in sys.stdin:
    source, target = line.rstrip("\n").split("\t")
    np.save(target, render(np.load(source)))
    print("done", flush=True)

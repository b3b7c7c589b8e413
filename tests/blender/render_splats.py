"""Draws splats with the trainer's cpu rasterizer: an independent truth for what viewports draw.

Run by the trainer's Python, from the repository: ``render_splats.py IN.npz OUT.npy``. IN holds the arguments
of ``training.rasterize.rasterize`` as arrays, and the camera's width, height, intrinsics and world_to_camera.
"""

import sys
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from training.rasterize import Gaussians, rasterize
from training.scenes.cameras import Camera

given = np.load(sys.argv[1])
camera = Camera("view", *map(int, given["size"]), *map(float, given["intrinsics"]), given["world_to_camera"])
names = ("means", "quats", "log_scales", "opacity_logits", "sh")
tensors = [torch.tensor(given[name], dtype=torch.float32) for name in names]
weights = torch.tensor(given["weights"], dtype=torch.float32) if "weights" in given else None
antialias = torch.tensor(given["antialias"]) if "antialias" in given else False
drawn = rasterize(
    Gaussians(*tensors),
    camera,
    weights=weights,
    near=float(given["near"]),
    antialias=antialias,
    backend="cpu",
)
np.save(sys.argv[2], drawn.image.numpy())

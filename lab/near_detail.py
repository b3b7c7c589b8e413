"""Measure the detail of levels made from splats, near their surface.

Compares renders of the selected levels with the finest level at 0.25, 0.5 and 1 times the scene's size from
its surface, from close views that training did not see: ``python lab/near_detail.py BUNDLE``. Prints the
mean and the lowest PSNR, and the share of splats drawn.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import torch

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from training.api import load_bundle, render_image, select  # noqa: E402
from training.evaluate.metrics import psnr  # noqa: E402
from training.scenes.viewpoints import CLOSE, close_views, opaque_means  # noqa: E402

SEEN = 64
"""Number of close views that training may have seen: the first ones."""


def main() -> None:
    parser = argparse.ArgumentParser(description="Measure the detail of levels near the surface.")
    parser.add_argument("bundle", type=Path)
    parser.add_argument("--views", type=int, default=8, help="number of views at each distance")
    parser.add_argument("--width", type=int, default=480, help="image width in pixels")
    options = parser.parse_args()
    bundle = load_bundle(options.bundle)
    complete = bundle.levels[-1].splats
    views = close_views(
        opaque_means(complete), SEEN + len(CLOSE) * options.views, options.width, options.width * 2 // 3
    )[SEEN:]
    print("distance  mean dB  lowest dB  splats drawn")
    for number, distance in enumerate(CLOSE):
        likeness, shares = [], []
        for view in views[(number - SEEN) % len(CLOSE) :: len(CLOSE)]:
            rows = [rows for rows, _ in select(bundle, view.center, view.focal).values()]
            shares.append(sum(map(len, rows)) / len(complete))
            images = [render_image(bundle, view, controls=controls) for controls in ({}, None)]
            likeness.append(psnr(*(torch.from_numpy(image).clamp(0, 1) for image in images)))
        print(f"{distance:8}  {np.mean(likeness):7.1f}  {min(likeness):9.1f}  {np.mean(shares):12.0%}")


if __name__ == "__main__":
    main()

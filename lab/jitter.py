"""Copy a scene with random exposure changes of its photos, to evaluate ``lr_exposure``.

    python lab/jitter.py SCENE COPY [--stops 0.7]
    python tools/bench_quality.py COPY SCENE --report --methods 3dgs --shares 1 --set lr_exposure=0.01

``psnr`` includes exposure errors, ``fitted_psnr`` does not. The exposure of each photo changes by a random
number of stops; photos that ``train`` holds out stay unchanged, so that the ground truth is the same.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from pathlib import Path

import numpy as np
from PIL import Image

HERE = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(HERE))

from training.errors import LodgsError  # noqa: E402
from training.scenes.colmap import read_scene  # noqa: E402
from training.scenes.color import linear_from_srgb, srgb_from_linear  # noqa: E402

MAX_STOPS = 10.0


def exposed(pixels: np.ndarray, stops: float) -> np.ndarray:
    """Return a photo (H, W, 3) uint8 with 2^stops times the light; values above white are clipped."""
    linear = linear_from_srgb(pixels / 255.0) * 2.0**stops
    return np.round(255 * srgb_from_linear(np.clip(linear, 0, 1))).astype(np.uint8)


def jittered(scene: Path, copy: Path, stops: float, seed: int, test_every: int) -> dict[str, float]:
    """Write a copy with changed exposures.

    Args:
        scene, copy: folders.
        stops: maximum change, up or down.
        seed: random seed.
        test_every: every n-th photo by name stays unchanged, as in ``Scene.split``.

    Returns:
        The stops of each changed photo, by name.

    Raises:
        LodgsError: the scene cannot be read, or the copy exists.
    """
    if not 0 <= stops <= MAX_STOPS:
        raise LodgsError(f"Invalid stops = {stops}.", f"Give a number from 0 to {MAX_STOPS}.")
    if copy.exists():
        raise LodgsError(f"Cannot write copy: {copy} already exists.", "Choose another folder.")
    train, _ = read_scene(scene).split(test_every)
    changes = np.random.default_rng(seed).uniform(-stops, stops, len(train))
    shutil.copytree(scene, copy)
    for camera, change in zip(train, changes, strict=True):
        if camera.image is None:
            continue
        path = copy / camera.image.relative_to(scene)
        changed = exposed(np.asarray(Image.open(path).convert("RGB")), change)
        Image.fromarray(changed).save(path, quality=97)
    return {camera.name: float(change) for camera, change in zip(train, changes, strict=True)}


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", type=Path, metavar="SCENE")
    parser.add_argument("copy", type=Path, metavar="COPY")
    parser.add_argument("--stops", type=float, default=0.7)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--test-every", type=int, default=8)
    args = parser.parse_args()
    try:
        changes = jittered(args.scene, args.copy, args.stops, args.seed, args.test_every)
    except LodgsError as error:
        print(error.what, error.remedy, file=sys.stderr)
        return 2
    print(
        f"Changed {len(changes)} photos by {min(changes.values()):+.2f} to {max(changes.values()):+.2f} stops"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())

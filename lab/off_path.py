"""Analyse errors of the example off its path by the number of training views that see a pixel's surface.

    python -m examples.build_scene build/example --samples 1 --percentage 50 --cameras view aside
    python -m training train --scene examples/lantern_garden --method 3dgs --out build/run
    python lab/off_path.py build/run build/example

The surfaces come from the renderer, at the run's image scale. Held-out views on the path are for comparison.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(HERE))

from examples.write_model import depths_of, read_positions  # noqa: E402
from training.errors import LodgsError  # noqa: E402
from training.evaluate.metrics import to_8_bit  # noqa: E402
from training.evaluate.views import Evaluation, full_detail_source  # noqa: E402
from training.rasterize import Gaussians, rasterize  # noqa: E402
from training.runs.data import training_data  # noqa: E402
from training.runs.folder import RunFolder  # noqa: E402
from training.runs.job import Job  # noqa: E402
from training.scenes.cameras import Camera  # noqa: E402
from training.scenes.offset_views import read_offset_views  # noqa: E402
from training.scenes.visibility import visible_points  # noqa: E402
from training.splats.bundle import read_bundle  # noqa: E402

MIN_VIEWS = 2
"""Number of training views that determine a surface."""
ROW_VIEWS = (0, 1, 2, 5, 15)
"""Minimum number of training views for each row of the table; the next row starts the next class."""
RIGHT = 0.02
"""Maximum relative error of a correct depth."""


def decibels(errors: np.ndarray) -> float:
    """Return the PSNR of pixels with these mean squared errors."""
    return float(-10 * np.log10(errors.mean())) if len(errors) else float("nan")


def positions(rendered: Path, camera: Camera) -> np.ndarray:
    """Read the surface positions under a view's pixels, (H, W, 3).

    Raises:
        LodgsError: the positions were rendered at another size.
    """
    surface = read_positions(rendered / "positions" / f"{Path(camera.name).stem}.exr")
    if surface.shape[:2] != (camera.height, camera.width):
        raise LodgsError(
            f"{camera.name} was rendered at {surface.shape[1]}x{surface.shape[0]}, "
            f"but trained at {camera.width}x{camera.height}.",
            "Run build_scene with the --percentage of the run's image scale.",
        )
    return surface


def pixels(
    evaluation: Evaluation, splats: Gaussians, cameras: Sequence[Camera], rendered: Path
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield for each view its pixels' (P,) squared errors, numbers of training views and relative depths."""
    train = [(camera, depths_of(positions(rendered, camera), camera)) for camera in evaluation.data.train]
    for camera in cameras:
        surface = positions(rendered, camera)
        rendering = rasterize(splats, camera, near=evaluation.data.near, antialias=evaluation.antialias,
                          outputs=("median_depth",), backend=evaluation.backend)  # fmt: skip
        assert rendering.median_depth is not None
        difference = to_8_bit(rendering.image.cpu()) - evaluation.target(camera).image
        views = np.sum(
            [visible_points(depths, view, surface.reshape(-1, 3))[1] for view, depths in train], axis=0
        )
        depths = rendering.median_depth.cpu().numpy() / depths_of(surface, camera)
        yield difference.square().mean(2).numpy().ravel(), views, depths.ravel()


def report(run: Path, rendered: Path) -> Iterator[str]:
    """Yield lines about a run's views off the path and its held-out views.

    Raises:
        LodgsError: the run or the scene cannot be read.
    """
    if not rendered.is_dir():
        raise LodgsError(f"The folder {rendered} does not exist.", "Render it with examples/build_scene.py.")
    folder = RunFolder(run)
    job, bundle = Job.from_file(folder.job), read_bundle(folder.bundle)
    evaluation = Evaluation(training_data(job, folder), job.backend, bundle.antialias)
    all_splats, _ = full_detail_source(bundle, bundle.levels[-1])(evaluation.data.train[0])
    splats = evaluation.load(all_splats)
    aside = [camera.scaled(job.image_scale) for camera in read_offset_views(Path(job.scene))]
    for name, cameras in (("off the path", aside), ("on the path", evaluation.data.test)):
        views_pixels = list(pixels(evaluation, splats, cameras, rendered))
        overall = np.mean([decibels(errors) for errors, _, _ in views_pixels])
        determined = np.mean([decibels(errors[views >= MIN_VIEWS]) for errors, views, _ in views_pixels])
        yield (
            f"{name}: {overall:.2f} dB, {determined:.2f} dB where at least {MIN_VIEWS} training views see "
            "the surface"
        )
        errors, views, depths = map(np.concatenate, zip(*views_pixels, strict=True))
        ends = (*ROW_VIEWS[1:], np.inf)
        rows = [
            (f"{low} or more views", (views >= low) & (views < high))
            for low, high in zip(ROW_VIEWS, ends, strict=True)
        ]
        right = np.abs(depths - 1) <= RIGHT
        rows += [
            ("correct depth", (views >= MIN_VIEWS) & right),
            ("wrong depth", (views >= MIN_VIEWS) & ~right),
        ]
        for label, mask in rows:
            share, quality = errors[mask].sum() / errors.sum(), decibels(errors[mask])
            yield f"  {label:<20} {mask.mean():6.1%} of pixels {share:6.1%} of the error {quality:6.2f} dB"


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path, metavar="RUN")
    parser.add_argument("rendered", type=Path, help="output folder of build_scene")
    args = parser.parse_args()
    try:
        for line in report(args.run, args.rendered):
            print(line)
    except LodgsError as error:
        print(error.what, error.remedy, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())

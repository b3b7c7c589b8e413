"""Where pictures of the example lose off its path: by how many training views see a pixel's surface.

    python -m examples.build_scene build/example --samples 1 --percentage 50 --cameras view aside
    python -m training train --scene examples/lantern_garden --method 3dgs --out build/run
    python lab/off_path.py build/run build/example

The surfaces are the renderer's, drawn at the run's image scale. Held-out views beside it stand on the path.
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

SEEN = 2
"""So many training views have to see a surface for its place to be known."""
FEWEST = (0, 1, 2, 5, 15)
"""Training views that at least see a pixel's surface, of each row of the table; fewer than the next row's."""
RIGHT = 0.02
"""Share of its depth by which a pixel may be off and still be in the right place."""


def decibels(errors: np.ndarray) -> float:
    """The PSNR of pixels with these mean squared errors."""
    return float(-10 * np.log10(errors.mean())) if len(errors) else float("nan")


def positions(rendered: Path, camera: Camera) -> np.ndarray:
    """Where the surfaces are that a view's pixels see, (H, W, 3).

    Raises:
        LodgsError: they were rendered at another size.
    """
    found = read_positions(rendered / "positions" / f"{Path(camera.name).stem}.exr")
    if found.shape[:2] != (camera.height, camera.width):
        raise LodgsError(
            f"{camera.name} was rendered at {found.shape[1]}x{found.shape[0]}, "
            f"but trained at {camera.width}x{camera.height}.",
            "Give build_scene the --percentage that belongs to the run's image scale.",
        )
    return found


def pixels(
    evaluation: Evaluation, splats: Gaussians, cameras: Sequence[Camera], rendered: Path
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Of each view its pixels' (P,) squared errors, views that see them, and depths over the true ones."""
    train = [(camera, depths_of(positions(rendered, camera), camera)) for camera in evaluation.data.train]
    for camera in cameras:
        places = positions(rendered, camera)
        drawn = rasterize(splats, camera, near=evaluation.data.near, antialias=evaluation.antialias,
                          outputs=("median_depth",), backend=evaluation.backend)  # fmt: skip
        assert drawn.median_depth is not None
        difference = to_8_bit(drawn.image.cpu()) - evaluation.target(camera).image
        views = np.sum(
            [visible_points(depths, view, places.reshape(-1, 3))[1] for view, depths in train], axis=0
        )
        depths = drawn.median_depth.cpu().numpy() / depths_of(places, camera)
        yield difference.square().mean(2).numpy().ravel(), views, depths.ravel()


def report(run: Path, rendered: Path) -> Iterator[str]:
    """Lines on a run's views off the path, and on its held-out ones.

    Raises:
        LodgsError: the run or the scene cannot be read.
    """
    if not rendered.is_dir():
        raise LodgsError(f"There is no folder {rendered}.", "Fill it by examples/build_scene.py.")
    folder = RunFolder(run)
    job, bundle = Job.from_file(folder.job), read_bundle(folder.bundle)
    evaluation = Evaluation(training_data(job, folder), job.backend, bundle.antialias)
    everything, _ = full_detail_source(bundle, bundle.levels[-1])(evaluation.data.train[0])
    splats = evaluation.load(everything)
    aside = [camera.scaled(job.image_scale) for camera in read_offset_views(Path(job.scene))]
    for name, cameras in (("off the path", aside), ("on the path", evaluation.data.test)):
        found = list(pixels(evaluation, splats, cameras, rendered))
        whole = np.mean([decibels(errors) for errors, _, _ in found])
        known = np.mean([decibels(errors[views >= SEEN]) for errors, views, _ in found])
        yield f"{name}: {whole:.2f} dB, {known:.2f} dB where at least {SEEN} training views see the surface"
        errors, views, depths = map(np.concatenate, zip(*found, strict=True))
        ends = (*FEWEST[1:], np.inf)
        rows = [
            (f"seen by {least} or more", (views >= least) & (views < end))
            for least, end in zip(FEWEST, ends, strict=True)
        ]
        right = np.abs(depths - 1) <= RIGHT
        rows += [("known, depth right", (views >= SEEN) & right), ("known, wrong", (views >= SEEN) & ~right)]
        for label, some in rows:
            share, quality = errors[some].sum() / errors.sum(), decibels(errors[some])
            yield f"  {label:<20} {some.mean():6.1%} of pixels {share:6.1%} of the error {quality:6.2f} dB"


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path, metavar="RUN")
    parser.add_argument("rendered", type=Path, help="the folder that build_scene filled")
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

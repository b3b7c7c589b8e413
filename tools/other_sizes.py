"""How a run's held-out views do at other sizes than it was trained at, against the photographs at that size.

    python -m training train --scene DIR --out build/run --method 3dgs --image-scale 0.25 --validation
    python tools/other_sizes.py build/run

A size at which photographs would have to be enlarged is left out.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

HERE = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(HERE))

from training.errors import LodgsError  # noqa: E402
from training.evaluate.views import Evaluation, shown_at  # noqa: E402
from training.lod.selection import levels_alone  # noqa: E402
from training.runs.data import training_data  # noqa: E402
from training.runs.folder import RunFolder  # noqa: E402
from training.runs.job import Job  # noqa: E402
from training.splats.bundle import read_bundle  # noqa: E402

SIZES = (1, 2, 4)
"""How many times the size of training."""


def psnr_by_size(run: Path) -> Iterator[tuple[int, dict[int, float]]]:
    """For each size the mean PSNR of each level's views, in dB.

    Raises:
        LodgsError: the run or its scene cannot be read.
    """
    folder = RunFolder(run)
    job, bundle = Job.from_file(folder.job), read_bundle(folder.bundle)
    for size in SIZES:
        if size * job.image_scale > 1:
            return
        data = training_data(replace(job, image_scale=size * job.image_scale), folder)
        evaluation = Evaluation(data, job.backend, bundle.antialias)
        yield (
            size,
            {
                level.number: float(evaluation.psnrs(evaluation.cameras, shown_at(bundle, level)).mean())
                for level in levels_alone(bundle)
            },
        )


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path, metavar="RUN")
    try:
        for size, levels in psnr_by_size(parser.parse_args().run):
            print(
                f"{size} times: " + ", ".join(f"{psnr:.2f}" for psnr in levels.values()) + " dB", flush=True
            )
    except LodgsError as error:
        print(error.what, error.remedy, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())

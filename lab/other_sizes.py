"""How a run's held-out views do at other sizes than it was trained at, against the photographs at that size.

    python -m training train --scene DIR --out build/run --method 3dgs --image-scale 0.25 --validation
    python lab/other_sizes.py build/run

A size at which photographs would have to be enlarged is left out. Of splats that were trained with
Mip-Splatting's filter it also tells how programs do that do not know it.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

HERE = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(HERE))

from training.editing.bake_filter import bake_filter  # noqa: E402
from training.errors import LodgsError  # noqa: E402
from training.evaluate.views import Evaluation, full_detail_source  # noqa: E402
from training.lod.selection import standalone_levels  # noqa: E402
from training.runs.data import training_data  # noqa: E402
from training.runs.folder import RunFolder  # noqa: E402
from training.runs.job import Job  # noqa: E402
from training.splats.bundle import read_bundle
from training.splats.levels import Bundle, Level

SIZES = (1, 2, 4)
"""How many times the size of training."""


def as_drawn(bundle: Bundle) -> dict[str, Bundle]:
    """The bundle by who draws it: LODGS; and, of what is antialiased, programs that do not know the filter,
    from a file that is made for them, and from the bundle itself."""
    if not bundle.antialias:
        return {"": bundle}
    made = bake_filter(bundle)
    levels = [Level(level.number, level.rows.select(slice(None)), level.facts) for level in made.levels]
    untold = {name: value for name, value in bundle.meta.items() if name != "antialias"}
    return {
        "": bundle,
        ", a file for others": replace(made, levels=levels),
        ", the bundle in others": replace(bundle, meta=untold),
    }


def psnr_by_size(run: Path) -> Iterator[tuple[int, str, dict[int, float]]]:
    """For each size, and each who draws it, the mean PSNR of each level's views, in dB.

    Raises:
        LodgsError: the run or its scene cannot be read.
    """
    folder = RunFolder(run)
    job, ways = Job.from_file(folder.job), as_drawn(read_bundle(folder.bundle))
    for size in SIZES:
        if size * job.image_scale > 1:
            return
        data = training_data(replace(job, image_scale=size * job.image_scale), folder)
        for who, bundle in ways.items():
            evaluation = Evaluation(data, job.backend, bundle.antialias)
            yield (
                size,
                who,
                {
                    level.number: float(
                        evaluation.compare_views(evaluation.cameras, full_detail_source(bundle, level)).mean()
                    )
                    for level in standalone_levels(bundle)
                },
            )


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path, metavar="RUN")
    try:
        for size, who, levels in psnr_by_size(parser.parse_args().run):
            by_level = ", ".join(f"{psnr:.2f}" for psnr in levels.values())
            print(f"{size} times{who}: {by_level} dB", flush=True)
    except LodgsError as error:
        print(error.what, error.remedy, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Measure a run's held-out views at other image sizes than in training, against photos of that size.

    python -m training train --scene DIR --out build/run --method 3dgs --image-scale 0.25 --validation
    python lab/other_sizes.py build/run

Sizes that exceed the photos are skipped. For splats trained with Mip-Splatting's filter, the result in
programs without this filter is measured as well.
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
from training.splats.bundle import read_bundle  # noqa: E402
from training.splats.levels import Bundle, Level  # noqa: E402

SIZES = (1, 2, 4)
"""Multiples of the training size."""


def bundles_by_renderer(bundle: Bundle) -> dict[str, Bundle]:
    """Return the bundle as rendered by LODGS and, if antialiased, by programs without the filter:
    from a file with the filter baked, and from the bundle itself."""
    if not bundle.antialias:
        return {"": bundle}
    baked = bake_filter(bundle)
    levels = [Level(level.number, level.rows.select(slice(None)), level.facts) for level in baked.levels]
    unmarked = {name: value for name, value in bundle.meta.items() if name != "antialias"}
    return {
        "": bundle,
        ", filter baked, other programs": replace(baked, levels=levels),
        ", original, other programs": replace(bundle, meta=unmarked),
    }


def psnr_by_size(run: Path) -> Iterator[tuple[int, str, dict[int, float]]]:
    """Yield size, renderer and mean PSNR of each level in dB.

    Raises:
        LodgsError: the run or its scene cannot be read.
    """
    folder = RunFolder(run)
    job, bundles = Job.from_file(folder.job), bundles_by_renderer(read_bundle(folder.bundle))
    for size in SIZES:
        if size * job.image_scale > 1:
            return
        data = training_data(replace(job, image_scale=size * job.image_scale), folder)
        for renderer, bundle in bundles.items():
            evaluation = Evaluation(data, job.backend, bundle.antialias)
            yield (
                size,
                renderer,
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
        for size, renderer, levels in psnr_by_size(parser.parse_args().run):
            by_level = ", ".join(f"{psnr:.2f}" for psnr in levels.values())
            print(f"{size} times{renderer}: {by_level} dB", flush=True)
    except LodgsError as error:
        print(error.what, error.remedy, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())

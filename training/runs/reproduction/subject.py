"""A finished run as the subject of measurements."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Hashable
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np

from ...editing.export import Compression
from ...errors import LodgsError
from ...evaluate.frame_memory import measure_frame_memory
from ...evaluate.views import REDUCTIONS, full_detail_source
from ...lod.blocks import SIZE
from ...lod.on_disk import open_paged
from ...lod.query import LodQuery
from ...lod.selection import resolve_controls, select
from ...rasterize.resident import ResidentBundle
from ...scenes.cameras import Camera
from ...splats.bundle import read_bundle
from ...splats.dialects import Warn, ignore
from ...splats.levels import Bundle
from ..compress import compress
from ..finished import load_networks, open_evaluation


class Subject:
    """A finished run, measured on its held-out views, or on training views if none are held out.

    All methods return means over the views: ``psnr`` in dB, ``ssim``, LPIPS if its weights are there,
    ``fps``, ``ms`` per frame, ``splats`` (number with a weight above 0, in view or not; of networks those
    that they decode) and ``drawn`` (number in the image). Levels count from 1; 0 is the finest.

    Measures of levels, by distance and of networks are made once.

    Raises:
        LodgsError: the run is not finished, or its scene cannot be read.
    """

    def __init__(self, run: Path, warn: Warn = ignore) -> None:
        self.run = run
        self.folder, self.job, self.bundle, self.evaluation = open_evaluation(run, warn)
        self._measured: dict[Hashable, dict[str, float]] = {}

    @property
    def size(self) -> str:
        """Width and height of a measured view in pixels, such as 240x160."""
        camera = self.evaluation.cameras[0]
        return f"{camera.width}x{camera.height}"

    @cached_property
    def _resident(self) -> ResidentBundle:
        return ResidentBundle(self.bundle, self.job.backend)

    def level(self, number: int = 0) -> dict[str, float]:
        """Measure a complete level."""
        number = number or self.bundle.levels[-1].number
        return self._once(("level", number), lambda: self._level(self.bundle, number))

    def by_distance(self, **controls: float) -> dict[str, float]:
        """Measure levels selected for each view, with values of the rule's controls."""
        values = resolve_controls(self.bundle, controls)

        def measure() -> dict[str, float]:
            return self._named(self.evaluation.measure_by_distance(self._resident, values))

        return self._once(("by_distance", *sorted(values.items())), measure)

    def streamed(self, share: float = 1.0, reuse: bool = True) -> dict[str, float]:
        """Measure frames of the training views in their order, whose nodes are read from a tree's file.

        Args:
            share: maximum number of nodes in memory, as a share of all. If a view needs more, it is coarser.
            reuse: keep nodes in memory from view to view; otherwise each view loads all that it needs.

        Returns:
            Means over the views but the first: ``loaded`` nodes, ``ms`` to load them and draw the complete
            cut, and ``fps``.

        Raises:
            LodgsError: the rule allows no streaming, or the file cannot be read.
        """
        rule, values = self.bundle.rule, tuple(resolve_controls(self.bundle, {}).items())
        facts = tuple(self.bundle.facts.items())
        file = open_paged(self.folder.bundle)
        budget = int(share * file.total) + SIZE
        pager = file.pager(budget)
        pager.start()
        loaded, seconds = [], []
        for camera in self.evaluation.data.train:
            begin, count = time.perf_counter(), 0
            if not reuse:
                pager.stop()
                pager = file.pager(budget)
                pager.start()
            pager.ask(LodQuery(rule, tuple(camera.center), camera.focal, facts, values))
            while not pager.idle:
                if update := pager.take():
                    count += sum(len(splats) for _, splats in update.pages)
                else:
                    time.sleep(1e-4)
            seconds.append(time.perf_counter() - begin)
            loaded.append(count)
        pager.stop()
        if pager.problem:
            raise LodgsError(f"Cannot measure {self.run}: {pager.problem}", "Restore its bundle.")
        frame_ms = 1e3 * float(np.mean(seconds[1:])) + self.by_distance()["ms"]
        return {"loaded": float(np.mean(loaded[1:])), "ms": frame_ms, "fps": 1e3 / frame_ms}

    def predetermined(self, **controls: float) -> dict[str, float]:
        """Measure the levels that the mean training camera selects, for all views (FLoD, Sec. 5.2)."""
        data = self.evaluation.data
        values = resolve_controls(self.bundle, controls)
        splats, weights = select(self.bundle, data.mean_camera, data.focal, values)
        return self._named(self.evaluation.measure_splats(splats, weights))

    def compressed(self) -> dict[str, float]:
        """Measure the finest level of the compressed run, with its size as ``megabytes``."""
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder, "compressed.ply")
            compress(self.run, file, Compression())
            bundle = read_bundle(file)
            finest = replace(bundle, levels=bundle.levels[-1:])
            size = file.stat().st_size * len(finest.levels[0].rows) / sum(len(x.rows) for x in bundle.levels)
            return {**self._level(finest, finest.levels[0].number), "megabytes": size / 1e6}

    def networks(self) -> dict[str, float]:
        """Measure the networks, before baking."""

        def measure() -> dict[str, float]:
            _, model = load_networks(self.job, self.folder, self.evaluation.data)
            return self._named(self.evaluation.measure(model.render))

        return self._once("networks", measure)

    def level_with_memory(self, number: int) -> dict[str, float]:
        """Measure a complete level, with the memory to draw it as ``memory`` in GB, if it is known."""
        near = self.evaluation.data.near

        def prepare() -> Callable[[Camera], object]:
            resident = ResidentBundle(self.folder.bundle, self.job.backend)
            return lambda camera: resident.draw_level(number, camera, near=near)

        size = measure_frame_memory(prepare, self.evaluation.cameras, self.job.backend)
        return {**self.level(number), **({} if size is None else {"memory": size / 1e9})}

    def by_size(self) -> dict[str, float]:
        """Measure the finest level at reduced image sizes, as ``psnr_1``, ``psnr_2`` and so on."""
        source = full_detail_source(self.bundle, self.bundle.levels[-1])
        values = zip(REDUCTIONS, self.evaluation.measure_sizes(source), strict=True)
        return {f"psnr_{factor}": value for factor, value in values}

    def sized_level(self) -> dict[str, float]:
        """Measure the finest level, with its share of the bundle's size as ``megabytes``."""
        rows = [len(level.rows) for level in self.bundle.levels]
        size = self.folder.bundle.stat().st_size * rows[-1] / sum(rows)
        return {**self.level(), "megabytes": size / 1e6}

    def _level(self, bundle: Bundle, number: int) -> dict[str, float]:
        level = next(level for level in bundle.levels if level.number == number)
        return self._named(self.evaluation.measure_level(bundle, level))

    def _once(self, key: Hashable, measure: Callable[[], dict[str, float]]) -> dict[str, float]:
        """Return measures that several tables have in common."""
        if key not in self._measured:
            self._measured[key] = measure()
        return self._measured[key]

    def _named(self, measures: dict[str, float]) -> dict[str, float]:
        """Add derived measures, and remove the prefix of measures on training views."""
        values = {name.removeprefix(self.evaluation.prefix): value for name, value in measures.items()}
        frame_s = max(values.pop("frame_s"), 1e-6)
        return {**values, "fps": 1 / frame_s, "ms": 1e3 * frame_s}

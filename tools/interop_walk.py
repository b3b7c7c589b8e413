"""Walks towards splats in viewers that stream levels, for ``tools/interop_viewers.py``.

A viewer must show no hole while it replaces levels, and must never draw more splats than its budget.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
from scipy.ndimage import binary_erosion

from training.api import render_image
from training.editing.edit import Outputs, edit
from training.runs.page.write import PAGE, write_page
from training.scenes.cameras import Camera, look_at
from training.scenes.overview import central_ball
from training.scenes.view_tables import make_view_tables
from training.splats import streamed_levels, tiles
from training.splats.bundle import write_bundle
from training.splats.levels import Bundle, Level

WALKS = {"playcanvas": "streamed", "cesium": "tiles", "page": "page"}
"""Format that each viewer streams."""
STEPS = 6.0, 3.5, 2.0, 1.0
"""Distances of the cameras, in multiples of that of the first view."""
SIZE = 320, 180
COPIES = {"page": 8}
"""Number of fainter splats in place of each: the padding of textures exceeds small budgets of pages."""
PART_SPLATS = 800
"""Maximum number of splats of a tile or leaf, without copies: small scenes then have several."""
BUDGET = 0.5
"""Splat budget as a fraction of the finest level, for viewers that have one; pages offer this one."""
MAX_HOLE = 0.005
"""Maximum share of the foreground that shows the background."""
MIN_ALPHA = 0.99
"""Minimum opacity of the foreground at each level."""
_MAGENTA = "[1, 0, 1]"
_BLACK = '"background": {"color": [0, 0, 0]}'
_READY = "viewer.state.showAnnotations = false;"
_KEEP_IMAGES = """<head><script>
const get = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, options) {
  return get.call(this, kind, { ...options, preserveDrawingBuffer: true });
};
</script>"""


class Walk:
    """A walk from far away to the first view of a bundle.

    Args:
        camera, near: first view of the bundle.
        viewer: one of WALKS.
        folder: new folder for the files.

    Attributes:
        cameras: cameras of the steps.
        distances: their distances from the subject, descending.
        has_budget: the viewer draws as many splats as its budget allows, from near to far.
        budget: maximum number of splats.
        axes: axes of the poses that the viewer needs.
    """

    def __init__(self, bundle: Bundle, camera: Camera, near: float, viewer: str, folder: Path) -> None:
        self.near, self.viewer, self.folder = near, viewer, folder
        self._copies = COPIES.get(viewer, 1)
        self._original = bundle
        self.bundle = replace(bundle, levels=[_multiplied(level, self._copies) for level in bundle.levels])
        center, _ = central_ball(bundle.levels[-1].rows.select(slice(None)).means)
        forward = camera.world_to_camera[2, :3]
        target = camera.center + max(float((center - camera.center) @ forward), near) * forward
        offset, up = camera.center - target, bundle.up_rotation[2]
        self.distances = [step * float(np.linalg.norm(offset)) for step in STEPS]
        width, height = SIZE
        focal = camera.fy * height / camera.height
        self.cameras = [
            Camera(
                f"step {index}", width, height, focal, focal, width / 2, height / 2,
                look_at(target + step * offset, target, up),
            )
            for index, step in enumerate(STEPS)
        ]  # fmt: skip
        finest = bundle.levels[-1].number
        count = sum(len(level.rows) for level in self.bundle.drawn_levels(finest))
        self.has_budget = viewer != "cesium"
        self.budget = round(BUDGET * count) if self.has_budget else count  # a tile replaces coarser ones
        self.axes = "3dgs" if self.has_budget else "z"

    def write(self, poses: Sequence[Sequence[float]]) -> dict[str, object]:
        """Write the files of the walk, and return the values of its job.

        Args:
            poses: transforms of the cameras by columns.
        """
        self.folder.mkdir()
        source = self.folder / "bundle.ply"
        write_bundle(source, replace(self.bundle, tables=make_view_tables(self.cameras, self.near)))
        steps = [
            {"pose": pose, "foreground": np.flatnonzero(self._foreground(camera)).tolist()}
            for pose, camera in zip(poses, self.cameras, strict=True)
        ]
        (self.folder / "walk.json").write_text(json.dumps(steps), "utf-8")
        with _small_parts(PART_SPLATS * self._copies):
            file = getattr(self, f"_write_{WALKS[self.viewer]}")(source)
        return {"walk": "/files/walk.json", "file": f"/files/{file}", "budget": self.budget}

    def _foreground(self, camera: Camera) -> np.ndarray:
        """Return the pixels (H, W) bool that are opaque at each level, without those at their border."""
        alphas = [
            render_image(
                self._original, camera, level=level.number, background=None, near=self.near, backend="cpu"
            )[..., 3]
            for level in self._original.levels
        ]
        return binary_erosion(np.min(alphas, axis=0) >= MIN_ALPHA, iterations=2)

    def _write_streamed(self, source: Path) -> str:
        edit(source, Outputs(streamed=self.folder / "levels"))
        return f"levels/{streamed_levels.STREAMED_FILE}"

    def _write_tiles(self, source: Path) -> str:
        edit(source, Outputs(tiles=self.folder / "tiles"))
        return f"tiles/{tiles.TILESET_FILE}"

    def _write_page(self, source: Path) -> str:
        """Write a page whose background is magenta."""
        write_page(source, self.folder / "page", backend="cpu")
        path = self.folder / "page" / PAGE
        text = path.read_text("utf-8")
        for old, new in (
            ("<head>", _KEEP_IMAGES),
            (_BLACK, _BLACK.replace("[0, 0, 0]", _MAGENTA)),
            (_READY, f"window.viewer = viewer; {_READY}"),
        ):
            assert old in text, f"{old} is missing"
            text = text.replace(old, new)
        path.write_text(text, "utf-8")
        return f"page/{PAGE}"

    def judge(self, steps: Sequence[Mapping[str, float]]) -> str:
        """Return the fault of a viewer's record, or "".

        Args:
            steps: ``hole`` and ``most`` of each step: largest share of the foreground that showed the
                background, and largest number of splats; ``splats``: their number at the end of the step.
        """
        hole, most = (max(step[name] for step in steps) for name in ("hole", "most"))
        if hole > MAX_HOLE:
            return f"hole of {hole:.2%} of the foreground"
        if most > self.budget:
            return f"{most:,} splats exceed the budget"
        first = len(self.bundle.levels[0].rows) if self.has_budget else steps[0]["splats"]
        if steps[-1]["splats"] <= first:
            return f"only {first:,} splats at the nearest step, as at the farthest"
        return ""


def _multiplied(level: Level, copies: int) -> Level:
    """Return a level with several plain splats in place of each, which together have about its opacity."""
    splats = level.splats.select(np.repeat(np.arange(len(level.splats)), copies))
    alphas = 1 / (1 + np.exp(-splats.opacity_logits.astype(np.float64)))
    logs = np.log1p(-alphas.clip(0, 1 - 1e-6)) / copies  # of 1 - alpha of each copy
    logits = np.log(-np.expm1(logs)) - logs
    return Level(
        level.number,
        replace(splats, opacity_logits=logits.astype(np.float32), sh=splats.sh[:, :1]),
        level.facts,
    )


@contextmanager
def _small_parts(size: int) -> Iterator[None]:
    """Write tiles and leaves with at most ``size`` splats in the block."""
    with (
        patch.object(tiles, "MAX_TILE_SPLATS", size),
        patch.object(streamed_levels, "LEAF_SPLATS", size),
        patch.object(streamed_levels, "FILE_SPLATS", 2 * size),
    ):
        yield

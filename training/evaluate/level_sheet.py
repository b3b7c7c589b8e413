"""A bundle as one camera sees it: every level, the selective view and the photograph side by side."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from ..files import atomic_write
from ..lod.colors import level_color
from ..lod.on_disk import read_visible
from ..lod.rule import Values, find_rule
from ..lod.selection import complete_splats, select, standalone_levels
from ..scenes.cameras import Camera
from ..scenes.images import write_png
from ..splats.gaussians import SH_C0, Splats
from ..splats.levels import Bundle
from .metrics import psnr
from .views import Evaluation


def write_level_sheet(
    path: Path, bundle: Bundle, evaluation: Evaluation, camera: Camera, values: Values
) -> None:
    """Writes a PNG: levels coarse to fine, the selective view, its levels in colours, the photograph.

    Args:
        path: file to write.
        camera: a view with its photograph. Of levels that are not in memory only what it has in sight counts.
        values: of the rule's controls, for what is chosen by distance; without use where there is no rule.
    """
    target = evaluation.target(camera)
    if bundle.on_disk:
        bundle = read_visible(bundle, camera)

    def tile(name: str, splats: Splats, weights: np.ndarray | None = None) -> tuple[str, torch.Tensor]:
        image = evaluation.draw(splats, camera, weights)
        return f"{name}   {len(splats):,} splats   {psnr(image, target.image, target.mask):.1f} dB", image

    rule = find_rule(bundle.rule)
    tiles = []
    if rule is None or not rule.always_active:
        tiles = [
            tile(f"level {level.number}", complete_splats(bundle, level))
            for level in standalone_levels(bundle)
        ]
    if rule and rule.sweep:
        name, steps = rule.sweep
        for step in steps:
            shown = select(bundle, camera.center, camera.focal, {**values, name: step})
            tiles.append(tile(f"{name} = {step:g}", *shown))
    elif rule:
        view = (camera.center, camera.focal, values)
        tiles.append(tile("by distance", *select(bundle, *view)))
        colored, weights = select(_in_level_colors(bundle), *view)
        tiles.append(("which level where", evaluation.draw(colored, camera, weights)))
    tiles.append(("photograph", target.image))
    _write_sheet(path, tiles)


def _in_level_colors(bundle: Bundle) -> Bundle:
    levels = []
    for level in bundle.levels:
        color = np.array(level_color(level.number), np.float32)
        # the level's colour, with the splats' own lightness so that the scene stays readable
        lightness = (0.5 + SH_C0 * level.splats.sh[:, 0]).clip(0, 1).mean(1, keepdims=True)
        sh = ((0.35 + 0.65 * lightness) * color - 0.5) / SH_C0
        levels.append(replace(level, splats=replace(level.splats, sh=sh[:, None].astype(np.float32))))
    return replace(bundle, levels=levels)


def _write_sheet(
    path: Path, tiles: list[tuple[str, torch.Tensor]], columns: int = 4, caption: int = 22
) -> None:
    from PIL import Image, ImageDraw, ImageFont

    height, width = tiles[0][1].shape[:2]
    rows = -(-len(tiles) // columns)
    columns = min(columns, len(tiles))
    sheet = Image.new("RGB", (columns * (width + 4) - 4, rows * (height + caption)), (24, 24, 24))
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(size=13)
    for place, (name, image) in enumerate(tiles):
        x, y = place % columns * (width + 4), place // columns * (height + caption)
        pixels = (image.clamp(0, 1) * 255).round().byte().numpy()
        sheet.paste(Image.fromarray(pixels), (x, y + caption))
        draw.text((x + 6, y + 3), name, fill=(230, 230, 230), font=font)
    with atomic_write(path) as temporary:
        write_png(temporary, np.asarray(sheet))

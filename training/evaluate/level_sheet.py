"""Contact sheet of a bundle's levels for one camera."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from ..files import atomic_write
from ..lod.on_disk import read_visible
from ..lod.rule import Values, find_rule
from ..lod.selection import complete_splats, full_detail_controls, select, standalone_levels
from ..scenes.cameras import Camera
from ..scenes.images import write_png
from ..splats.gaussians import SH_C0, Splats
from ..splats.level_colors import level_color
from ..splats.levels import Bundle
from .metrics import psnr
from .views import Evaluation


def write_level_sheet(
    path: Path, bundle: Bundle, evaluation: Evaluation, camera: Camera, values: Values
) -> None:
    """Write a PNG: levels from coarse to fine, the view by distance, its levels in colours, and the photo.

    Args:
        path: file to write.
        camera: view with a photo. Of levels on disk, only the splats that it sees are read and counted.
        values: values of the rule's controls for the view by distance.
    """
    target = evaluation.target(camera)
    if bundle.on_disk:
        bundle = read_visible(bundle, camera)

    def tile(name: str, splats: Splats, weights: np.ndarray | None = None) -> tuple[str, torch.Tensor]:
        image = evaluation.draw(splats, camera, weights)
        return f"{name}   {len(splats):,} splats   {psnr(image, target.image, target.mask):.1f} dB", image

    rule = find_rule(bundle.rule)
    tiles = []
    if full_detail_controls(bundle) is None:
        tiles = [
            tile(f"level {level.number}", complete_splats(bundle, level))
            for level in standalone_levels(bundle)
        ]
    if rule and rule.sweep:
        name, steps = rule.sweep
        for step in steps:
            splats, weights = select(bundle, camera.center, camera.focal, {**values, name: step})
            tiles.append(tile(f"{name} = {step:g}", splats, weights))
    elif rule:
        view = (camera.center, camera.focal, values)
        tiles.append(tile("by distance", *select(bundle, *view)))
        colored, weights = select(in_level_colors(bundle), *view)
        tiles.append(("levels in colours", evaluation.draw(colored, camera, weights)))
    tiles.append(("photo", target.image))
    _write_tiles(path, tiles)


def in_level_colors(bundle: Bundle) -> Bundle:
    """Return a bundle whose splats have the colours of their levels, as light as their own colours."""
    levels = []
    for level in bundle.levels:
        color = np.array(level_color(level.number), np.float32)
        # keep the splats' lightness, so that the scene stays recognizable
        lightness = (0.5 + SH_C0 * level.splats.sh[:, 0]).clip(0, 1).mean(1, keepdims=True)
        sh = ((0.35 + 0.65 * lightness) * color - 0.5) / SH_C0
        levels.append(replace(level, splats=replace(level.splats, sh=sh[:, None].astype(np.float32))))
    return replace(bundle, levels=levels)


def _write_tiles(
    path: Path, tiles: list[tuple[str, torch.Tensor]], columns: int = 4, caption: int = 22
) -> None:
    """Write images (H, W, 3) in [0, 1] of equal size with their captions as a PNG.

    Args:
        columns: maximum number of images in a row.
        caption: height of a caption in pixels.
    """
    from PIL import Image, ImageDraw, ImageFont

    font = ImageFont.load_default(size=13)
    height, width = tiles[0][1].shape[:2]
    widest = max(font.getlength(name) for name, _ in tiles) + 12
    scale = max(math.ceil(widest / width), 1)  # small images would be narrower than their captions
    height, width = scale * height, scale * width
    rows = -(-len(tiles) // columns)
    columns = min(columns, len(tiles))
    sheet = Image.new("RGB", (columns * (width + 4) - 4, rows * (height + caption)), (24, 24, 24))
    draw = ImageDraw.Draw(sheet)
    for number, (name, image) in enumerate(tiles):
        x = number % columns * (width + 4)
        y = number // columns * (height + caption)
        pixels = (image.clamp(0, 1) * 255).round().byte().numpy()
        sheet.paste(Image.fromarray(pixels.repeat(scale, 0).repeat(scale, 1)), (x, y + caption))
        draw.text((x + 6, y + 3), name, fill=(230, 230, 230), font=font)
    with atomic_write(path) as temporary:
        write_png(temporary, np.asarray(sheet))

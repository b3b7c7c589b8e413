"""Drawing of Gaussians into a framebuffer, from splats on the graphics card.

Pixels follow ``docs/development/rasterizer.md``. Splats are blended from back to front in half floats, in
display space like the training images, in a separate offscreen buffer. Geometry in front of a splat's mean
hides the splat. The result is composited into the active framebuffer, which is linear, below existing
overlays.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import gpu
import numpy as np
from mathutils import Matrix

from ...training.editing.look import Looks
from .arrangement import WIDTH, Placement
from .shaders import (
    BLOCK,
    bind_textures,
    copy_shader,
    empty_texture,
    is_cached,
    palette,
    program,
    projection_shader,
)

DILATION = (0.3, 0.3)
"""3DGS's filter: variance added to projected splats in square pixels, and its part that adds opacity."""
MIP_FILTER = (0.1, 0.0)
"""Mip-Splatting's 2D filter: opacities compensate for all added variance."""

SHRINK_FACTOR = 2
"""Size of the textures of projected splats, relative to the drawn ones, above which smaller ones replace
them."""

Frame = tuple[float, float, float, float]
FULL_FRAME: Frame = (-1.0, -1.0, 1.0, 1.0)
"""Left, bottom, right and top of clip space."""


@dataclass(frozen=True)
class DrawTarget:
    """View of the world in the active framebuffer.

    Attributes:
        view, projection: matrices from the world to camera space, and from there to clip space.
        under_overlays: keep contents of the framebuffer with alpha on top; it is stored as sRGB, like a
            viewport's.
        frame: left, bottom, right, top of the camera's frame in clip space. Splats outside are stretched
            according to their distance from it, as in a render.
    """

    view: Matrix
    projection: Matrix
    under_overlays: bool = True
    frame: Frame = FULL_FRAME


class UploadedSplats(Protocol):
    """Splats on the graphics card, as ``resident.Store`` has them."""

    textures: list[gpu.types.GPUTexture | None]
    texture_slots: int
    higher: int


def instances_texture(
    instances: np.ndarray, slots: np.ndarray, marks: np.ndarray | None = None
) -> tuple[gpu.types.GPUTexture, int]:
    """Upload the list of those instances whose splats are uploaded.

    Args:
        instances: (M, 4), see ``arrangement.Arrangement``.
        slots: see ``resident.Store``.
        marks: see ``resident.Resident``; marked splats get the colours of their marks.

    Returns:
        The texture, and the number of splats in it.
    """
    pool_rows = instances[:, 0].astype(np.int32)
    splat_slots = slots[pool_rows]
    uploaded = splat_slots >= 0
    rows = instances if uploaded.all() else instances[uploaded]
    height = max(-(-len(rows) // WIDTH), 1)
    data = gpu.types.Buffer("FLOAT", height * WIDTH * 4)
    table = np.frombuffer(data, np.float32).reshape(-1, 4)[: len(rows)]  # type: ignore[arg-type]
    table[:] = rows
    table[:, 0] = splat_slots[uploaded]
    if marks is not None:
        drawn = marks[pool_rows[uploaded]]
        marked = drawn > 0
        table[marked, 3] = -drawn[marked].astype(np.float32)
    return gpu.types.GPUTexture((WIDTH, height), format="RGBA32F", data=data), len(rows)


def copy_records(
    frame: gpu.types.GPUFrameBuffer, store: gpu.types.GPUTexture, slots: np.ndarray, records: np.ndarray
) -> None:
    """Copy records to slots of a texture by drawing; Blender has no other partial texture update.

    Args:
        frame: framebuffer with the texture as its colours.
        slots: (M,) ascending; consecutive slots continue in the next row of the texture.
        records: (M, 4 * texels) float32.
    """
    texels = records.shape[1] // 4
    height = -(-records.size // (4 * WIDTH))
    data = gpu.types.Buffer("FLOAT", height * WIDTH * 4)
    np.frombuffer(data, np.float32)[: records.size] = records.reshape(-1)  # type: ignore[arg-type]
    source = gpu.types.GPUTexture((WIDTH, height), format="RGBA32F", data=data)
    begins = np.flatnonzero(np.diff(slots, prepend=-2) != 1)
    ends = np.append(begins[1:], len(slots))
    start, stop = slots[begins].astype(np.int64) * texels, (slots[ends - 1].astype(np.int64) + 1) * texels
    # split each run of consecutive slots at the rows of the texture
    first, last = start // WIDTH, (stop - 1) // WIDTH
    row_counts = last - first + 1
    run = np.repeat(np.arange(len(begins)), row_counts)
    row = first[run] + np.arange(len(run)) - (np.cumsum(row_counts) - row_counts)[run]
    left = np.where(row == first[run], start[run] % WIDTH, 0)
    right = np.where(row == last[run], (stop[run] - 1) % WIDTH + 1, WIDTH)
    shift = begins[run] * texels + row * WIDTH - start[run]  # from a column to its source texel
    corners = np.empty((len(run), 6, 3), np.float32)
    x, y = 2.0 * np.stack([left, right]) / WIDTH - 1, 2.0 * np.stack([row, row + 1]) / store.height - 1
    for corner, (across, up) in enumerate(((0, 0), (1, 0), (0, 1), (0, 1), (1, 0), (1, 1))):
        corners[:, corner] = np.stack([x[across], y[up], shift], axis=1)
    layout = gpu.types.GPUVertFormat()
    layout.attr_add(id="corner", comp_type="F32", len=3, fetch_mode="FLOAT")
    vertices = gpu.types.GPUVertBuf(layout, 6 * len(run))
    vertices.attr_fill("corner", corners.reshape(-1, 3))
    shader = copy_shader()
    with frame.bind():  # type: ignore[union-attr]
        gpu.state.depth_test_set("NONE")
        gpu.state.blend_set("NONE")
        shader.bind()
        shader.uniform_sampler("source", source)
        gpu.types.GPUBatch(type="TRIS", buf=vertices).draw(shader)


class Canvas:
    """Framebuffer that splats are blended in, one per viewport, and one for their projections.

    They are no ``GPUOffScreen``: creating one unbinds the framebuffer that is being drawn into.

    Attributes:
        projections: textures of projected splats, one splat per pixel: centres, axes and colours.
    """

    def __init__(self) -> None:
        self.size = (0, 0)
        self.colors: gpu.types.GPUTexture | None = None
        self.frame: gpu.types.GPUFrameBuffer | None = None
        self.projections: dict[str, gpu.types.GPUTexture] = {}
        self.projection_frame: gpu.types.GPUFrameBuffer | None = None

    def resize(self, size: tuple[int, int], rows: int) -> None:
        """Set the size (width, height), and make room for projected splats in rows of WIDTH."""
        if size != self.size:
            self.size, self.colors = size, gpu.types.GPUTexture(size, format="RGBA16F")
            self._depth = gpu.types.GPUTexture(size, format="DEPTH_COMPONENT32F")
            self.frame = gpu.types.GPUFrameBuffer(depth_slot=self._depth, color_slots=self.colors)
        reserved = self.projections["centers"].height if self.projections else 0
        if not rows <= reserved <= SHRINK_FACTOR * rows:
            formats = {"centers": "RGBA32F", "axes": "RGBA32F", "colors": "RGBA16F"}
            self.projections = {
                name: gpu.types.GPUTexture((WIDTH, rows), format=kind) for name, kind in formats.items()
            }
            self.projection_frame = gpu.types.GPUFrameBuffer(color_slots=tuple(self.projections.values()))


def draw(
    store: UploadedSplats,
    instances: gpu.types.GPUTexture,
    count: int,
    placements: Sequence[Placement],
    target: DrawTarget,
    canvas: Canvas,
    *,
    resolution: float = 1.0,
    timed: bool = False,
) -> float:
    """Draw splats into the active framebuffer, tested against its depth.

    Args:
        store: uploaded splats.
        instances, count: see :func:`instances_texture`.
        placements: transforms, filters and looks of the splat sets.
        target: view to draw.
        canvas: framebuffer to blend the splats in.
        resolution: resolution of the splats relative to the framebuffer. Below 1, splats are compact.
        timed: wait until the splats are drawn.

    Returns:
        The seconds from the first splat to the last if timed, else 0.
    """
    framebuffer = gpu.state.active_framebuffer_get()
    _, _, width, height = gpu.state.viewport_get()
    region = 0, 0, width, height
    depth = gpu.types.GPUTexture(region[2:], format="R32F", data=framebuffer.read_depth(*region))
    overlay = empty_texture()
    if target.under_overlays:
        colors = framebuffer.read_color(*region, 4, 0, "FLOAT")
        overlay = gpu.types.GPUTexture(region[2:], format="RGBA8", data=colors)
    looks_texture = _looks_texture([placement.looks for placement in placements])  # freed with its last name
    placements_texture = _placements_texture(placements, target.view, target.projection, resolution)
    size = max(1, round(width * resolution)), max(1, round(height * resolution))
    canvas.resize(size, -(-count // WIDTH))
    begin = time.monotonic()
    textures = {
        "instances": instances, "placements": placements_texture, "looks": looks_texture,
        "palette": palette(),
    }  # fmt: skip
    _project(store, textures, count, target, canvas)
    with canvas.frame.bind():  # type: ignore[union-attr]
        canvas.frame.clear(color=(0, 0, 0, 0), depth=1.0)
        _write_depth(depth)
        _blend(canvas.projections, count, _program_name(resolution))
        if timed:
            canvas.frame.read_color(0, 0, 1, 1, 4, 0, "FLOAT")  # waits for the graphics card
    _composite(canvas, overlay)
    return time.monotonic() - begin if timed else 0.0


def is_compiled(store: UploadedSplats, resolution: float = 1.0) -> bool:
    """Return True if the shaders for a store exist, so that a redraw does not wait for them."""
    return is_cached(f"project_{len(store.textures)}") and is_cached(_program_name(resolution))


def _program_name(resolution: float) -> str:
    """Return the shader for a resolution: compact splats fill half as many pixels as exact ones."""
    return "splats" if resolution == 1 else "compact_splats"


def _write_depth(depth: gpu.types.GPUTexture) -> None:
    """Write depths into the bound framebuffer."""
    gpu.state.color_mask_set(False, False, False, False)
    gpu.state.depth_test_set("ALWAYS")
    gpu.state.depth_mask_set(True)
    shader, quad = program("depth")
    shader.bind()
    shader.uniform_sampler("depth", depth)
    quad.draw(shader)
    gpu.state.color_mask_set(True, True, True, True)


def _project(
    store: UploadedSplats,
    textures: dict[str, gpu.types.GPUTexture],
    count: int,
    target: DrawTarget,
    canvas: Canvas,
) -> None:
    """Project splats to the pixels of a canvas."""
    # bind the same format everywhere, or drivers would compile the shader again for other formats
    placeholder = next(texture for texture in store.textures if texture is not None)
    for number, texture in enumerate(store.textures):
        textures[f"records_{number}"] = texture or placeholder
    shader, quad = projection_shader(len(store.textures))
    with canvas.projection_frame.bind():  # type: ignore[union-attr]
        canvas.projection_frame.viewport_set(0, 0, WIDTH, -(-count // WIDTH))  # type: ignore[union-attr]
        gpu.state.depth_test_set("NONE")
        gpu.state.blend_set("NONE")
        shader.bind()
        bind_textures(shader, textures)
        shader.uniform_float("projection", target.projection)
        shader.uniform_float("size", canvas.size)
        shader.uniform_float("frame", target.frame)
        shader.uniform_int("degree", round((store.higher + 1) ** 0.5) - 1)
        shader.uniform_int("texels", -(-(14 + 3 * store.higher) // 4))
        shader.uniform_int("part_size", store.texture_slots)
        quad.draw(shader)


def _blend(projections: dict[str, gpu.types.GPUTexture], count: int, name: str) -> None:
    """Blend projected splats into the bound framebuffer."""
    gpu.state.depth_test_set("LESS_EQUAL")
    gpu.state.depth_mask_set(False)
    gpu.state.blend_set("ALPHA_PREMULT")
    shader, quads = program(name)
    shader.bind()
    bind_textures(shader, projections)
    quads.draw_instanced(shader, instance_count=-(-count // BLOCK))


def _composite(canvas: Canvas, overlay: gpu.types.GPUTexture) -> None:
    """Composite the canvas into the active framebuffer, below its overlay."""
    gpu.state.depth_test_set("NONE")
    gpu.state.blend_set("ALPHA_PREMULT")
    shader, quad = program("composite")
    shader.bind()
    bind_textures(shader, {"colors": canvas.colors, "overlay": overlay})
    quad.draw(shader)
    gpu.state.blend_set("NONE")


def reset_state() -> None:
    """Restore Blender's graphics state after an interrupted drawing."""
    gpu.state.color_mask_set(True, True, True, True)
    gpu.state.depth_test_set("NONE")
    gpu.state.depth_mask_set(False)
    gpu.state.program_point_size_set(False)
    gpu.state.blend_set("NONE")


def _placements_texture(
    placements: Sequence[Placement], view: Matrix, projection: Matrix, resolution: float
) -> gpu.types.GPUTexture:
    """Upload five texels per placement: three rows of its matrix to camera space, the camera, and the filter.

    The fourth value of the camera is 1; for orthographic views it is 0 and the others are the direction
    opposite to the view. The filter's texel also has the range of looks. At a lower resolution, the filter
    adds no more opacity than at rest, so that small splats keep their brightness.
    """
    view_matrix = np.array(view, np.float64)
    perspective = projection[3][3] == 0
    camera_to_world = np.linalg.inv(view_matrix)
    camera = camera_to_world[:, 3] if perspective else camera_to_world[:, 2]
    data = np.zeros((-(-5 * len(placements) // WIDTH) * WIDTH, 4), np.float32)
    first_look = 0
    for number, placement in enumerate(placements):
        rows = data[5 * number : 5 * number + 5]
        end_look = first_look + len(placement.looks)
        rows[4, 2:] = first_look, end_look
        first_look = end_look
        variance, uncompensated = MIP_FILTER if placement.antialias else DILATION
        rows[4, :2] = variance, uncompensated * resolution**2
        rows[:3] = (view_matrix @ placement.world)[:3]
        rows[3, :3] = (np.linalg.pinv(placement.world) @ camera)[:3]
        rows[3, 3] = perspective
    buffer = gpu.types.Buffer("FLOAT", data.size, data.reshape(-1))
    return gpu.types.GPUTexture((WIDTH, len(data) // WIDTH), format="RGBA32F", data=buffer)


def _looks_texture(looks_per_placement: Sequence[Looks]) -> gpu.types.GPUTexture:
    """Upload six texels per look.

    Three rows transform to the space of its crop (zeros if the look applies everywhere), three are its colour
    matrix. The fourth values of the matrix rows are opacity, sphere flag and outside flag.
    """
    all_looks = [look for looks in looks_per_placement for look in looks]
    data = np.zeros((max(-(-6 * len(all_looks) // WIDTH), 1) * WIDTH, 4), np.float32)
    for number, (crop, look) in enumerate(all_looks):
        rows = data[6 * number : 6 * number + 6]
        if crop is not None:
            rows[:3], rows[4:, 3] = crop.to_local, (crop.shape == "SPHERE", crop.outside)
        rows[3:, :3], rows[3, 3] = look.matrix, look.opacity
    buffer = gpu.types.Buffer("FLOAT", data.size, data.reshape(-1))
    return gpu.types.GPUTexture((WIDTH, len(data) // WIDTH), format="RGBA32F", data=buffer)

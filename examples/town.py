"""Generate a town of any number of splats, as ground truth for experiments on large scenes.

    python -m examples.town build/town --splats 3000000          town.ply, cameras/*.json (one minute)
    python -m examples.town build/town --splats 3000000 --views 120    also scene/, a COLMAP scene

Splats are discs on the surfaces of ``town_shapes``, as large as their spacing. More splats are first smaller,
then fill more blocks. Two camera paths lead through the town: a walk along the streets at eye height and a
flight over the roofs.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np
from scipy.ndimage import label, maximum_filter
from scipy.spatial.transform import Rotation

from training.runs.capture import write_scene
from training.scenes.cameras import Camera, look_at, write_camera
from training.splats.gaussians import SH_C0, Splats
from training.splats.ply import write_ply
from training.splats.sh import basis, coefficient_count

from . import town_shapes as shapes
from .town_shapes import Plan

WIDTH, HEIGHT, FOCAL = 960, 540, 760.0
NEAR = 0.05  # metres
FINEST = 80.0  # splats per square metre of a wall; beyond this density, the town gets more blocks
HILLS, SKY = 0.05, 0.004  # shares of all splats
POINTS = 60_000  # approximate number in the COLMAP scene
BATCH = 500_000
JITTER = 0.5  # share of the splats' spacing
EYE_HEIGHT = 1.65
GARDEN = 6.0  # half of the side of a block's garden


class Discs(NamedTuple):
    """N discs on surfaces.

    Attributes:
        means, normals: (N, 3).
        tangents: (N, 3), the direction of the first size.
        sizes: (N, 1) or (N, 2) spacing in metres.
        colors: (N, 3) in display space.
        gloss: (N,) strength of the sun's reflection.
    """

    means: np.ndarray
    normals: np.ndarray
    tangents: np.ndarray
    sizes: np.ndarray
    colors: np.ndarray
    gloss: np.ndarray


def plan_for(count: int, seed: int = 0) -> Plan:
    """Return the largest town that this many splats cover densely."""
    plan = shapes.lay_out(3, seed)
    while True:
        larger = shapes.lay_out(plan.blocks + 2, seed)
        if _splat_demand(larger).sum() / shapes.DENSITY[shapes.WALL] * FINEST > count:
            return plan
        plan = larger


def _splat_demand(plan: Plan) -> np.ndarray:
    """Return the relative number of splats for each sheet, then for each crown."""
    sheets, crowns = plan.sheets, plan.crowns
    leaves = 4 * np.pi * crowns[:, 3] ** 1.3 * crowns[:, 4] ** 0.7 * shapes.CROWN_DENSITY
    return np.concatenate([sheets.areas * shapes.DENSITY[sheets.material], leaves])


def build(plan: Plan, count: int, sh_degree: int = 1, seed: int = 0) -> Splats:
    """Return the town's splats.

    Args:
        plan: the town.
        count: number of splats.
        sh_degree: 0 to 3; glossy surfaces need 1 or more.
        seed: random seed.
    """
    rng = np.random.default_rng(seed)
    parts = [_sky(plan, int(count * SKY)), _hills(plan, int(count * HILLS), rng)]
    ends = np.cumsum(_splat_demand(plan))
    remaining = count - sum(len(means) for means, *_ in parts)
    shares = np.diff(np.round(ends / ends[-1] * remaining).astype(int), prepend=0)
    on_sheets = shares[: len(plan.sheets)]
    parts += [_on_sheets(plan, batch, on_sheets[batch], rng) for batch in _batches(on_sheets)]
    parts += [_leaves(plan, shares[len(plan.sheets) :], rng)]
    return Splats.concatenated([_splats(part, sh_degree, rng) for part in parts])


def _batches(counts: np.ndarray) -> Iterator[np.ndarray]:
    """Yield batches of sheets with few enough splats for small work arrays."""
    number = (np.cumsum(counts) // BATCH).astype(int)
    for batch in np.unique(number):
        yield np.flatnonzero((number == batch) & (counts > 0))


def _on_sheets(plan: Plan, which: np.ndarray, counts: np.ndarray, rng: np.random.Generator) -> Discs:
    """Return discs on some of the sheets, on a jittered grid."""
    sheets = plan.sheets
    row = np.repeat(which, counts)
    number = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    across, up = sheets.across[row], sheets.up[row]
    wide, high = np.linalg.norm(across, axis=1), np.linalg.norm(up, axis=1)
    count = np.repeat(counts, counts)
    columns = np.maximum(np.round(np.sqrt(count * wide / high)), 1)
    jitter = 0.5 + JITTER * (rng.random((2, len(row))) - 0.5)
    u = (number % columns + jitter[0]) / columns
    v = np.minimum((number // columns + jitter[1]) / (count / columns), 1)
    taper = sheets.taper[row]
    v = np.where(taper > 0, 1 - np.sqrt(1 - np.minimum(v, 0.9999)), v)
    u_in = 0.5 + (u - 0.5) * (1 - taper * v)
    means = sheets.corner[row] + across * u_in[:, None] + up * v[:, None]
    normals, material = sheets.normals[row], sheets.material[row]
    size = np.stack([wide / columns, high * columns / count], axis=1)
    albedo, gloss = _paint(plan, material, sheets, row, u * wide, v * high, wide, means)
    color = _lit(plan, means + 0.35 * normals, normals, albedo)
    return Discs(means, normals, across / wide[:, None], size, color, gloss)


def _paint(plan, material, sheets, row, s, t, wide, means) -> tuple[np.ndarray, np.ndarray]:
    """Return colours (N, 3) and gloss (N,) at s, t metres along the edges of the sheets."""
    color, gloss, seed = sheets.color[row].copy(), shapes.GLOSS[material].copy(), sheets.seed[row]
    grain = shapes.chance(np.floor(s * 9), np.floor(t * 9), seed)[:, None]
    color *= 0.94 + 0.12 * grain
    for kind, paint in ((shapes.WALL, _wall), (shapes.ROOF, _roof), (shapes.GROUND, _ground)):
        rows = material == kind
        if rows.any():
            arguments = (array[rows] for array in (color, gloss, seed, s, t, wide, means))
            color[rows], gloss[rows] = paint(plan, *arguments)
    leafy = np.isin(material, [shapes.HEDGE])
    color[leafy] *= 0.6 + 0.8 * grain[leafy]
    return color, gloss


def _wall(plan, color, gloss, seed, s, t, wide, means):
    """Paint windows with frames and shutters on every storey, a door and a stone base."""
    bays = np.maximum(np.round((wide - 0.6) / 2.3), 1)
    bay = wide / bays
    x, storey = s % bay - bay / 2, np.floor(t / shapes.FLOOR)
    y = t - storey * shapes.FLOOR - 1.65
    stains = shapes.noise(s / 2.5 + seed % 97, t / 1.4, 1.0)
    color = color * (0.95 + 0.07 * stains)[:, None]
    color[t < 0.7] = color[t < 0.7] * 0.4 + np.array([0.42, 0.40, 0.38]) * 0.6
    color[np.abs(t % shapes.FLOOR - 0.02) < 0.09] *= 0.88
    tall = (wide > 1.2) & (y > -9)
    door = tall & (storey == 0) & (np.floor(s / bay) == seed % np.maximum(bays, 1)) & (seed % 3 < 2)
    window = tall & ~door & (np.abs(x) < 0.52) & (np.abs(y) < 0.72)
    frame = tall & ~door & ~window & (np.abs(x) < 0.66) & (np.abs(y) < 0.86)
    bars = window & ((np.abs(x) < 0.045) | (np.abs(y - 0.2) < 0.04))
    shutter = tall & ~door & (seed // 7 % 3 > 0) & (np.abs(np.abs(x) - 0.88) < 0.2) & (np.abs(y) < 0.74)
    color[frame | bars] = 0.88
    green = shapes.SHUTTERS[seed[shutter] // 11 % len(shapes.SHUTTERS)]
    color[shutter] = green * (0.85 + 0.3 * (np.floor(y[shutter] * 14) % 2))[:, None]
    pane = window & ~bars
    lit = shapes.chance(np.floor(s / bay), storey, seed)[pane]
    color[pane] = np.where(lit[:, None] > 0.9, [0.85, 0.68, 0.38], [0.16, 0.20, 0.26])
    color[pane] *= (0.8 + 0.5 * (y[pane] + 0.7))[:, None]
    gloss[pane] = 0.45
    wood = door & (np.abs(x) < 0.55) & (t < 2.25)
    color[door & ~wood & (np.abs(x) < 0.72) & (t < 2.42)] = 0.8
    color[wood] = shapes.SHUTTERS[seed[wood] // 5 % len(shapes.SHUTTERS)] * 0.9
    return color, gloss


def _roof(plan, color, gloss, seed, s, t, wide, means):
    """Paint rows of tiles."""
    course = np.floor(t / 0.32)
    tile = shapes.chance(np.floor(s / 0.24 + course % 2 / 2), course, seed)
    shade = 0.72 + 0.42 * tile + 0.12 * shapes.noise(s / 2, t / 2, 3.0)
    shade *= np.where(t % 0.32 < 0.07, 0.62, 1.0)
    return color * shade[:, None], gloss


def _ground(plan, color, gloss, seed, s, t, wide, means):
    """Paint streets with pavements and markings, the cobbled square, gardens and meadows."""
    x, y = means[:, 0], means[:, 1]
    pitch, half = shapes.PITCH, plan.half
    along = np.stack([(x + half) / pitch, (y + half) / pitch])
    to_line = np.abs(along - np.round(along)) * pitch  # from the centre line of the nearest street
    near = to_line.min(axis=0)
    lengthwise = np.where(to_line[0] < to_line[1], y, x)
    fine, coarse = shapes.noise(x * 3, y * 3, 2.0), shapes.noise(x / 7, y / 7, 4.0)
    color = np.array([0.25, 0.42, 0.14]) * (1 + 0.18 * fine + 0.16 * coarse)[:, None]
    inside = np.maximum(np.abs(x), np.abs(y)) < half + shapes.STREET / 2
    stone = shapes.chance(np.floor(x / 0.22 + np.floor(y / 0.22) % 2 / 2), np.floor(y / 0.22), 7.0)
    joint = (x / 0.22 + np.floor(y / 0.22) % 2 / 2) % 1 < 0.14
    cobbles = (0.44 + 0.16 * stone) * np.where(joint | (y / 0.22 % 1 < 0.14), 0.72, 1.0)
    square = np.maximum(np.abs(x), np.abs(y)) < pitch / 2 - shapes.STREET / 2
    color[square] = cobbles[square, None] * np.array([1.0, 0.94, 0.84])
    pave = inside & (near < shapes.STREET / 2)
    slab = ((x / 0.7 % 1 < 0.06) | (y / 0.7 % 1 < 0.06)) & pave
    color[pave] = (0.58 + 0.04 * fine[pave, None]) * np.array([1.0, 0.98, 0.94])
    color[slab] *= 0.82
    road = inside & (near < shapes.STREET / 2 - shapes.PAVEMENT)
    color[road] = (0.29 + 0.03 * fine[road] + 0.02 * coarse[road])[:, None]
    kerb = inside & (np.abs(near - shapes.STREET / 2 + shapes.PAVEMENT) < 0.12)
    color[kerb] = 0.7
    crossing = to_line.max(axis=0) < shapes.STREET / 2 - shapes.PAVEMENT
    dashes = road & ~crossing & (near < 0.08) & (lengthwise % 3.0 < 1.6)
    stripes = road & (np.abs(to_line.max(axis=0) - 4.1) < 1.2) & (near % 0.9 < 0.45)
    color[(dashes | stripes) & inside] = 0.86
    return color, gloss


def _leaves(plan: Plan, counts: np.ndarray, rng: np.random.Generator) -> Discs:
    """Return the crowns of the trees: discs in random directions, mostly outwards."""
    crown = np.repeat(plan.crowns, counts, axis=0)
    number = np.repeat(np.arange(len(counts)), counts)
    out = rng.normal(size=(len(crown), 3))
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    lumps = shapes.noise(out[:, 0] * 2.2 + number, out[:, 1] * 2.2 + out[:, 2] * 2.2, 9.0)
    reach = (0.86 + 0.16 * lumps) * np.maximum(rng.random(len(crown)), 0.35) ** 0.25
    means = crown[:, :3] + out * reach[:, None] * crown[:, [3, 3, 4]]
    normals = out + 0.7 * rng.normal(size=out.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    tangents = np.cross(normals, rng.normal(size=out.shape))
    area = 4 * np.pi * crown[:, 3] ** 1.3 * crown[:, 4] ** 0.7
    size = 1.25 * np.sqrt(area / np.repeat(counts, counts))[:, None]
    hue = shapes.chance(number, number * 0.37, 3)[:, None]
    albedo = np.array([0.20, 0.36, 0.10]) * (1 - hue) + np.array([0.38, 0.42, 0.12]) * hue
    albedo = albedo * (0.7 + 0.6 * rng.random((len(crown), 1))) * (0.55 + 0.45 * reach[:, None])
    color = _lit(plan, means + out * 1.2, out, albedo)
    return Discs(means, normals, tangents, size, color, np.full(len(means), 0.04))


def _hills(plan: Plan, count: int, rng: np.random.Generator) -> Discs:
    """Return the land around the town, with uniform density as seen from the centre."""
    near, far = (plan.half + shapes.PITCH) * 1.0, (plan.half + shapes.PITCH) * 9
    golden = np.arange(count) * 2.399963
    distance = near * (far / near) ** ((np.arange(count) + rng.random(count)) / count)
    x, y = distance * np.cos(golden), distance * np.sin(golden)
    edge = np.maximum(np.abs(x), np.abs(y)) > near - 2  # the town's ground is a square
    x, y, distance = x[edge], y[edge], distance[edge]
    z, step = shapes.hill(x, y, plan.half), 1.0
    slope = np.stack(
        [shapes.hill(x + step, y, plan.half) - z, shapes.hill(x, y + step, plan.half) - z], axis=1
    )
    normals = np.concatenate([-slope, np.full((len(x), 1), step)], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    size = distance[:, None] * np.sqrt(2 * np.pi * np.log(far / near) / count)
    wood = shapes.noise(x / 60, y / 60, 11.0) + 0.4 * shapes.noise(x / 9, y / 9, 12.0, 2) > 0.1
    fields = shapes.chance(np.floor(x / 55), np.floor(y / 42), 13.0)[:, None]
    albedo = np.array([0.30, 0.46, 0.16]) * (1 - fields) + np.array([0.60, 0.56, 0.26]) * fields
    albedo = np.where(wood[:, None], [0.12, 0.24, 0.09], albedo)
    albedo = albedo * (1 + 0.15 * shapes.noise(x / 5, y / 5, 14.0))[:, None]
    means = np.stack([x, y, z - 0.02], axis=1)
    light = np.clip(normals @ shapes.SUN, 0, 1)[:, None] * shapes.SUN_LIGHT + shapes.SKY_LIGHT
    color = (np.clip(albedo, 0, 1) ** 2.2 * light).clip(0, 1) ** (1 / 2.2)
    haze = (1 - np.exp(-distance / (5 * far / 9)))[:, None]
    color = color * (1 - haze) + np.array([0.74, 0.82, 0.90]) * haze
    return Discs(means, normals, np.cross(normals, [0.0, 1.0, 0.0]), size, color, np.zeros(len(x)))


def _sky(plan: Plan, count: int) -> Discs:
    """Return a sky dome with clouds, far behind the hills."""
    number = np.arange(count, dtype=np.float64)
    z = 1 - 1.12 * (number + 0.5) / count
    ring, angle = np.sqrt(np.maximum(1 - z * z, 0)), number * 2.399963
    out = np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1)
    radius = (plan.half + shapes.PITCH) * 14
    size = np.full((count, 1), 1.4 * radius * np.sqrt(2.24 * np.pi / count))
    blue = z.clip(0, 1)[:, None] ** 0.6
    color = np.array([0.80, 0.87, 0.94]) * (1 - blue) + np.array([0.28, 0.48, 0.80]) * blue
    flat = np.maximum(z, 0.04)
    across, along = out[:, 0] / flat, out[:, 1] / flat
    clouds = shapes.noise(across * 0.8, along * 0.8, 20.0, 4) * 0.9 - 0.05
    white = clouds.clip(0, 0.85)[:, None]
    color = color * (1 - white) + 0.97 * white
    tangents = np.cross(out, [0.31, 0.52, 0.79])
    return Discs(out * radius, np.negative(out), tangents, size, color, np.zeros(count))


def _lit(plan: Plan, means: np.ndarray, normals: np.ndarray, albedo: np.ndarray) -> np.ndarray:
    """Shade surfaces with sun, shadows, sky and ambient occlusion; return display colours (N, 3)."""
    reach, size = plan.half + shapes.PITCH, len(plan.heights)
    sunny = np.clip(normals @ shapes.SUN, 0, 1)
    shadow = np.zeros(len(means), bool)
    for distance in np.geomspace(0.5, 34, 26):
        x, y, z = (means + shapes.SUN * distance).T
        column, row = (((axis + reach) / plan.cell).astype(int).clip(0, size - 1) for axis in (x, y))
        shadow |= plan.heights[row, column] > z + 0.15
    sunny[shadow] = 0
    low = 0.72 + 0.28 * np.clip(means[:, 2] / 2.5, 0, 1)
    sky = (0.62 + 0.38 * normals[:, 2]) * low
    light = sunny[:, None] * shapes.SUN_LIGHT + sky[:, None] * shapes.SKY_LIGHT * 1.25
    return (np.clip(albedo, 0, 1) ** 2.2 * light).clip(0, 1) ** (1 / 2.2)


def _splats(discs: Discs, sh_degree: int, rng: np.random.Generator) -> Splats:
    """Convert discs to splats; glossy ones get a lobe around the sun's mirror direction."""
    means, normals, tangents, size, color, gloss = discs
    count = len(means)
    tangents = tangents - normals * np.sum(tangents * normals, axis=1, keepdims=True)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    frame = np.stack([tangents, np.cross(normals, tangents), normals], axis=2)
    sizes = np.column_stack([size[:, 0], size[:, -1], 0.15 * size.min(axis=1)])
    scales = 0.55 * sizes * rng.uniform(0.85, 1.15, (count, 3))
    opacity = rng.uniform(0.9, 0.99, count)
    sh = np.zeros((count, coefficient_count(sh_degree), 3), np.float32)
    sh[:, 0] = (color - 0.5) / SH_C0
    # mirror direction of the sunlight; a camera that sees the reflection looks the opposite way
    onwards = 2 * normals * (normals @ shapes.SUN)[:, None] - shapes.SUN
    x, y, z = -onwards.T
    directional = np.zeros((coefficient_count(sh_degree), count))
    basis(x, y, z, sh_degree, directional)
    # exp(4 (cos - 1)) as zonal harmonics, degree by degree
    lobe = np.repeat([1.5703, 1.1788, 0.6862, 0.3211], [1, 3, 5, 7])[: len(directional)]
    shine = (gloss + 0.03) * lobe[:, None] * directional
    sh[:, 1:] = shine[1:].T[..., None] * np.array([1.0, 0.97, 0.9])
    quats = Rotation.from_matrix(frame).as_quat(scalar_first=True)
    return Splats(
        means.astype(np.float32), quats.astype(np.float32), np.log(scales).astype(np.float32),
        np.log(opacity / (1 - opacity)).astype(np.float32), sh,
    )  # fmt: skip


# -- cameras ------------------------------------------------------------------------------------


def level_camera(name: str, position: np.ndarray, target: np.ndarray) -> Camera:
    """Return a level camera at a position (3,) that looks at a target (3,)."""
    pose = look_at(position, target, (0.0, 0.0, 1.0))
    return Camera(name, WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, pose)


def walk(plan: Plan, count: int, phase: float = 0.0) -> list[Camera]:
    """Return views along the streets at eye height: around the square, then around the surrounding blocks.

    Args:
        plan: the town.
        count: number of views, evenly spaced along the path.
        phase: offset of the views in [0, 1), as a share of their spacing.
    """
    corners = [(-0.5, -0.5)]
    for ring in range(max(plan.blocks // 2, 1)):
        out = ring + 0.5
        corners += [(out, -out), (out, out), (-out, out), (-out, -out - 1)]
    corners = np.array(corners) * shapes.PITCH
    lengths = np.append(0, np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1)))
    fine = np.linspace(0, lengths[-1], int(lengths[-1] * 4))
    path = np.stack([np.interp(fine, lengths, axis) for axis in corners.T], axis=1)
    smooth = np.hanning(41) / np.hanning(41).sum()
    padded = np.pad(path, ((20, 20), (0, 0)), mode="edge")
    path = np.stack([np.convolve(axis, smooth, "valid") for axis in padded.T], axis=1)
    samples = (np.arange(count) + phase) / count * (len(path) - 30)
    at, ahead = (_along(path, samples + shift) for shift in (0, 24))
    turn = 0.45 * np.sin(samples / len(path) * 2 * np.pi * 9)  # look at the houses on both sides
    forward = ahead - at
    leftward = np.stack([-forward[:, 1], forward[:, 0]], axis=1)
    gaze = at + forward * np.cos(turn)[:, None] + leftward * np.sin(turn)[:, None]
    side = 3.5 * leftward / np.linalg.norm(leftward, axis=1, keepdims=True)
    positions = np.column_stack([at - side, np.full(count, EYE_HEIGHT)])
    targets = np.column_stack([gaze - side, EYE_HEIGHT + 0.35 + 0.4 * np.sin(samples / 31)])
    return [
        level_camera(f"walk_{number:03d}", position, target)
        for number, (position, target) in enumerate(zip(positions, targets, strict=True))
    ]


def _along(path: np.ndarray, samples: np.ndarray) -> np.ndarray:
    return np.stack([np.interp(samples, np.arange(len(path)), axis) for axis in path.T], axis=1)


def flight(plan: Plan, count: int, phase: float = 0.0) -> list[Camera]:
    """Return views of a flight over the roofs in a rising spiral; arguments as for :func:`walk`."""
    share = (np.arange(count) + phase) / count
    angle, distance = share * 4 * np.pi, plan.half * (1.15 - 0.75 * share)
    positions = np.stack([distance * np.cos(angle), distance * np.sin(angle), 24 + 30 * share], axis=1)
    targets = np.stack(
        [0.35 * distance * np.cos(angle + 1.1), 0.35 * distance * np.sin(angle + 1.1), 2 + 0 * angle], axis=1
    )
    poses = enumerate(zip(positions, targets, strict=True))
    return [level_camera(f"flight_{n:03d}", position, target) for n, (position, target) in poses]


def courtyard(plan: Plan, count: int) -> list[Camera]:
    """Return views from the edge of the widest garden between houses, looking across it at eye height.

    Args:
        plan: the town.
        count: number of views, in order around the garden.
    """
    reach = plan.half + shapes.PITCH
    axis = (np.arange(len(plan.heights)) + 0.5) * plan.cell - reach
    x, y = np.meshgrid(axis, axis)
    in_block = (np.abs((np.stack([x, y]) + plan.half) % shapes.PITCH - shapes.PITCH / 2) < GARDEN).all(0)
    in_town = np.maximum(np.abs(x), np.abs(y)) < plan.half
    square = np.maximum(np.abs(x), np.abs(y)) < shapes.PITCH / 2
    free = (maximum_filter(plan.heights, 3) < 0.5) & in_block & in_town & ~square
    regions, number = cast(tuple[np.ndarray, int], label(free))
    largest = 1 + int(np.bincount(regions.ravel(), minlength=number + 1)[1:].argmax())
    row, column = np.nonzero(regions == largest)
    floor = np.stack([axis[column], axis[row]], axis=1)
    center = floor.mean(0)
    out = floor - center
    angle = np.arctan2(out[:, 1], out[:, 0])
    cameras = []
    for index in range(count):
        direction = 2 * np.pi * (index + 0.5) / count - np.pi
        difference = np.abs((angle - direction + np.pi) % (2 * np.pi) - np.pi)
        distance = np.linalg.norm(out, axis=1)
        at = floor[np.argmax(np.where(difference < max(np.pi / count, 0.15), distance, 0))]
        side = 0.6 * np.sin(index * 2.4) * (center - at)[::-1] * [-1, 1]
        height = EYE_HEIGHT + 0.15 * np.sin(index * 1.7)
        target = np.append(center + side, height + 0.3 + 0.5 * np.sin(index * 0.9))
        cameras.append(level_camera(f"yard_{index:03d}", np.append(at, height), target))
    return cameras


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path, help="output folder")
    parser.add_argument("--splats", type=int, default=3_000_000)
    parser.add_argument("--sh-degree", type=int, default=1, choices=range(4))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cameras", type=int, default=48, help="number of camera files per path")
    parser.add_argument(
        "--views", type=int, default=0, help="photos per path of a COLMAP scene; 0 writes none"
    )
    options = parser.parse_args()
    plan = plan_for(options.splats, options.seed)
    splats = build(plan, options.splats, options.sh_degree, options.seed)
    write_ply(options.out / "town.ply", splats)
    for path in (walk, flight):
        for camera in path(plan, options.cameras, 0.5):
            write_camera(options.out / "cameras" / f"{camera.name}.json", camera, NEAR)
    print(f"{len(splats):,} splats, {plan.blocks} x {plan.blocks} blocks: {options.out / 'town.ply'}")
    if options.views:
        views = [*walk(plan, options.views), *flight(plan, options.views)]
        write_scene(options.out / "scene", splats, views, NEAR, POINTS)


if __name__ == "__main__":
    main()

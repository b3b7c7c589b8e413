"""Plan and shapes of the town: streets, houses, a church and a square, trees, hills and sky. Uses numpy only.

Shapes are parallelograms (``Sheets``: walls, roofs, ground; tapered for gables and spires) and crowns of
trees. Colours are functions of the position on a sheet, so that splats can have any size. Lengths are in
metres, z is up, the origin is the centre of the square.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

PITCH = 36.0  # spacing of streets
STREET = 9.0  # width between front walls, with pavements
PAVEMENT = 2.0
FLOOR = 2.9  # height of a storey
SUN = np.array([0.52, -0.38, 0.76]) / np.linalg.norm([0.52, -0.38, 0.76])  # direction to the sun
SKY_LIGHT, SUN_LIGHT = np.array([0.42, 0.46, 0.54]), np.array([1.02, 0.92, 0.74])

WALL, ROOF, GROUND, PLAIN, CAR, WATER, HEDGE, STONE = range(8)
DENSITY = np.array([12.0, 5.0, 1.2, 9.0, 16.0, 4.0, 6.0, 8.0])
"""Splats per square metre of a material, relative to the ground."""
CROWN_DENSITY = 5.0
GLOSS = np.array([0.0, 0.03, 0.0, 0.02, 0.35, 0.4, 0.0, 0.05])

PLASTER = np.array([
    [0.86, 0.80, 0.66], [0.78, 0.62, 0.44], [0.84, 0.72, 0.60], [0.70, 0.44, 0.34], [0.88, 0.86, 0.80],
    [0.66, 0.70, 0.62], [0.62, 0.66, 0.74], [0.90, 0.78, 0.52],
])  # fmt: skip
TILES = np.array([[0.52, 0.24, 0.16], [0.44, 0.20, 0.15], [0.30, 0.30, 0.33], [0.58, 0.32, 0.20]])
SHUTTERS = np.array([[0.22, 0.36, 0.26], [0.30, 0.20, 0.14], [0.22, 0.30, 0.42], [0.55, 0.16, 0.14]])
PAINT = np.array(
    [[0.6, 0.08, 0.08], [0.1, 0.2, 0.45], [0.75, 0.75, 0.75], [0.08, 0.08, 0.09], [0.2, 0.4, 0.3]]
)


@dataclass
class Sheets:
    """Q parallelograms.

    Attributes:
        corner: (Q, 3) start of both edges.
        across, up: (Q, 3) the edges; the normal is across x up.
        material: (Q,) one of the constants above.
        color: (Q, 3) in [0, 1], linear.
        taper: (Q,) shortening of the far edge: 0 for a parallelogram, 1 for a triangle.
        seed: (Q,) seed of random details.
    """

    corner: np.ndarray
    across: np.ndarray
    up: np.ndarray
    material: np.ndarray
    color: np.ndarray
    taper: np.ndarray
    seed: np.ndarray

    def __len__(self) -> int:
        return len(self.corner)

    @property
    def normals(self) -> np.ndarray:
        """(Q, 3), of length 1."""
        normal = np.cross(self.across, self.up)
        return normal / np.linalg.norm(normal, axis=1, keepdims=True)

    @property
    def areas(self) -> np.ndarray:
        """(Q,) square metres."""
        return np.linalg.norm(np.cross(self.across, self.up), axis=1) * (1 - self.taper / 2)


@dataclass
class Plan:
    """Layout of a town.

    Attributes:
        blocks: number of blocks per side; odd, with the square in the middle.
        sheets: all surfaces.
        crowns: (T, 5) crowns of trees: x, y, z of the centre, horizontal radius, vertical radius.
        heights: (H, H) height map for shadows.
        cell: cell size of the height map in metres.
    """

    blocks: int
    sheets: Sheets
    crowns: np.ndarray
    heights: np.ndarray
    cell: float

    @property
    def half(self) -> float:
        """Distance from the centre to the centre line of the outermost street."""
        return self.blocks * PITCH / 2


class Builder:
    """Gathers sheets."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self._rows: list[tuple] = []

    def sheet(self, corner, across, up, material, color, taper=0.0) -> None:
        self._rows.append((corner, across, up, material, color, taper, self.rng.integers(1 << 30)))

    def box(self, at, turn, size, material, color, roof=None, bottom=0.0) -> None:
        """Add a box with a lid of (material, color) ``roof``; ``at`` is the centre of its base."""
        x, y = axes(turn)
        wide, deep, high = size
        lift, foot = np.array([0, 0, high]), np.array([*at[:2], at[2] + bottom])
        walls = (x, -y, wide, deep), (y, x, deep, wide), (-x, y, wide, deep), (-y, -x, deep, wide)
        for along, out, width, through in walls:
            half = through / 2
            self.sheet(foot + out * half - along * width / 2, along * width, lift, material, color)
        lid, tint = roof or (material, color)
        self.sheet(foot + lift - x * wide / 2 - y * deep / 2, x * wide, y * deep, lid, tint)

    def spire(self, at, turn, half, high, material, color) -> None:
        """Add a pyramid with a square base of side 2 half."""
        for quarter in range(4):
            x, y = axes(turn + quarter * np.pi / 2)
            corner = at - y * half - x * half
            self.sheet(corner, 2 * half * x, y * half + np.array([0, 0, high]), material, color, 1.0)

    def house(self, at, turn, wide, deep, floors) -> None:
        """Add a house with plastered walls, a gabled roof parallel to the street, and a chimney."""
        rng, (x, y) = self.rng, axes(turn)
        wall, tile = PLASTER[rng.integers(len(PLASTER))], TILES[rng.integers(len(TILES))]
        high, steep = floors * FLOOR + 0.6, rng.uniform(0.75, 1.05)
        at = np.array([*at, 0.0])
        self.box(at, turn, (wide, deep, high), WALL, wall, roof=(PLAIN, wall * 0.5))
        ridge, lift, over = steep * deep / 2, np.array([0, 0, high]), 0.45
        for side in (1, -1):  # gables, then the two roof planes with eaves
            foot = at + lift + side * x * wide / 2 - side * y * deep / 2
            self.sheet(foot, side * y * deep, np.array([0, 0, ridge]), PLAIN, wall * 0.96, 1.0)
            eave = at + lift - side * (y * (deep / 2 + over) + x * (wide / 2 + over))
            eave = eave - np.array([0, 0, over * steep])
            slope = side * y * (deep / 2 + over) + np.array([0, 0, ridge + over * steep])
            self.sheet(eave, side * x * (wide + 2 * over), slope, ROOF, tile)
        stack = at + x * wide * rng.uniform(-0.3, 0.3) + y * deep * 0.12
        self.box(stack, turn, (0.8, 0.6, 1.9), PLAIN, np.array([0.45, 0.22, 0.17]), bottom=high + ridge - 1.2)

    def car(self, at, turn) -> None:
        color = PAINT[self.rng.integers(len(PAINT))]
        at = np.array([*at, 0.0])
        self.box(at, turn, (4.1, 1.7, 0.62), CAR, color, bottom=0.28)
        self.box(at, turn, (2.1, 1.5, 0.5), CAR, np.array([0.05, 0.06, 0.08]), roof=(CAR, color), bottom=0.9)
        for end in (-1.3, 1.3):
            self.box(at + axes(turn)[0] * end, turn, (0.6, 1.74, 0.5), PLAIN, np.full(3, 0.02), bottom=0.0)

    def sheets(self) -> Sheets:
        corner, across, up, material, color, taper, seed = map(np.array, zip(*self._rows, strict=True))
        return Sheets(corner, across, up, material, color, taper, seed)


def axes(turn: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the rotated east and north axes."""
    c, s = np.cos(turn), np.sin(turn)
    return np.array([c, s, 0.0]), np.array([-s, c, 0.0])


def lay_out(blocks: int, seed: int) -> Plan:
    """Lay out a town of blocks x blocks with the square in the middle."""
    build, rng, crowns = Builder(np.random.default_rng(seed)), np.random.default_rng([seed, 1]), []
    half = blocks * PITCH / 2
    reach = half + PITCH
    build.sheet(
        np.array([-reach, -reach, 0]),
        np.array([2 * reach, 0, 0]),
        np.array([0, 2 * reach, 0]),
        GROUND,
        np.ones(3),
    )
    for row in range(blocks):
        for column in range(blocks):
            center = (np.array([column, row]) + 0.5) * PITCH - half
            if row == column == blocks // 2:
                _square(build, crowns, rng)
            else:
                _block(build, crowns, rng, center)
    for line in np.arange(blocks + 1) * PITCH - half:  # lamps and parked cars along every street
        for at in np.arange(-half + 9, half - 4, 12.0):
            for x, y, turn in ((line, at, np.pi / 2), (at, line, 0.0)):
                if (
                    rng.random() < 0.45
                    and abs(at / PITCH + blocks / 2 - round(at / PITCH + blocks / 2)) > 0.16
                ):
                    side = rng.choice((-1, 1)) * (STREET / 2 - PAVEMENT - 1.0)
                    build.car(np.array([x, y]) + axes(turn)[1][:2] * side, turn + np.pi * rng.integers(2))
                pole = np.array([x, y]) + axes(turn)[1][:2] * (STREET / 2 - PAVEMENT + 0.4)
                build.box(np.array([*pole, 0]), turn, (0.12, 0.12, 4.2), PLAIN, np.full(3, 0.06))
                build.box(
                    np.array([*pole, 0]),
                    turn,
                    (0.34, 0.34, 0.5),
                    PLAIN,
                    np.array([0.9, 0.85, 0.6]),
                    bottom=4.2,
                )
    sheets = build.sheets()
    heights, cell = _heights(sheets, np.array(crowns), reach)
    return Plan(blocks, sheets, np.array(crowns), heights, cell)


def _block(build: Builder, crowns: list, rng: np.random.Generator, center: np.ndarray) -> None:
    """Add houses along the four streets around a garden with trees."""
    inner = PITCH / 2 - STREET / 2  # from the centre of the block to its edge
    for quarter in range(4):
        turn = quarter * np.pi / 2
        x, y = axes(turn)
        offset, limit = -inner + rng.uniform(0.3, 1.0), inner - 9.0
        while offset < limit - 6:
            wide = min(rng.uniform(7.5, 11.5), limit - offset)
            deep = rng.uniform(7.0, 8.4)
            at = center + x[:2] * (offset + wide / 2) - y[:2] * (inner - deep / 2 - rng.uniform(0.1, 1.4))
            build.house(at, turn, wide, deep, int(rng.integers(2, 5)))
            offset += wide + (0.0 if rng.random() < 0.6 else rng.uniform(1.5, 3.0))
        hedge = center + x[:2] * (inner - 4.5) - y[:2] * (inner - 0.4)
        build.box(np.array([*hedge, 0.0]), turn, (7.5, 0.7, 1.3), HEDGE, np.array([0.16, 0.30, 0.10]))
    for _ in range(rng.integers(3, 6)):
        _tree(build, crowns, rng, center + rng.uniform(-4.5, 4.5, 2))
    for corner in ((1, -1), (1, 1), (-1, 1), (-1, -1)):
        if rng.random() < 0.7:
            _tree(build, crowns, rng, center + np.array(corner) * (inner - 2.6))


def _tree(build: Builder, crowns: list, rng: np.random.Generator, at: np.ndarray) -> None:
    high, radius = rng.uniform(5.0, 9.5), rng.uniform(1.5, 2.6)
    build.box(
        np.array([*at, 0.0]), rng.uniform(0, 3), (0.35, 0.35, high * 0.6), PLAIN, np.array([0.18, 0.12, 0.08])
    )
    crowns.append((*at, high * 0.68, radius, high * 0.36))


def _square(build: Builder, crowns: list, rng: np.random.Generator) -> None:
    """Add a church, a fountain, market stalls and rows of trees."""
    stone, slate = np.array([0.72, 0.66, 0.54]), np.array([0.24, 0.27, 0.30])
    build.house(np.array([-6.0, 5.5]), 0.0, 13.0, 8.0, 2)
    tower = np.array([3.4, 5.5, 0.0])
    build.box(tower, 0.0, (5.2, 5.2, 19.0), WALL, stone)
    build.spire(tower + np.array([0, 0, 19.0]), 0.0, 2.9, 11.0, ROOF, slate)
    basin = np.array([0.0, -5.5, 0.0])
    for angle in np.arange(24) * np.pi / 12:
        out, along = axes(angle)
        build.sheet(basin + out * 2.6 - along * 0.35, along * 0.7, np.array([0, 0, 0.7]), STONE, stone)
        build.sheet(
            basin + out * 2.25 + along * 0.35, -along * 0.7, np.array([0, 0, 0.7]), STONE, stone * 0.8
        )
        build.sheet(
            basin + out * 2.6 - along * 0.35 + np.array([0, 0, 0.7]), along * 0.7, -out * 0.4, STONE, stone
        )
    build.sheet(
        basin + np.array([-1.9, -1.9, 0.5]),
        np.array([3.8, 0, 0]),
        np.array([0, 3.8, 0]),
        WATER,
        np.array([0.12, 0.25, 0.30]),
    )
    build.box(basin, 0.4, (0.5, 0.5, 2.6), STONE, stone)
    build.spire(basin + np.array([0, 0, 2.6]), 0.4, 0.5, 1.2, STONE, stone)
    for offset in (-9.0, -5.5, 5.5, 9.0):
        color = SHUTTERS[rng.integers(len(SHUTTERS))] * 1.5
        at = np.array([offset, -10.5, 0.0])
        build.box(at, 0.0, (2.4, 1.4, 0.9), PLAIN, np.array([0.40, 0.26, 0.14]))
        build.spire(at + np.array([0, 0, 2.1]), 0.0, 1.5, 0.9, PLAIN, color)
        for x in (-1.1, 1.1):
            build.box(at + np.array([x, 0.6, 0]), 0.0, (0.08, 0.08, 2.2), PLAIN, np.full(3, 0.3))
    for x in (-11.5, 11.5):
        for y in (-9.0, -3.0, 3.0, 9.0):
            _tree(build, crowns, rng, np.array([x, y]))


def _heights(sheets: Sheets, crowns: np.ndarray, reach: float) -> tuple[np.ndarray, float]:
    """Return the height map from sample points on all surfaces, and its cell size."""
    cell = 0.4
    size = int(2 * reach / cell) + 1
    heights = np.zeros((size, size), np.float32)
    solid = sheets.material != GROUND
    steps = np.stack(np.meshgrid(np.linspace(0, 1, 24), np.linspace(0, 1, 24)), -1).reshape(-1, 2)
    narrow = 1 - sheets.taper[solid, None] * steps[None, :, 1]
    u = steps[None, :, 0] * narrow + (1 - narrow) / 2
    points = sheets.corner[solid, None] + sheets.across[solid, None] * u[..., None]
    points = (points + sheets.up[solid, None] * steps[None, :, 1:]).reshape(-1, 3)
    ball = np.random.default_rng(0).normal(size=(400, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    leaves = crowns[:, None, :3] + ball * crowns[:, None, [3, 3, 4]] * 0.9
    points = np.concatenate([points, leaves.reshape(-1, 3)])
    x, y = ((points[:, :2] + reach) / cell).astype(int).clip(0, size - 1).T
    np.maximum.at(heights, (y, x), points[:, 2].astype(np.float32))
    return heights, cell


def noise(x: np.ndarray, y: np.ndarray, seed: float = 0.0, octaves: int = 3) -> np.ndarray:
    """Return smooth noise in about [-1, 1] for points in the plane, with a coarsest wavelength of one."""
    total, size = np.zeros(np.broadcast(x, y).shape), 1.0
    for octave in range(octaves):
        x0, y0 = np.floor(x), np.floor(y)
        fx, fy = x - x0, y - y0
        fx, fy = fx * fx * (3 - 2 * fx), fy * fy * (3 - 2 * fy)
        a, b, c, d = (chance(x0 + i, y0 + j, seed + octave) for i, j in ((0, 0), (1, 0), (0, 1), (1, 1)))
        total += size * (2 * (a + (b - a) * fx + (c - a) * fy + (a - b - c + d) * fx * fy) - 1)
        x, y, size = x * 2.03, y * 2.03, size / 2
    return total


def chance(x: np.ndarray, y: np.ndarray, seed) -> np.ndarray:
    """Return a reproducible random number in [0, 1) for each cell of a grid."""
    mixed = np.sin(x * 127.1 + y * 311.7 + np.asarray(seed) % 1000 * 74.7) * 43758.5453
    return mixed - np.floor(mixed)


def hill(x: np.ndarray, y: np.ndarray, half: float) -> np.ndarray:
    """Return the height of the land; level inside the town."""
    distance = np.maximum(np.hypot(x, y) / (half + PITCH) - 1.15, 0)
    rise = 1 - np.exp(-distance * 0.55)
    rolling = 0.5 + 0.35 * noise(x / (1.6 * half + 60), y / (1.6 * half + 60), 5.0)
    return rise * (0.55 * half + 26) * np.maximum(rolling, 0.06)

"""Where the ground is: a plane through places, or the one that most of a scene stands on. numpy only."""

from __future__ import annotations

import numpy as np

from ..errors import LodgsError
from ..splats.similarity import Similarity

FLAT = 1e-3
"""Places along a line are spread less than this share of its length beside it."""
LEAN = 40.0
"""Degrees that a ground may lean from what is level."""
TRIES, BATCH = 2000, 100
"""Planes that are tried, through three places each, and how many at a time."""
MOST = 20_000
"""Places that are looked at, of more evenly chosen ones."""
THICK = 0.005
"""A plane has the places that are no farther from it than this share of the scene's size..."""
BELOW = 2.0
"""... and each place that is farther below it counts against so many of these."""
NEAR, FEW = 1.5, 100
"""How far from the cameras a ground is looked for, in the depths that they mostly see, if so many places are
there."""
FEWEST = 0.02
"""A ground has at least this share of the places."""


def fit_plane(places: np.ndarray, up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The plane that fits places (P, 3) best, by least squares of the distances from it.

    Args:
        up: (3,) the normal is on this side.

    Returns:
        Its normal (3,) of length 1, and the middle of the places (3,), which is on it; float64.

    Raises:
        LodgsError: there are fewer than three places, or they are on a line.
    """
    places = np.asarray(places, np.float64).reshape(-1, 3)
    if len(places) < 3:
        raise LodgsError(
            f"{len(places)} places are selected, and a ground goes through three or more.",
            "Select points of the ground in Edit Mode, or empties that stand on it.",
        )
    middle = places.mean(axis=0)
    squares = (places - middle).T @ (places - middle)
    values, vectors = np.linalg.eigh(squares)
    if values[1] <= FLAT**2 * values[2] or values[2] <= 0:
        raise LodgsError("The places that are selected are on a line.", "Select places beside it, too.")
    normal = vectors[:, 0]
    return normal * (-1.0 if normal @ up < 0 else 1.0), middle


def find_ground(places: np.ndarray, up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The plane under a scene: many places are on it, hardly any are below, and it is about level.

    Random sample consensus (Fischler and Bolles 1981) with a fixed seed, so that the same places give the
    same plane, which then is fitted to what is on it. The best has the most places on it less BELOW times
    those below, within the size of what is neither far outside nor far below.

    Args:
        places: (P, 3), such as a scene's points or the means of its splats.
        up: (3,) about which way is up.

    Returns:
        As :func:`fit_plane`.

    Raises:
        LodgsError: no plane has as many places as a ground has.
    """
    places = np.asarray(places, np.float64).reshape(-1, 3)
    places = places[np.isfinite(places).all(axis=1)]
    rng, up = np.random.default_rng(0), np.asarray(up, np.float64) / np.linalg.norm(up)
    if len(places) > MOST:
        places = places[rng.choice(len(places), MOST, replace=False)]
    if len(places) >= 3:
        low, high = np.percentile(places, (5, 95), axis=0)
        reach = high - low
        places = places[((places >= low - reach) & (places <= high + reach)).all(axis=1)]
        thick = THICK * float(np.linalg.norm(reach))
        best, least = None, FEWEST * len(places)
        for _ in range(TRIES // BATCH):
            a, b, c = places[rng.integers(len(places), size=(3, BATCH))]
            normals = np.cross(b - a, c - a)
            lengths = np.linalg.norm(normals, axis=1)
            normals = normals / np.maximum(lengths, 1e-300)[:, None]
            normals *= np.where(normals @ up < 0, -1, 1)[:, None]
            level = (normals @ up > np.cos(np.radians(LEAN))) & (lengths > 0)
            normals, begins = normals[level], a[level]
            heights = normals @ places.T - (normals * begins).sum(axis=1)[:, None]
            on = (np.abs(heights) <= thick).sum(axis=1)
            scores = on - BELOW * (heights < -thick).sum(axis=1)
            if len(scores) and scores.max() > least:
                least, best = scores.max(), (normals[scores.argmax()], begins[scores.argmax()])
        if best is not None:
            normal, middle = best
            for _ in range(5):
                on = np.abs((places - middle) @ normal) <= thick
                normal, middle = fit_plane(places[on], up)
            return normal, middle
    raise LodgsError(
        "No plane lies under this scene.", "Select points of its ground in Edit Mode, or empties on it."
    )


def points_near_cameras(places: np.ndarray, center: np.ndarray, depth: float) -> np.ndarray:
    """Those of places (P, 3) among which a ground is looked for: land rises farther away.

    Args:
        center: (3,) the middle of the cameras.
        depth: how deep they mostly look; 0: not known, and all count.
    """
    near = places[np.linalg.norm(places - center, axis=1) < NEAR * depth]
    return near if len(near) > FEW else places


def ground_placement(normal: np.ndarray, middle: np.ndarray) -> Similarity:
    """What makes a plane z = 0 with its normal (3,) up: turned as little as possible about its point (3,),
    and moved up or down."""
    z = np.array([0.0, 0.0, 1.0])
    axis, cosine = np.cross(normal, z), float(normal @ z)
    if cosine < -1 + 1e-12:  # any half turn
        rotation = np.diag([1.0, -1.0, -1.0])
    else:
        cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
        rotation = np.eye(3) + cross + cross @ cross / (1 + cosine)
    return Similarity(rotation, 1.0, middle * (1, 1, 0) - rotation @ middle)


def scaling_about(place: np.ndarray, scale: float) -> Similarity:
    """What scales about a place (3,), which stays."""
    place = np.asarray(place, np.float64)
    return Similarity(np.eye(3), scale, place - scale * place)

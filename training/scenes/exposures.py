"""Which photographs are exposed or balanced otherwise than those beside them, by the points that they share.

What changes smoothly, from place to place or from photograph to photograph, splats can show, and a picture
between two photographs should have it. What one photograph has alone, they can only explain by fog before it.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize

from .cameras import Camera
from .colmap import Scene, observations
from .images import load_image

MOST = 500
"""Of more photographs none is compared: each has to be read, and time grows with their cube."""
READERS = 2
SIDE = 480
"""Pixels of the longer side at which colours are compared."""
FEWEST = 50
"""Points that a photograph has to share with others."""
DARKEST, BRIGHTEST = 0.04, 0.95
"""Display-coded values between which a change of exposure is a factor, about."""
LEAST = 0.1
"""Logarithm of the factor by which one photograph has to differ; where none does, all are left alone."""
ROUNDS = 60
"""Colours of points and gains of photographs are found from each other so often."""
ROUGH = 0.03
"""Residuals, in logarithms, from which on they count by their size, not by their square."""


def exposure_gains(scene: Scene, cameras: Sequence[Camera], exposure: float = 0.0) -> dict[str, np.ndarray]:
    """How many times as bright a photograph is as it were if it were exposed as those beside it.

    Args:
        scene: with the points.
        cameras: views whose photographs are compared, in the order in which they were made.
        exposure: stops that are added to photographs of linear light.

    Returns:
        Factors (3,) of display-coded red, green and blue, by the names of views; none where no photograph
        differs by LEAST, where the model does not tell which views observe a point, and of more than MOST.

    Raises:
        LodgsError: a photograph cannot be read.
    """
    if not 2 < len(cameras) <= MOST:
        return {}
    seen = observations(scene, [camera.name for camera in cameras])

    def colors(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        return _colors(scene.points, seen.get(camera.name, np.zeros(0, np.int64)), camera, exposure)

    with ThreadPoolExecutor(READERS) as pool:
        found = list(pool.map(colors, cameras))
    counts = [len(rows) for rows, _ in found]
    view, point = np.repeat(np.arange(len(cameras)), counts), np.concatenate([rows for rows, _ in found])
    values = np.concatenate([logs for _, logs in found])
    shared = np.bincount(point, minlength=len(scene.points))[point] > 1
    compared = np.bincount(view[shared], minlength=len(cameras)) >= FEWEST
    shared &= compared[view]
    which = np.flatnonzero(compared)
    if len(which) < 3:
        return {}
    _, view = np.unique(view[shared], return_inverse=True)
    _, point = np.unique(point[shared], return_inverse=True)
    gains = relative_gains(view, point, values[shared])
    those = [cameras[i] for i in which]
    own = gains - smooth_gains(
        gains,
        np.array([camera.center for camera in those]) / scene.extent(),
        np.array([camera.world_to_camera[2, :3] for camera in those]),
    )
    if np.abs(own).max() < LEAST:
        return {}
    factors = np.round(np.exp(own), 4)  # the same whatever the processor makes of the last bits
    return {camera.name: factor for camera, factor in zip(those, factors, strict=True)}


def remove_gain(image: np.ndarray, gain: np.ndarray) -> np.ndarray:
    """A photograph (H, W, 3) without its own gain (3,); what is white stays so: it may have been brighter."""
    image = image.astype(np.float32)
    white = np.clip((image - BRIGHTEST) / (1 - BRIGHTEST), 0, 1)
    even = image / gain.astype(np.float32)
    return np.minimum(even + white * np.maximum(1 - even, 0), 1)


def relative_gains(view: np.ndarray, point: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Logarithms of the views' gains (V, 3), whose mean is 0, that make colours of points most alike.

    Least absolute deviations, by least squares that are weighted anew; the points' colours are found besides.

    Args:
        view, point: which view sees which point, from 0 on, (O,).
        values: logarithms of the colours there, (O, 3).
    """
    gains, weight = np.zeros((view.max() + 1, 3)), np.ones(len(view))

    def means(index: np.ndarray, of: np.ndarray) -> np.ndarray:
        total = np.bincount(index, weight)
        return np.stack([np.bincount(index, weight * channel) / total for channel in of.T], axis=1)

    for _ in range(ROUNDS):
        apart = values - means(point, values - gains[view])[point]
        gains = means(view, apart)
        gains -= gains.mean(0)
        weight = 1 / np.maximum(np.abs(apart - gains[view]).mean(1), ROUGH)
    return gains


def smooth_gains(gains: np.ndarray, places: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """The part of the views' gains (V, 3) that changes smoothly with place and direction, or with order.

    A Gaussian process of the two and of noise, whose three variances and two lengths are the most likely ones
    (Rasmussen and Williams 2006, Eqs. 2.23 and 2.30); priors, wide ones, only keep lengths within reason.

    Args:
        places: of the cameras, (V, 3), in extents of the scene.
        directions: in which they look, (V, 3).
    """
    # Logarithms, everywhere: variance and length of what goes with place, then with order; variance of noise.
    features, order = np.concatenate([places, directions], axis=1), np.arange(float(len(gains)))
    apart = ((features[:, None] - features) ** 2).sum(-1), (order[:, None] - order) ** 2
    middle = gains.mean(0)
    rest, identity = gains - middle, np.eye(len(gains))
    variance = float(np.mean(rest**2)) + 1e-12
    expected = np.log([variance / 2, 1, variance / 2, 3, variance / 2])
    spread = np.array([3, 0.7, 3, 0.7, 3])

    def covariance(logs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        there, length, then, steps, noise = np.exp(logs)
        signal = there * np.exp(-apart[0] / (2 * length**2)) + then * np.exp(-apart[1] / (2 * steps**2))
        return signal, signal + (noise + 1e-6) * identity

    def unlikely(logs: np.ndarray) -> float:
        try:
            factor = cho_factor(covariance(logs)[1], lower=True)
        except np.linalg.LinAlgError:
            return 1e9
        prior = np.sum(((logs - expected) / spread) ** 2) / 2
        determinant = np.log(np.diag(factor[0])).sum()
        return float(np.sum(rest * cho_solve(factor, rest)) / 2 + gains.shape[1] * determinant + prior)

    starts = [variance * np.array(shares) for shares in ((0.4, 0.4, 0.1), (0.1, 0.1, 0.8), (0.1, 0.8, 0.1))]
    tries = [
        minimize(unlikely, np.log([there, 1, then, 3, noise]), method="L-BFGS-B")
        for there, then, noise in starts
    ]
    signal, all_of_it = covariance(min(tries, key=lambda found: found.fun).x)
    return middle + signal @ np.linalg.solve(all_of_it, rest)


def _colors(
    points: np.ndarray, rows: np.ndarray, camera: Camera, exposure: float
) -> tuple[np.ndarray, np.ndarray]:
    """Which of some points (by their rows) show a colour that tells exposure, and its logarithm (K, 3)."""
    camera = camera.scaled(min(1, SIDE / max(camera.width, camera.height)))
    assert camera.image is not None
    x, y, z = camera.view_space(points[rows].astype(np.float64)).T
    with np.errstate(divide="ignore", invalid="ignore"):
        column, row = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    inside = (z > 0) & (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
    rows, column, row = rows[inside], column[inside].astype(int), row[inside].astype(int)
    shown = load_image(camera.image, camera.width, camera.height, exposure=exposure)[row, column]
    tells = (shown.min(1) > DARKEST) & (shown.max(1) < BRIGHTEST)
    return rows[tells], np.log(shown[tells].astype(np.float64))

"""Detect photos with an exposure or white balance unlike their neighbours', by the points that they share.

Photos that share too few points are compared by the exposure time, aperture and ISO in their EXIF data.

Splats can represent brightness that changes smoothly with position or time, and rendered views should contain
it. A deviation of a single photo, in contrast, makes training add fog in front of its camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize

from .cameras import Camera
from .colmap import Scene
from .images import load_image
from .observations import observations

MAX_PHOTOS = 500
"""Number of photos above which nothing is compared: all must be read, and time grows with their cube."""
READERS = 2
"""Number of threads that read photos."""
SIDE = 480
"""Longer side in pixels at which colours are compared."""
MIN_SHARED = 50
"""Minimum number of points that a photo must share with other photos."""
DARKEST, BRIGHTEST = 0.04, 0.95
"""Range of display-coded values in which a change of exposure is approximately a factor."""
MIN_DEVIATION = 0.1
"""Logarithm of the smallest factor worth correcting; if no photo deviates by more, none is corrected."""
CODED_STOP = float(np.log(2) / 2.2)
"""Logarithmic change of display-coded values by a stop of light."""
EXIF_FOLDER, EXPOSURE_TIME, F_NUMBER, ISO = 0x8769, 0x829A, 0x829D, 0x8827
"""EXIF tags."""
ROUNDS = 60
"""Number of alternating estimates of point colours and photo gains."""
ROUGHNESS = 0.03
"""Logarithmic residual above which its absolute value counts instead of its square."""


def exposure_gains(scene: Scene, cameras: Sequence[Camera], exposure: float = 0.0) -> dict[str, np.ndarray]:
    """Return the factors by which photos are brighter than the exposure of their neighbours suggests.

    Args:
        scene: scene with the shared points.
        cameras: views of the compared photos, in the order of capture.
        exposure: exposure in stops for photos of linear light.

    Returns:
        Factors (3,) of display-coded red, green and blue by view name. The dict is empty if no photo deviates
        by MIN_DEVIATION, fewer than three can be compared, or there are more than MAX_PHOTOS photos.

    Raises:
        LodgsError: a photo cannot be read.
    """
    if not 2 < len(cameras) <= MAX_PHOTOS:
        return {}
    indices = observations(scene, [camera.name for camera in cameras])

    def colors(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        return _log_colors(scene.points, indices.get(camera.name, np.zeros(0, np.int64)), camera, exposure)

    with ThreadPoolExecutor(READERS) as pool:
        samples = list(pool.map(colors, cameras))
    counts = [len(rows) for rows, _ in samples]
    view = np.repeat(np.arange(len(cameras)), counts)
    point = np.concatenate([rows for rows, _ in samples])
    values = np.concatenate([logs for _, logs in samples])
    shared = np.bincount(point, minlength=len(scene.points))[point] > 1
    compared = np.bincount(view[shared], minlength=len(cameras)) >= MIN_SHARED
    shared &= compared[view]
    gains = np.full((len(cameras), 3), np.nan)
    if compared.sum() > 2:
        _, rows = np.unique(view[shared], return_inverse=True)
        _, point = np.unique(point[shared], return_inverse=True)
        gains[compared] = relative_gains(rows, point, values[shared])
    stops = [np.nan if camera.image is None else stated_stops(camera.image) for camera in cameras]
    gains = complete_gains(gains, np.array(stops))
    compared = np.isfinite(gains[:, 0])
    compared_views = [camera for camera, has_gain in zip(cameras, compared, strict=True) if has_gain]
    if len(compared_views) < 3:
        return {}
    gains = gains[compared]
    deviations = gains - smooth_gains(
        gains,
        np.array([camera.center for camera in compared_views]) / scene.extent(),
        np.array([camera.world_to_camera[2, :3] for camera in compared_views]),
    )
    if np.abs(deviations).max() < MIN_DEVIATION:
        return {}
    factors = np.round(np.exp(deviations), 4)  # independent of the processor's rounding errors
    return {camera.name: factor for camera, factor in zip(compared_views, factors, strict=True)}


def remove_gain(image: np.ndarray, gain: np.ndarray) -> np.ndarray:
    """Divide a photo (H, W, 3) by its gain (3,). White pixels stay white, because they may be clipped."""
    image = image.astype(np.float32)
    white = np.clip((image - BRIGHTEST) / (1 - BRIGHTEST), 0, 1)
    corrected = image / gain.astype(np.float32)
    return np.minimum(corrected + white * np.maximum(1 - corrected, 0), 1)


def stated_stops(path: Path) -> float:
    """Return the exposure of a photo in stops, up to a constant, from its EXIF data.

    Aperture and ISO count if stated. Without a valid exposure time, the result is NaN.
    """
    try:
        with Image.open(path) as image:
            tags = image.getexif().get_ifd(EXIF_FOLDER)
        time = float(tags[EXPOSURE_TIME])
        light = time * float(tags.get(ISO) or 1) / float(tags.get(F_NUMBER) or 1) ** 2
    except Exception:  # Pillow raises many types for damaged data; the photo itself is read elsewhere
        return np.nan
    return float(np.log2(light)) if 0 < light < np.inf else np.nan


def complete_gains(gains: np.ndarray, stops: np.ndarray) -> np.ndarray:
    """Fill in missing log gains (V, 3), NaN, from stated exposures (V,), NaN if unknown."""
    stated = CODED_STOP * stops[:, None]
    missing = np.isnan(gains[:, 0])
    has_both = ~missing & np.isfinite(stops)
    reference = stated[has_both] - gains[has_both] if has_both.any() else stated[missing & np.isfinite(stops)]
    offset = np.median(reference, axis=0) if len(reference) else 0.0
    return np.where(np.isnan(gains), stated - offset, gains)


def relative_gains(view: np.ndarray, point: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the log gains (V, 3) of the views, with mean 0, that best align the colours of shared points.

    Minimise absolute deviations by iteratively reweighted least squares, with the points' colours as further
    unknowns.

    Args:
        view, point: (O,) indices of the view and the point of each observation.
        values: (O, 3) logarithms of the observed colours.
    """
    gains = np.zeros((view.max() + 1, 3))
    weight = np.ones(len(view))

    def means(index: np.ndarray, samples: np.ndarray) -> np.ndarray:
        total = np.bincount(index, weight)
        return np.stack([np.bincount(index, weight * channel) / total for channel in samples.T], axis=1)

    for _ in range(ROUNDS):
        residuals = values - means(point, values - gains[view])[point]
        gains = means(view, residuals)
        gains -= gains.mean(0)
        weight = 1 / np.maximum(np.abs(residuals - gains[view]).mean(1), ROUGHNESS)
    return gains


def smooth_gains(gains: np.ndarray, positions: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return the part of the views' gains (V, 3) that changes smoothly with pose or with order.

    The model is a Gaussian process over pose and order plus noise, with the most likely three variances and
    two length scales (Rasmussen and Williams 2006, Eqs. 2.23 and 2.30). Wide priors keep the length scales
    plausible.

    Args:
        positions: (V, 3) camera positions in scene extents.
        directions: (V, 3) view directions.
    """
    # Logarithmic hyperparameters: variance and length over pose, then over order; variance of the noise.
    features = np.concatenate([positions, directions], axis=1)
    order = np.arange(float(len(gains)))
    distances = ((features[:, None] - features) ** 2).sum(-1), (order[:, None] - order) ** 2
    middle = gains.mean(0)
    centered = gains - middle
    identity = np.eye(len(gains))
    variance = float(np.mean(centered**2)) + 1e-12
    prior_mean = np.log([variance / 2, 1, variance / 2, 3, variance / 2])
    prior_spread = np.array([3, 0.7, 3, 0.7, 3])

    def covariance(logs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        pose_variance, length, order_variance, steps, noise = np.exp(logs)
        signal = pose_variance * np.exp(-distances[0] / (2 * length**2)) + order_variance * np.exp(
            -distances[1] / (2 * steps**2)
        )
        return signal, signal + (noise + 1e-6) * identity

    def negative_log_posterior(logs: np.ndarray) -> float:
        try:
            factor = cho_factor(covariance(logs)[1], lower=True)
        except np.linalg.LinAlgError:
            return 1e9
        prior = np.sum(((logs - prior_mean) / prior_spread) ** 2) / 2
        determinant = np.log(np.diag(factor[0])).sum()
        return float(
            np.sum(centered * cho_solve(factor, centered)) / 2 + gains.shape[1] * determinant + prior
        )

    starts = [variance * np.array(shares) for shares in ((0.4, 0.4, 0.1), (0.1, 0.1, 0.8), (0.1, 0.8, 0.1))]
    solutions = [
        minimize(
            negative_log_posterior, np.log([pose_variance, 1, order_variance, 3, noise]), method="L-BFGS-B"
        )
        for pose_variance, order_variance, noise in starts
    ]
    signal, total = covariance(min(solutions, key=lambda solution: solution.fun).x)
    return middle + signal @ np.linalg.solve(total, centered)


def _log_colors(
    points: np.ndarray, rows: np.ndarray, camera: Camera, exposure: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows (K,) of points with a usable colour in the photo, and its logarithm (K, 3)."""
    camera = camera.scaled(min(1, SIDE / max(camera.width, camera.height)))
    assert camera.image is not None
    x, y, z = camera.view_space(points[rows].astype(np.float64)).T
    with np.errstate(divide="ignore", invalid="ignore"):
        column, line = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    inside = (z > 0) & (column >= 0) & (line >= 0) & (column < camera.width) & (line < camera.height)
    rows, column, line = rows[inside], column[inside].astype(int), line[inside].astype(int)
    colors = load_image(camera.image, camera.width, camera.height, exposure=exposure)[line, column]
    usable = (colors.min(1) > DARKEST) & (colors.max(1) < BRIGHTEST)
    return rows[usable], np.log(colors[usable].astype(np.float64))

"""Harder copies of scenes for the quality benchmark: fewer photos, changed light, and a rendered courtyard.

Copies hold out their own views: those with few photos hold out views between them, those with changed light
the unchanged photos. All randomness is fixed.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

HERE = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(HERE))

from training.color import linear_from_srgb, srgb_from_linear  # noqa: E402
from training.errors import LodgsError  # noqa: E402
from training.scenes.cameras import Camera, pick_evenly  # noqa: E402
from training.scenes.colmap import Scene, read_scene, scene_lenses  # noqa: E402
from training.scenes.observations import observations  # noqa: E402
from training.scenes.write_colmap import write_model  # noqa: E402

STOPS = 1.5
"""Maximum change of exposure, up or down."""
CAST = 0.25
"""Maximum change of red and blue by white balance, as a logarithm of linear light."""
VIGNETTE = 0.5
"""Loss of linear light at the corners of a vignetted photo."""
EXIF = 0x8769
EXPOSURE_TIME, F_NUMBER, ISO = 0x829A, 0x829D, 0x8827
MEAN_TIME = 1 / 100
"""Exposure time in seconds that a jittered copy states for photos without change."""

Pick = Callable[[Sequence[Camera]], Sequence[Camera]]
Light = Callable[[np.random.Generator], tuple[np.ndarray, float]]


@dataclass(frozen=True)
class Subset:
    """Kind of a copy.

    Attributes:
        about: description for tables.
        pick: photos of the copy, in the order of names.
        test_every: distance of held-out photos, as in ``Scene.split``.
        min_photos: photos that a scene needs.
        light: gain of linear light (3,) and vignette of a training photo, drawn at random; None keeps it.
        exif: write the exposure time that the gain implies.
    """

    about: str
    pick: Pick
    test_every: int = 8
    min_photos: int = 10
    light: Light | None = None
    exif: bool = False


def _row(cameras: Sequence[Camera]) -> Sequence[Camera]:
    first = (len(cameras) - 16) // 2
    return cameras[first : first + 16]


def _arc(cameras: Sequence[Camera]) -> Sequence[Camera]:
    """Pick the 24 cameras closest to the one that is farthest from the mean position."""
    centers = np.array([camera.center for camera in cameras])
    end = centers[np.linalg.norm(centers - centers.mean(0), axis=1).argmax()]
    nearest = np.argsort(np.linalg.norm(centers - end, axis=1), kind="stable")[:24]
    return [cameras[index] for index in sorted(nearest)]


def _third(cameras: Sequence[Camera]) -> Sequence[Camera]:
    """Pick pairs of a held-out camera and a training camera; every third camera trains."""
    return [camera for number, camera in enumerate(cameras[: len(cameras) // 3 * 3]) if number % 3 < 2]


def _jitter(rng: np.random.Generator) -> tuple[np.ndarray, float]:
    return np.full(3, 2.0 ** rng.uniform(-STOPS, STOPS)), 0.0


def _cast(rng: np.random.Generator) -> tuple[np.ndarray, float]:
    warmth = rng.uniform(-CAST, CAST)
    return np.exp([warmth, 0.0, -warmth]), 0.0


SUBSETS = {
    "row": Subset("16 consecutive photos, every 4th held out", _row, 4, 16),
    "arc": Subset("24 photos of one side, every 2nd held out", _arc, 2, 24),
    "third": Subset("every third photo, one beside each held out", _third, 2, 24),
    "few": Subset("24 photos evenly, every 2nd held out", lambda cameras: pick_evenly(cameras, 24), 2, 24),
    "jittered": Subset("exposure changed by up to 1.5 stops", list, light=_jitter),
    "exif": Subset("the same, with exposure times in EXIF", list, light=_jitter, exif=True),
    "cast": Subset("white balance changed by up to 25 %", list, light=_cast),
    "vignetted": Subset("half of the light at the corners", list, light=lambda rng: (np.ones(3), VIGNETTE)),
}
"""Copies by name."""


def write_subset(folder: Path, out: Path, subset: Subset, stops: float = 1.0) -> Path | None:
    """Write a copy of a scene, unless it exists.

    Args:
        folder: scene with its photos.
        out: folder of the copy.
        stops: factor on the logarithm of changes of light.

    Returns:
        ``out``, or None if the scene has too few photos.

    Raises:
        LodgsError: the scene cannot be read.
    """
    if out.exists():
        return out
    scene = read_scene(folder)
    if len(scene.cameras) < subset.min_photos:
        return None
    cameras = list(subset.pick(scene.cameras))
    temporary = out.with_name(f".{out.name}.tmp")
    shutil.rmtree(temporary, ignore_errors=True)
    rng = np.random.default_rng(0)
    for number, camera in enumerate(cameras):
        assert camera.image is not None
        path = temporary / "images" / camera.name
        path.parent.mkdir(parents=True, exist_ok=True)
        if subset.light is None or number % subset.test_every == 0:
            shutil.copyfile(camera.image, path)
            continue
        gain, vignette = subset.light(rng)
        photo = np.asarray(Image.open(camera.image).convert("RGB"))
        changed = Image.fromarray(relight(photo, gain**stops, vignette))
        exif = exposure_tags(float(gain[1]) ** stops) if subset.exif else Image.Exif()
        changed.save(path, exif=exif, quality=97)  # formats without loss ignore the quality
    _write_model(scene, cameras, temporary)
    temporary.rename(out)
    return out


def relight(photo: np.ndarray, gain: np.ndarray, vignette: float = 0.0) -> np.ndarray:
    """Change the light of a photo (H, W, 3) uint8; values above white are clipped.

    Args:
        gain: (3,) factors of linear light.
        vignette: loss of light at the corners; it grows with the square of the distance from the middle.
    """
    height, width = photo.shape[:2]
    y, x = np.mgrid[:height, :width] + 0.5
    square = ((x - width / 2) ** 2 + (y - height / 2) ** 2) / ((width / 2) ** 2 + (height / 2) ** 2)
    light = linear_from_srgb(photo / 255.0) * gain * (1 - vignette * square)[..., None]
    return np.round(255 * srgb_from_linear(np.clip(light, 0, 1))).astype(np.uint8)


def exposure_tags(gain: float) -> Image.Exif:
    """Return EXIF data of an exposure ``gain`` times the mean one."""
    exif = Image.Exif()
    exif.get_ifd(EXIF).update({EXPOSURE_TIME: gain * MEAN_TIME, F_NUMBER: 4.0, ISO: 100})
    return exif


def _write_model(scene: Scene, cameras: Sequence[Camera], out: Path) -> None:
    """Write the model of some cameras, with the points that two of them observe."""
    names = [camera.name for camera in cameras]
    observed = observations(scene, names)
    view_counts = np.zeros(len(scene.points), np.int64)
    for indices in observed.values():
        view_counts[np.unique(indices)] += 1
    observed_twice = view_counts > 1 if observed else np.ones(len(scene.points), bool)
    numbers = np.cumsum(observed_twice) - 1
    lenses = dict(zip((camera.name for camera in scene.cameras), scene_lenses(scene), strict=True))
    tracks = []
    for camera in cameras:
        indices = np.unique(observed.get(camera.name, np.zeros(0, np.int64)))
        indices = indices[observed_twice[indices]]
        tracks.append((numbers[indices], camera.project(scene.points[indices].astype(np.float64))[0]))
    write_model(
        out / "sparse" / "0",
        [lenses[name] for name in names],
        [(camera.name, camera.world_to_camera) for camera in cameras],
        scene.points[observed_twice],
        scene.point_colors[observed_twice],
        tracks,
    )


def write_courtyard(out: Path, splats: int = 1_000_000, photos: int = 36, scale: float = 0.5) -> Path:
    """Render the courtyard of ``examples/town.py`` as a scene, unless it exists.

    Args:
        out: folder of the scene.
        splats: splats of the town.
        photos: number of photos.
        scale: size of the photos, relative to 960x540.
    """
    if not out.exists():
        from examples import town
        from training.runs.capture import write_scene

        plan = town.plan_for(splats)
        cameras = [camera.scaled(scale) for camera in town.courtyard(plan, photos)]
        write_scene(out, town.build(plan, splats), cameras, town.NEAR, points=12_000, antialias=True)
    return out


def main() -> int:
    """Write one copy."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path, metavar="SCENE")
    parser.add_argument("copy", type=Path, metavar="COPY", help="folder to write")
    parser.add_argument("kind", choices=list(SUBSETS))
    parser.add_argument("factor", nargs="?", type=float, default=1.0, help="factor on changes of light")
    options = parser.parse_args()
    subset = SUBSETS[options.kind]
    try:
        copy = write_subset(options.scene, options.copy, subset, options.factor)
    except LodgsError as error:
        print(error.what, error.remedy, file=sys.stderr)
        return 2
    if copy is None:
        print(f"The scene has fewer than {subset.min_photos} photos.", file=sys.stderr)
    return 0 if copy else 1


if __name__ == "__main__":
    sys.exit(main())

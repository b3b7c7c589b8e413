"""Folders inside a scene's folder that cache derived files for all runs and for Blender."""

from __future__ import annotations

import hashlib
import shutil
import tempfile
import time
from pathlib import Path

from .colmap import Scene

ABANDONED_SECONDS = 86_400.0
"""Age at which an unfinished folder in a cache counts as abandoned."""


def writable_cache(scene: Scene, name: str, fallback: Path) -> Path:
    """Return a cache folder inside the scene's folder, or ``fallback`` if that is not writable."""
    cache = scene.folder / name
    try:
        cache.mkdir(exist_ok=True)
        with tempfile.TemporaryFile(dir=cache):
            return cache
    except OSError:
        return fallback


def scene_digest(scene: Scene, version: bytes) -> str:
    """Return a digest of the names, sizes and times of all files of the model and the views.

    Args:
        version: version of the cached files.
    """
    digest = hashlib.blake2b(version, digest_size=16)
    model = sorted(path for path in scene.model.iterdir() if path.suffix in (".bin", ".txt"))
    files = [(path.name, path) for path in model]
    files += [(camera.name, camera.image) for camera in scene.cameras if camera.image is not None]
    files += [(camera.name, camera.mask) for camera in scene.cameras if camera.mask is not None]
    files += [(camera.name, camera.depth) for camera in scene.cameras if camera.depth is not None]
    for name, path in files:
        status = path.stat()
        text = f"{name}\0{status.st_size}\0{status.st_mtime_ns}\0"
        digest.update(text.encode("utf-8", "surrogateescape"))
    return digest.hexdigest()


def remove_abandoned(cache: Path, prefix: str) -> None:
    """Remove the unfinished folders of killed programs."""
    for folder in cache.glob(f"{prefix}*"):
        if time.time() - folder.stat().st_mtime > ABANDONED_SECONDS:
            shutil.rmtree(folder, ignore_errors=True)

"""Comparison of methods on a scene by the trainer in the background."""

from __future__ import annotations

import webbrowser
from collections.abc import Collection

import bpy

from ...training.errors import LodgsError
from .. import extension
from ..data.paths import absolute_path
from . import environment, run_folders
from .program_sequence import ProgramSequence

current: ProgramSequence | None = None
"""The running or last comparison."""


def compare_methods(root: bpy.types.Object, methods: Collection[str]) -> ProgramSequence:
    """Train methods on the photos of a scene root and open a page that compares them.

    The runs and the page are written to the folder "comparison" beside the root's runs. Starting the same
    comparison again resumes it.

    Args:
        methods: names of methods, at least one.

    Raises:
        LodgsError: a comparison is running, the root has no photos, no method is chosen, the trainer is
            missing, or the folder is not writable.
    """
    global current
    if current is not None and current.running:
        raise LodgsError(
            "Cannot compare methods: a comparison is already running.",
            "Wait for the comparison or cancel it.",
        )
    if not root.lodgs.scene_folder:
        raise LodgsError(f"Cannot compare methods: '{root.name}' has no photos.", "Import a COLMAP scene.")
    if not methods:
        raise LodgsError("Cannot compare methods: none is chosen.", "Choose at least one method.")
    python = environment.trainer_python()
    environment.require(python)
    settings = root.lodgs.training
    folder = run_folders.runs_parent(root) / "comparison" / bpy.path.clean_name(root.name)
    command = [str(python), "-m", "training", "compare", str(absolute_path(root.lodgs.scene_folder))]
    command += ["--out", str(folder), "--methods", *methods, "--preset", settings.preset]
    command += [f"--image-scale={settings.image_scale:.6g}", "--backend", extension.preferences().backend]
    page = folder / "index.html"

    def finish(work: ProgramSequence) -> None:
        work.message = f"The methods are compared: {page}"
        if not bpy.app.background:
            webbrowser.open(page.as_uri())

    try:
        folder.mkdir(parents=True, exist_ok=True)
        current = ProgramSequence(folder / "compare.log", [command], finish, "Comparing methods")
    except OSError as error:
        raise LodgsError(
            f"Cannot write to {folder}: {error.strerror or error}.", "Choose another Runs Folder."
        ) from error
    current.root = root
    return current


def unregister() -> None:
    """Cancel the comparison when Blender exits. It can be continued later."""
    if current is not None and current.running:
        current.cancel()

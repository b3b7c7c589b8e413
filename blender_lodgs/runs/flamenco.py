"""Cells on a render farm: a job for the manager of Flamenco, sent through its HTTP API.

What the job does says ``farm/flamenco/lodgs_blocks.js``, which lies with the manager. API: the manager's
``/api/v3/swagger-ui/``, operations getJobType and submitJob.
"""

from __future__ import annotations

import http.client
import json
import platform
import shlex
import urllib.error
import urllib.request
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

import bpy

from ...training.cli.job_options import options_of
from ...training.documents import parse_json
from ...training.errors import LodgsError, printable
from ...training.runs.folder import RunFolder
from .. import extension
from ..data import viewpoints
from . import job_settings, run_folders

JOB_TYPE = "lodgs-blocks"
"""What the manager makes of the name of our script."""
TIMEOUT = 10.0
"""Seconds that the manager is waited for."""
SCRIPT = extension.FOLDER / "farm" / "flamenco" / "lodgs_blocks.js"
_INSTALL = f"Put {SCRIPT} into the folder scripts beside the manager."
MOST_BYTES = 1 << 20
"""Most of an answer."""
_KEYS = ("scene", "out", "method", "preset", "image_scale", "cells", "polish")
"""Keys of a job that the job type has settings for; the others are its options."""
_WHERE = ("backend", "photo_memory", "splat_memory")
"""Keys that say how this computer trains: each of the farm's decides by itself."""


@dataclass(frozen=True)
class Submission:
    """A job for a manager, which any thread may send.

    Attributes:
        manager: its address.
        name: what people know the job by.
        settings: of the job type, by key.
    """

    manager: str
    name: str
    settings: dict[str, str | int | float]

    def send(self) -> str:
        """Submits it; returns the address of the page that shows how it gets on.

        Raises:
            LodgsError: nobody answers, what answers is no manager, or it does not take the job.
        """
        known = self._ask(f"jobs/type/{JOB_TYPE}", None)
        offered = known.get("settings")
        if not isinstance(offered, list) or not all(isinstance(each, dict) for each in offered):
            raise self._stranger()
        defaults = {str(each.get("key")): each.get("default") for each in offered}
        if missing := sorted(self.settings.keys() - defaults.keys()):
            raise LodgsError(
                f"The manager's job type {JOB_TYPE} is of another version: it has no {missing[0]}.",
                _INSTALL,
            )
        settings = {key: value for key, value in defaults.items() if value is not None} | self.settings
        job = {
            "name": self.name, "type": JOB_TYPE, "type_etag": known.get("etag", ""), "priority": 50,
            "submitter_platform": platform.system().lower(), "settings": settings,
        }  # fmt: skip
        made = self._ask("jobs", job).get("id")
        if not isinstance(made, str):
            raise self._stranger()
        return printable(f"{self.manager}/app/jobs/{made[:100]}")

    def _ask(self, what: str, said: dict | None) -> dict:
        """What the manager answers to a request, with a JSON object where something is said."""
        data = None if said is None else json.dumps(said).encode()
        headers = {"Content-Type": "application/json", "Accept": "application/json"}
        request = urllib.request.Request(f"{self.manager}/api/v3/{what}", data, headers)
        try:
            with urllib.request.urlopen(request, timeout=TIMEOUT) as answer:
                text = answer.read(MOST_BYTES)
        except urllib.error.HTTPError as error:
            with error:
                raise self._refusal(error, known=said is not None) from error
        except (OSError, http.client.HTTPException, ValueError) as error:
            why = getattr(error, "reason", None) or error
            raise LodgsError(
                f"No Flamenco manager answers at {self.manager}: {why}.",
                "Start it, or correct its address in the preferences of LODGS.",
            ) from error
        return self._read(text)

    def _refusal(self, error: urllib.error.HTTPError, known: bool) -> LodgsError:
        """Why it does not take the job, or does not have its type."""
        try:
            message = self._read(error.read(MOST_BYTES)).get("message")
        except (LodgsError, OSError, http.client.HTTPException):
            message = None
        if not isinstance(message, str):
            return self._stranger()
        if error.code == 404 and not known:
            return LodgsError(
                f"The Flamenco manager at {self.manager} does not know the job type {JOB_TYPE}.",
                _INSTALL,
            )
        return LodgsError(
            f"The Flamenco manager refused the job: {message.rstrip('.')}.", "Its log may tell more."
        )

    def _read(self, text: bytes) -> dict:
        try:
            return parse_json(text.decode("utf-8", "replace"), "The answer")
        except LodgsError:
            raise self._stranger() from None

    def _stranger(self) -> LodgsError:
        return LodgsError(
            f"What answers at {self.manager} is no Flamenco manager.",
            "Correct its address in the preferences of LODGS.",
        )


def submit(root: bpy.types.Object, folder: str = "") -> str:
    """Has a farm train a scene root with its settings (``root.lodgs.training``), in cells.

    Args:
        root: a scene root that was imported from a COLMAP folder.
        folder: the run's folder; empty: a new one where the settings say. All workers have to see it.

    Returns:
        The address of the page that shows how the job gets on.

    Raises:
        LodgsError: as :func:`prepare` and ``Submission.send``.
    """
    return prepare(root, folder).send()


def prepare(root: bpy.types.Object, folder: str = "") -> Submission:
    """What :func:`submit` sends; for the main thread.

    Raises:
        LodgsError: there is no manager, Blender may not go online, or a setting is impossible.
    """
    manager = manager_of(extension.preferences().flamenco)
    if not bpy.app.online_access:
        raise LodgsError(
            "Submitting speaks with the Flamenco manager, and Blender may not go online.",
            "Turn on Allow Online Access in the preferences, under System.",
        )
    if viewpoints.alone(root):
        raise LodgsError(f"'{root.name}' has no photographs to train on.", "Import a COLMAP folder.")
    if not (folder or root.lodgs.training.output or bpy.data.is_saved):
        raise LodgsError(
            "This file is not saved, so it is not known where the farm's run is to lie.",
            "Save it where all workers see it, or set Run Folders In.",
        )
    out = Path(bpy.path.abspath(folder)).resolve() if folder else run_folders.new_run_folder(root)
    if RunFolder(out).state() != "empty":
        raise LodgsError(f"{out} already holds a run.", "Choose another folder.")
    job = job_settings.make_job(root, out, {})
    job = job.with_cells(job.cells or "1x1")
    columns, rows = job.grid
    return Submission(manager, root.name, {
        "scene": job.scene, "output": job.out, "columns": columns, "rows": rows, "method": job.method,
        "preset": job.preset, "image_scale": job.image_scale, "polish": job.polish,
        "options": shlex.join(options_of(job, exclude=(*_KEYS, *_WHERE))),
    })  # fmt: skip


def manager_of(address: str) -> str:
    """The address of a manager as it is asked.

    Raises:
        LodgsError: it is empty, or no address.
    """
    address = address.strip()
    if not address:
        raise LodgsError(
            "It is not said where the Flamenco manager is.",
            "Give its address in the preferences of LODGS, such as http://farm:8080.",
        )
    given = address if "://" in address else f"http://{address}"
    try:
        parts = urlsplit(given)
        sound = parts.scheme in ("http", "https") and parts.hostname and parts.port != 0
    except ValueError:
        sound = False
    if not sound or any(character.isspace() for character in given):
        raise LodgsError(
            f"'{address}' is no address of a Flamenco manager.", "Give one such as http://farm:8080."
        )
    return given.rstrip("/")

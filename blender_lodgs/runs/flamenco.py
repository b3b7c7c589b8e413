"""Training of cells on a Flamenco render farm: job submission through the manager's HTTP API.

The job type is ``farm/flamenco/lodgs_blocks.js``, a script to install with the manager. API reference:
``/api/v3/swagger-ui/`` of the manager, operations getJobType and submitJob.
"""

from __future__ import annotations

import http.client
import json
import platform
import shlex
import urllib.error
import urllib.request
from dataclasses import dataclass
from urllib.parse import urlsplit

import bpy

from ...training.cli.job_options import options_of
from ...training.documents import parse_json
from ...training.errors import LodgsError, printable
from ...training.runs.folder import RunFolder
from ...training.runs.job import CHANGEABLE
from .. import extension
from ..data import viewpoints
from ..data.paths import absolute_path
from . import job_settings, run_folders

JOB_TYPE = "lodgs-blocks"
"""Name of the job type, which the manager derives from the script's file name."""
TIMEOUT = 10.0
"""Seconds to wait for the manager."""
SCRIPT = extension.FOLDER / "farm" / "flamenco" / "lodgs_blocks.js"
_INSTALL = f"Copy {SCRIPT} to the scripts folder of the manager."
MAX_BYTES = 1 << 20
"""Maximum size of a response."""
_KEYS = ("scene", "out", "method", "preset", "image_scale", "cells", "polish")
"""Job keys with a setting in the job type. The other keys are passed as command-line options, except
CHANGEABLE ones, for which each worker uses its own values."""


@dataclass(frozen=True)
class Submission:
    """A job for a Flamenco manager. Any thread may send it.

    Attributes:
        manager: URL of the manager.
        name: name of the job.
        settings: settings of the job type by key.
    """

    manager: str
    name: str
    settings: dict[str, str | int | float]

    def send(self) -> str:
        """Submit the job. Return the URL of its status page.

        Raises:
            LodgsError: there is no answer, the server is no Flamenco manager, or it rejects the job.
        """
        job_type = self._request(f"jobs/type/{JOB_TYPE}", None)
        type_settings = job_type.get("settings")
        if not isinstance(type_settings, list) or not all(isinstance(item, dict) for item in type_settings):
            raise self._not_a_manager()
        defaults = {str(item.get("key")): item.get("default") for item in type_settings}
        if missing := sorted(self.settings.keys() - defaults.keys()):
            raise LodgsError(
                f"Cannot submit the job: the manager's job type {JOB_TYPE} has no setting {missing[0]}.",
                _INSTALL,
            )
        settings = {key: value for key, value in defaults.items() if value is not None} | self.settings
        job = {
            "name": self.name, "type": JOB_TYPE, "type_etag": job_type.get("etag", ""), "priority": 50,
            "submitter_platform": platform.system().lower(), "settings": settings,
        }  # fmt: skip
        job_id = self._request("jobs", job).get("id")
        if not isinstance(job_id, str):
            raise self._not_a_manager()
        return printable(f"{self.manager}/app/jobs/{job_id[:100]}")

    def _request(self, path: str, body: dict | None) -> dict:
        """Send a GET request, or a POST request with a JSON body. Return the JSON response."""
        data = None if body is None else json.dumps(body).encode()
        headers = {"Content-Type": "application/json", "Accept": "application/json"}
        request = urllib.request.Request(f"{self.manager}/api/v3/{path}", data, headers)
        try:
            with urllib.request.urlopen(request, timeout=TIMEOUT) as response:
                text = response.read(MAX_BYTES)
        except urllib.error.HTTPError as error:
            with error:
                raise self._rejection(error, is_submission=body is not None) from error
        except (OSError, http.client.HTTPException, ValueError) as error:
            reason = getattr(error, "reason", None) or error
            raise LodgsError(
                f"Cannot reach a Flamenco manager at {self.manager}: {reason}.",
                "Start it, or correct its address in the preferences of LODGS.",
            ) from error
        return self._read(text)

    def _rejection(self, error: urllib.error.HTTPError, is_submission: bool) -> LodgsError:
        """Return the error for a rejected request."""
        try:
            message = self._read(error.read(MAX_BYTES)).get("message")
        except (LodgsError, OSError, http.client.HTTPException):
            message = None
        if not isinstance(message, str):
            return self._not_a_manager()
        if error.code == 404 and not is_submission:
            return LodgsError(
                f"Cannot submit the job: the Flamenco manager at {self.manager} has no job type {JOB_TYPE}.",
                _INSTALL,
            )
        return LodgsError(
            f"Cannot submit the job: the Flamenco manager reports: {message.rstrip('.')}.",
            "See the log of the manager.",
        )

    def _read(self, text: bytes) -> dict:
        try:
            return parse_json(text.decode("utf-8", "replace"), "The answer")
        except LodgsError:
            raise self._not_a_manager() from None

    def _not_a_manager(self) -> LodgsError:
        return LodgsError(
            f"Cannot submit the job: the server at {self.manager} is not a Flamenco manager.",
            "Correct its address in the preferences of LODGS.",
        )


def submit(root: bpy.types.Object, folder: str = "") -> str:
    """Train a scene root with its settings (``root.lodgs.training``) in cells on a render farm.

    Args:
        root: scene root with photos.
        folder: run folder, which all workers must see. Empty for a new folder.

    Returns:
        URL of the job's status page.

    Raises:
        LodgsError: see :func:`prepare` and ``Submission.send``.
    """
    return prepare(root, folder).send()


def prepare(root: bpy.types.Object, folder: str = "") -> Submission:
    """Prepare the job of :func:`submit`. Call this in the main thread.

    Raises:
        LodgsError: no manager is set, online access is off, or a setting is invalid.
    """
    manager = manager_url(extension.preferences().flamenco)
    if not bpy.app.online_access:
        raise LodgsError(
            "Cannot reach the Flamenco manager: Blender's online access is off.",
            "Turn on Allow Online Access in the preferences, under System.",
        )
    if viewpoints.has_only_splats(root):
        raise LodgsError(
            f"Cannot train '{root.name}' on a farm: it has no photos.", "Import a COLMAP folder."
        )
    if not (folder or root.lodgs.training.output or bpy.data.is_saved):
        raise LodgsError(
            "Cannot choose a run folder: the .blend file is not saved.",
            "Save it in a folder that all workers see, or set Runs Folder.",
        )
    out = absolute_path(folder).resolve() if folder else run_folders.new_run_folder(root)
    if RunFolder(out).state() != "empty":
        raise LodgsError(f"Cannot train in {out}: the folder contains a run.", "Choose another folder.")
    job = job_settings.make_job(root, out, {})
    job = job.with_cells(job.cells or "1x1")
    columns, rows = job.grid
    return Submission(manager, root.name, {
        "scene": job.scene, "output": job.out, "columns": columns, "rows": rows, "method": job.method,
        "preset": job.preset, "image_scale": job.image_scale, "polish": job.polish,
        "options": shlex.join(options_of(job, exclude=(*_KEYS, *CHANGEABLE))),
    })  # fmt: skip


def manager_url(address: str) -> str:
    """Return the base URL of a manager's address.

    Raises:
        LodgsError: the address is empty or invalid.
    """
    address = address.strip()
    if not address:
        raise LodgsError(
            "Cannot submit a job: no Flamenco manager is set.",
            "Enter its address in the preferences of LODGS, such as http://farm:8080.",
        )
    url = address if "://" in address else f"http://{address}"
    try:
        parts = urlsplit(url)
        valid = parts.scheme in ("http", "https") and parts.hostname and parts.port != 0
    except ValueError:
        valid = False
    if not valid or any(character.isspace() for character in url):
        raise LodgsError(
            f"Cannot use '{address}' as address of the Flamenco manager: it is invalid.",
            "Enter an address such as http://farm:8080.",
        )
    return url.rstrip("/")

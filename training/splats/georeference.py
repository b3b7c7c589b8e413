"""Places of scenes on Earth: a coordinate reference system and the transform into it."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..documents import decode_text, parse_json, read_bytes
from ..errors import LodgsError
from ..files import atomic_write
from .map_projection import UtmZone, geocentric

ECEF = "EPSG:4978"
"""WGS 84 with geocentric coordinates in metres."""
FILE = "georeference.json"
"""File of a scene's folder with the values of :meth:`Georeference.to_json`."""
_MAX_TEXT = 8192
"""Maximum length of a WKT text."""
_MAX_STORED = 1536
"""Maximum bytes of the system of a scene, as JSON: it must fit into the header of a bundle."""
_MAX_CONDITION = 1e6
"""Maximum ratio of the largest to the smallest scale of a transform."""
_SURFACE = 6.2e6, 6.6e6
"""Distances in metres from the Earth's centre between which a position counts as one on its surface."""


def is_on_earth(position: np.ndarray) -> bool:
    """Return whether a position (3,) in metres is as far from the Earth's centre as its surface."""
    return _SURFACE[0] < float(np.linalg.norm(position)) < _SURFACE[1]


@dataclass(frozen=True)
class Georeference:
    """Place of a scene on Earth.

    Attributes:
        crs: coordinate reference system: "EPSG:" and a code, or WKT.
        matrix: (4, 4) float64 transform from the scene's original coordinates to those of the system.
    """

    crs: str
    matrix: np.ndarray

    @staticmethod
    def from_json(values: Any) -> Georeference:
        """Return the georeference of JSON values; without a matrix, the coordinates are those of the system.

        Raises:
            ValueError: they are no georeference.
        """
        crs = values.get("crs") if isinstance(values, dict) else None
        if not isinstance(crs, str) or not 0 < len(crs.strip()) <= _MAX_TEXT:
            raise ValueError("it names no coordinate reference system")
        matrix = np.array(values.get("matrix", np.eye(4).tolist()), object)
        if matrix.shape != (4, 4) or any(type(value) not in (int, float) for value in matrix.flat):
            raise ValueError("its matrix does not have 4 x 4 numbers")
        matrix = matrix.astype(np.float64)
        is_affine = np.array_equal(matrix[3], (0, 0, 0, 1)) and np.isfinite(matrix).all()
        if not is_affine or not np.linalg.cond(matrix[:3, :3]) < _MAX_CONDITION:
            raise ValueError("its matrix is no transform of space")
        return Georeference(" ".join(crs.split()), matrix)

    def to_json(self) -> dict:
        """Return JSON values."""
        return {"crs": self.crs, "matrix": self.matrix.tolist()}

    @property
    def is_storable(self) -> bool:
        """True if the system fits into the header of a bundle."""
        return self._stored_size <= _MAX_STORED

    @property
    def _stored_size(self) -> int:
        """Bytes of the system as JSON."""
        return len(json.dumps(self.crs))

    @property
    def is_ecef(self) -> bool:
        """True if the coordinates of the system are those of :data:`ECEF`."""
        return self.crs.upper() == ECEF

    @property
    def zone(self) -> UtmZone | None:
        """Zone of the system's coordinates; None if they are not those of UTM."""
        return UtmZone.from_crs(self.crs)

    def after(self, matrix: np.ndarray) -> Georeference:
        """Return the georeference of coordinates that a matrix (4, 4) maps to the present ones."""
        return Georeference(self.crs, self.matrix @ matrix)


def read_georeference(folder: Path, warn: Callable[[str], object]) -> Georeference | None:
    """Return the georeference of a scene's folder, from georeference.json or a .prj file with WKT.

    Args:
        warn: receives a sentence about a damaged or too long file, which counts as none.
    """
    path = folder / FILE
    try:
        projections = [] if path.is_file() else sorted(folder.glob("*.prj"))
        if not path.is_file() and not projections:
            return None
        path = projections[0] if projections else path
        text = decode_text(read_bytes(path, 2 * _MAX_TEXT))
        values = {"crs": text} if projections else parse_json(text, FILE, 2 * _MAX_TEXT)
        place = Georeference.from_json(values)
        if not place.is_storable:
            raise ValueError(
                f"its system takes {place._stored_size:,} bytes, more than {_MAX_STORED:,}. "
                f"Write its EPSG code to {FILE}"
            )
        return place
    except (LodgsError, OSError, ValueError) as error:
        reason = error.what if isinstance(error, LodgsError) else f"{error}."
        warn(f"Ignored the place on Earth in {path}: {reason}")
        return None


def write_georeference(folder: Path, place: Georeference) -> None:
    """Write georeference.json into a scene's folder."""
    with atomic_write(folder / FILE) as temporary:
        temporary.write_text(json.dumps(place.to_json(), indent=1), "utf-8")


def local_tangent_plane(latitude: float, longitude: float, altitude: float) -> Georeference:
    """Return the georeference of coordinates in metres east, north and up of a place on WGS 84.

    Source: EPSG guidance note 7-2, conversions of geographic, geocentric and topocentric coordinates.

    Args:
        latitude: degrees north.
        longitude: degrees east.
        altitude: metres above the ellipsoid.
    """
    phi, lam = np.radians((latitude, longitude))
    up = np.array([np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)])
    east = np.array([-np.sin(lam), np.cos(lam), 0.0])
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([east, np.cross(up, east), up], axis=1)
    matrix[:3, 3] = geocentric(np.asarray(phi), np.asarray(lam), np.asarray(altitude, np.float64))
    return Georeference(ECEF, matrix)

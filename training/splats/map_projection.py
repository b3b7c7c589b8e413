"""Coordinates of UTM maps in geocentric coordinates. numpy only.

Source: EPSG guidance note 7-2, transverse Mercator (JHS formulas) and geographic to geocentric conversion. In
a zone of UTM, the series is accurate to less than a millimetre.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

EQUATOR, FLATTENING = 6_378_137.0, 1 / 298.257223563
"""Semi-major axis in metres and flattening of WGS 84."""
ECCENTRICITY2 = FLATTENING * (2 - FLATTENING)
_SCALE, _FALSE_EASTING, _FALSE_NORTHING_SOUTH = 0.9996, 500_000.0, 10_000_000.0
_CODES = {326: "north", 327: "south", 258: "north"}
"""EPSG codes of zones without their last two digits: WGS 84, WGS 84 south, ETRS89.

ETRS89 differs from WGS 84 by less than a metre, and maps usually treat both as equal.
"""
_DATUMS = "wgs 84", "wgs_1984", "wgs84", "etrs89", "etrs_1989"
_MIDDLE, _REACH = np.array([5e5, 5e6, 0.0]), np.array([1e6, 6e6, 1e5])
"""Middle of a zone's coordinates in metres, and distance up to which positions count as near the zone."""
_LATITUDE_ROUNDS = 6
"""Rounds of the iteration for the latitude; each gains more than two digits."""


@dataclass(frozen=True)
class UtmZone:
    """A zone of UTM. Coordinates are easting, northing and height above the ellipsoid in metres."""

    number: int
    south: bool = False

    @staticmethod
    def from_crs(crs: str) -> UtmZone | None:
        """Return the zone of a coordinate reference system, "EPSG:" and a code or WKT; None for others."""
        if match := re.fullmatch(r"EPSG:(\d{3})(\d\d)", crs.strip(), re.IGNORECASE):
            hemisphere = _CODES.get(int(match[1]))
            number, south = int(match[2]), hemisphere == "south"
        else:
            start = crs[:200].lower()
            match = re.search(r"utm[ _]zone[ _](\d{1,2})([ns])\b", start)
            if match is None or not any(datum in start for datum in _DATUMS):
                return None
            hemisphere, number, south = match[2], int(match[1]), match[2] == "s"
        return UtmZone(number, south) if hemisphere and 1 <= number <= 60 else None

    def contains(self, position: np.ndarray) -> bool:
        """Return whether a position (3,) is in the zone or close to it, and less than 100 km high or deep."""
        return bool((np.abs(np.asarray(position) - _MIDDLE) <= _REACH).all())

    def to_ecef(self, positions: np.ndarray) -> np.ndarray:
        """Return the geocentric coordinates (N, 3) float64 of positions (N, 3)."""
        easting, northing, height = np.asarray(positions, np.float64).T
        n = FLATTENING / (2 - FLATTENING)
        radius = _SCALE * EQUATOR / (1 + n) * (1 + n**2 / 4 + n**4 / 64)
        eta = (easting - _FALSE_EASTING) / radius
        xi = (northing - (_FALSE_NORTHING_SOUTH if self.south else 0.0)) / radius
        terms = (
            n / 2 - 2 / 3 * n**2 + 37 / 96 * n**3 - n**4 / 360,
            n**2 / 48 + n**3 / 15 - 437 / 1440 * n**4,
            17 / 480 * n**3 - 37 / 840 * n**4,
            4397 / 161_280 * n**4,
        )
        xi0 = xi - sum(h * np.sin(2 * j * xi) * np.cosh(2 * j * eta) for j, h in enumerate(terms, 1))
        eta0 = eta - sum(h * np.cos(2 * j * xi) * np.sinh(2 * j * eta) for j, h in enumerate(terms, 1))
        beta = np.arcsin(np.sin(xi0) / np.cosh(eta0))
        isometric = q = np.arcsinh(np.tan(beta))
        e = np.sqrt(ECCENTRICITY2)
        for _ in range(_LATITUDE_ROUNDS):
            q = isometric + e * np.arctanh(e * np.tanh(q))
        longitude = np.radians(6 * self.number - 183) + np.arcsin(np.tanh(eta0) / np.cos(beta))
        return geocentric(np.arctan(np.sinh(q)), longitude, height)


def geocentric(latitude: np.ndarray, longitude: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Return the geocentric coordinates (N, 3) of places on WGS 84, from radians and metres (N,)."""
    normal = EQUATOR / np.sqrt(1 - ECCENTRICITY2 * np.sin(latitude) ** 2)
    across = (normal + height) * np.cos(latitude)
    up = (normal * (1 - ECCENTRICITY2) + height) * np.sin(latitude)
    return np.stack([across * np.cos(longitude), across * np.sin(longitude), up], axis=-1)

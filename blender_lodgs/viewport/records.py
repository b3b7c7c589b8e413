"""Layout of the splats' records on the graphics card. This module does not use bpy.

A record has mean, opacity, quaternion wxyz, standard deviations and SH coefficients of three floats each. It
is padded to whole texels of four floats. ``shaders`` reads the same layout.
"""

from __future__ import annotations

import numpy as np

from ...training.splats.gaussians import Splats

MEANS, OPACITIES, QUATS, SCALES = slice(0, 3), 3, slice(4, 8), slice(8, 11)
"""Columns of records."""
_SH = 11
"""First column of the SH coefficients."""


def record_texels(higher: int) -> int:
    """Return the number of texels of a record.

    Args:
        higher: number of SH coefficients beyond the first.
    """
    return -(-(_SH + 3 + 3 * higher) // 4)


def empty_records(count: int, higher: int) -> np.ndarray:
    """Return ``count`` records of zeros, (count, 4 * texels) float32."""
    return np.zeros((count, 4 * record_texels(higher)), np.float32)


def coefficients_of(records: np.ndarray, higher: int) -> np.ndarray:
    """Return the SH coefficients of records, (M, 1 + higher, 3), as a view."""
    return records[:, _SH : _SH + 3 + 3 * higher].reshape(len(records), 1 + higher, 3)


def records_of(splats: Splats) -> np.ndarray:
    """Return the records of splats (M,)."""
    higher = splats.sh.shape[1] - 1
    records = empty_records(len(splats), higher)
    records[:, MEANS] = splats.means
    records[:, OPACITIES] = splats.opacities
    with np.errstate(over="ignore"):
        records[:, SCALES] = np.exp(splats.log_scales)
    lengths = np.linalg.norm(splats.quats, axis=1, keepdims=True)
    records[:, QUATS] = splats.quats / np.maximum(lengths, np.float32(1e-30))
    coefficients_of(records, higher)[:] = splats.sh
    return records


def resize_records(records: np.ndarray, higher: int) -> np.ndarray:
    """Return records (M, any) truncated or zero-padded to another number of coefficients."""
    resized = empty_records(len(records), higher)
    width = min(records.shape[1], resized.shape[1])
    resized[:, :width] = records[:, :width]
    return resized

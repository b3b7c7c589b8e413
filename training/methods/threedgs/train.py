"""3D Gaussian splatting (Kerbl et al. 2023), one level."""

from ...optimize.splat_method import SplatMethod as Method

__all__ = ["Method"]

"""Real spherical harmonics of degree 0 to 4, with the signs and order of 3DGS. No torch, no Numba.

The same functions serve torch (``out`` is a list of tensors) and Numba (``out`` is an array of numbers), so
all backends share one basis.
"""

from .gaussians import SH_C0

MAX_DEGREE = 4

C1 = 0.4886025119029199
C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
C3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)
C4 = (
    2.5033429417967046, 1.7701307697799304, 0.9461746957575601,
    0.6690465435572892, 0.10578554691520431, 0.47308734787878004, 0.6258357354491761,
)  # fmt: skip


def coefficient_count(degree: int) -> int:
    """Return the number of coefficients of a colour channel up to ``degree``."""
    return (degree + 1) * (degree + 1)


def degree_from_count(count: int) -> int:
    """Return the degree of ``count`` coefficients per channel.

    Raises:
        ValueError: no degree from 0 to 4 has this number of coefficients.
    """
    for degree in range(MAX_DEGREE + 1):
        if coefficient_count(degree) == count:
            return degree
    raise ValueError(f"no SH degree from 0 to {MAX_DEGREE} has {count} coefficients per channel")


def basis(x, y, z, degree, out):
    """Write the (degree+1)² basis values for the unit direction (x, y, z) to ``out``."""
    out[0] = SH_C0 + 0.0 * x
    if degree >= 1:
        out[1] = -C1 * y
        out[2] = C1 * z
        out[3] = -C1 * x
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        out[4] = C2[0] * (x * y)
        out[5] = -C2[0] * (y * z)
        out[6] = C2[1] * (2 * zz - xx - yy)
        out[7] = -C2[0] * (x * z)
        out[8] = C2[2] * (xx - yy)
        if degree >= 3:
            out[9] = -C3[0] * y * (3 * xx - yy)
            out[10] = C3[1] * x * y * z
            out[11] = -C3[2] * y * (4 * zz - xx - yy)
            out[12] = C3[3] * z * (2 * zz - 3 * xx - 3 * yy)
            out[13] = -C3[2] * x * (4 * zz - xx - yy)
            out[14] = C3[4] * z * (xx - yy)
            out[15] = -C3[0] * x * (xx - 3 * yy)
        if degree >= 4:
            out[16] = C4[0] * x * y * (xx - yy)
            out[17] = -C4[1] * y * z * (3 * xx - yy)
            out[18] = C4[2] * x * y * (7 * zz - 1)
            out[19] = -C4[3] * y * z * (7 * zz - 3)
            out[20] = C4[4] * (zz * (35 * zz - 30) + 3)
            out[21] = -C4[3] * x * z * (7 * zz - 3)
            out[22] = C4[5] * (xx - yy) * (7 * zz - 1)
            out[23] = -C4[1] * x * z * (xx - 3 * yy)
            out[24] = C4[6] * (xx * (xx - 3 * yy) - yy * (3 * xx - yy))


def basis_gradient(x, y, z, degree, by_x, by_y, by_z):
    """Write the derivatives of :func:`basis` with respect to independent x, y and z to three outputs."""
    by_x[0] = by_y[0] = by_z[0] = 0.0 * x
    if degree >= 1:
        by_x[1], by_y[1], by_z[1] = 0.0, -C1, 0.0
        by_x[2], by_y[2], by_z[2] = 0.0, 0.0, C1
        by_x[3], by_y[3], by_z[3] = -C1, 0.0, 0.0
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        xy, yz, xz = x * y, y * z, x * z
        by_x[4], by_y[4], by_z[4] = C2[0] * y, C2[0] * x, 0.0
        by_x[5], by_y[5], by_z[5] = 0.0, -C2[0] * z, -C2[0] * y
        by_x[6], by_y[6], by_z[6] = -2 * C2[1] * x, -2 * C2[1] * y, 4 * C2[1] * z
        by_x[7], by_y[7], by_z[7] = -C2[0] * z, 0.0, -C2[0] * x
        by_x[8], by_y[8], by_z[8] = 2 * C2[2] * x, -2 * C2[2] * y, 0.0
        if degree >= 3:
            by_x[9], by_y[9], by_z[9] = -6 * C3[0] * xy, -3 * C3[0] * (xx - yy), 0.0
            by_x[10], by_y[10], by_z[10] = C3[1] * yz, C3[1] * xz, C3[1] * xy
            by_x[11] = 2 * C3[2] * xy
            by_y[11] = -C3[2] * (4 * zz - xx - 3 * yy)
            by_z[11] = -8 * C3[2] * yz
            by_x[12] = -6 * C3[3] * xz
            by_y[12] = -6 * C3[3] * yz
            by_z[12] = 3 * C3[3] * (2 * zz - xx - yy)
            by_x[13] = -C3[2] * (4 * zz - 3 * xx - yy)
            by_y[13] = 2 * C3[2] * xy
            by_z[13] = -8 * C3[2] * xz
            by_x[14], by_y[14], by_z[14] = 2 * C3[4] * xz, -2 * C3[4] * yz, C3[4] * (xx - yy)
            by_x[15], by_y[15], by_z[15] = -3 * C3[0] * (xx - yy), 6 * C3[0] * xy, 0.0
        if degree >= 4:
            by_x[16], by_y[16], by_z[16] = C4[0] * y * (3 * xx - yy), C4[0] * x * (xx - 3 * yy), 0.0
            by_x[17] = -6 * C4[1] * x * yz
            by_y[17] = -3 * C4[1] * z * (xx - yy)
            by_z[17] = -C4[1] * y * (3 * xx - yy)
            by_x[18], by_y[18] = C4[2] * y * (7 * zz - 1), C4[2] * x * (7 * zz - 1)
            by_z[18] = 14 * C4[2] * x * yz
            by_x[19], by_y[19] = 0.0, -C4[3] * z * (7 * zz - 3)
            by_z[19] = -C4[3] * y * (21 * zz - 3)
            by_x[20], by_y[20], by_z[20] = 0.0, 0.0, C4[4] * z * (140 * zz - 60)
            by_x[21], by_y[21] = -C4[3] * z * (7 * zz - 3), 0.0
            by_z[21] = -C4[3] * x * (21 * zz - 3)
            by_x[22], by_y[22] = 2 * C4[5] * x * (7 * zz - 1), -2 * C4[5] * y * (7 * zz - 1)
            by_z[22] = 14 * C4[5] * z * (xx - yy)
            by_x[23] = -3 * C4[1] * z * (xx - yy)
            by_y[23] = 6 * C4[1] * x * yz
            by_z[23] = -C4[1] * x * (xx - 3 * yy)
            by_x[24] = 4 * C4[6] * x * (xx - 3 * yy)
            by_y[24] = -4 * C4[6] * y * (3 * xx - yy)
            by_z[24] = 0.0

"""COLMAP scenes: cameras, points, photos. numpy only, except for ``undistort`` and pixels in ``images``."""

"""COLMAP scenes: cameras, points, photographs. numpy only, but for `undistort` and the pixels of `images`."""

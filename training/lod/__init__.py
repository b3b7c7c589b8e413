"""Level of detail: weights in [0, 1] on the opacity of each splat, depending on the camera."""

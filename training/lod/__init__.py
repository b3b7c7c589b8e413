"""Level-of-detail rules: which splats a camera sees, as a weight in [0, 1] on each splat's opacity."""

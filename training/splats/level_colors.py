"""Colours of levels, for overlays in images and viewports."""

LEVEL_COLORS = (
    (0.55, 0.34, 0.76), (0.23, 0.49, 0.85), (0.16, 0.66, 0.60), (0.93, 0.72, 0.20), (0.88, 0.32, 0.25),
    (0.95, 0.60, 0.75), (0.60, 0.60, 0.60), (0.60, 0.85, 0.25), (0.45, 0.85, 0.95), (0.95, 0.50, 0.10),
    (0.85, 0.20, 0.65), (0.95, 0.95, 0.95),
)  # fmt: skip
"""sRGB, coarse to fine: violet, blue, teal, yellow, red, rose, grey, ...; repeating after the twelfth."""


def level_color(number: int) -> tuple[float, float, float]:
    """Return the colour of a level; 1 is the coarsest."""
    return LEVEL_COLORS[(number - 1) % len(LEVEL_COLORS)]

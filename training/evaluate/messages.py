"""A run's measures in words, for the table, the command line and Blender's panel. No torch."""

from __future__ import annotations

NOT_HELD_OUT = "No views were held out: quality is of training views."


def summary_lines(measures: dict) -> list[str]:
    """``evaluate.summary``'s numbers and ``aside``, as short lines; what is missing or odd has no line."""
    lines = []
    match measures.get("train_psnr"):
        case int() | float() as quality:
            lines.append(f"Training views: {quality:.1f} dB")
    match measures.get("worst"):
        case {"view": str(view), "psnr": int() | float() as quality}:
            lines.append(f"Worst held-out view: {quality:.1f} dB ({view})")
    match measures.get("fitted_psnr"):
        case int() | float() as quality:
            lines.append(f"Held-out views, exposure fitted: {quality:.1f} dB")
    match measures.get("aside"):
        case {"psnr": int() | float() as quality, "views": list(views)}:
            lines.append(f"Off the path: {quality:.1f} dB ({len(views)} views)")
    match measures.get("veil"):
        case {"mean": int() | float() as mean, "max": int() | float() as most}:
            lines.append(f"Between views: {mean:.1%} veiled, {most:.1%} at worst")
    match measures.get("frame_s"):
        case {"by_distance": int() | float() as chosen, "full": int() | float() as full} if full:
            lines.append(
                f"A frame by distance: {1e3 * chosen:.1f} ms, {chosen / full:.0%} of full detail's "
                f"{1e3 * full:.1f} ms"
            )
    match measures.get("oversized"):
        case int() as count if count:
            lines.append(f"Oversized opaque splats: {count:,}")
    if lines and "worst" not in measures:
        lines.append(NOT_HELD_OUT)
    return lines

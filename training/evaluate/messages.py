"""Measures of a run as sentences for reports, the command line and Blender's panel. No torch."""

from __future__ import annotations

NOT_HELD_OUT = "No held-out views: quality is measured on training views."


def summary_lines(measures: dict) -> list[str]:
    """Format the results of ``evaluate.summary`` and ``aside`` as short lines; missing values are skipped."""
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
            lines.append(f"Offset views: {quality:.1f} dB ({len(views)} views)")
    match measures.get("veil"):
        case {"mean": int() | float() as mean, "max": int() | float() as maximum}:
            lines.append(f"Between views: {mean:.1%} veiled, {maximum:.1%} at worst")
    match measures.get("frame_s"):
        case {"by_distance": int() | float() as by_distance, "full": int() | float() as full} if full:
            lines.append(
                f"Frame time by distance: {1e3 * by_distance:.1f} ms, {by_distance / full:.0%} of "
                f"{1e3 * full:.1f} ms at full detail"
            )
    match measures.get("loaded"):
        case int() as count if count:
            lines.append(f"Splats loaded by distance: {count:,}")
    match measures.get("frame_memory"):
        case {"by_distance": int() as by_distance, "full": int() as full}:
            lines.append(
                f"Memory to draw: {_megabytes(by_distance)} by distance, {_megabytes(full)} in full detail"
            )
        case {"full": int() as full}:
            lines.append(f"Memory to draw: {_megabytes(full)}")
    match measures.get("bytes"):
        case int() as size:
            lines.append(f"File of all levels: {_megabytes(size)}")
    match measures.get("memory"):
        case int() as size if size:
            lines.append(f"Memory of the training: {size / 1e9:.1f} GB")
    match measures.get("oversized"):
        case int() as count if count:
            lines.append(f"Oversized opaque splats: {count:,}")
    if lines and "worst" not in measures:
        lines.append(NOT_HELD_OUT)
    return lines


def _megabytes(size: int) -> str:
    return f"{size / 1e6:.1f} MB"


def format_duration(seconds: float) -> str:
    """Format seconds for reading: 40 s, 3 min, 2 h 05 min."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"

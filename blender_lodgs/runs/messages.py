"""Readable texts for the events of a run, shown in panels and on the command line."""

from __future__ import annotations

from ...training.evaluate.messages import format_duration


def progress_facts(progress: dict) -> dict[str, str]:
    """Return the figures of a ``progress`` event by label. An empty event gives no figures."""
    if not progress:
        return {}
    level = {"Level": f"{progress['level']} of {progress['levels']}"}
    speed = {
        "Speed": f"{progress['steps_per_s']:.1f} steps/s",
        "Time left": format_duration(progress["eta_s"]),
    }
    return {
        **({} if "blocks" in progress else level),  # cells are at different levels
        "Step": f"{progress['step']:,} of {progress['of']:,}",
        "Loss": f"{progress['loss']:.4f}",
        "PSNR, training": f"{progress['psnr']:.1f} dB",
        "Splats": f"{progress['splats']:,}",
        **(speed if progress["steps_per_s"] else {}),  # unknown at first
    }


def level_line(event: dict) -> str:
    """Describe a ``level`` event in one line."""
    views = measured_on(event)
    return short_level_line(event) + (f" on {views}" if views else "")


def short_level_line(event: dict) -> str:
    """Describe a ``level`` event for narrow places: without the views its quality was measured on."""
    views = measured_on(event)
    quality = f", {event[_MEASURED[views]]:.1f} dB" if views else ""
    return f"Level {event['level']}: {event['splats']:,} splats{quality}"


def measured_on(event: dict) -> str:
    """Return the views that the quality of a ``level`` event was measured on.

    One of "held-out views", "training views", or "" if it has no quality.
    """
    return next((views for views, name in _MEASURED.items() if isinstance(event.get(name), float)), "")


_MEASURED = {"held-out views": "psnr", "training views": "train_psnr"}

"""A run's events in words and numbers for people: for panels and command lines."""

from __future__ import annotations


def progress_facts(progress: dict) -> dict[str, str]:
    """The numbers of a ``progress`` event by name; none before the first."""
    if not progress:
        return {}
    level = {"Level": f"{progress['level']} of {progress['levels']}"}
    speed = {
        "Speed": f"{progress['steps_per_s']:.1f} steps/s",
        "Time left": duration(progress["eta_s"]),
    }
    return {
        **({} if "blocks" in progress else level),  # of which each is at its own
        "Step": f"{progress['step']:,} of {progress['of']:,}",
        "Loss": f"{progress['loss']:.4f}",
        "PSNR, training": f"{progress['psnr']:.1f} dB",
        "Splats": f"{progress['splats']:,}",
        **(speed if progress["steps_per_s"] else {}),  # else nobody knows yet
    }


def level_line(event: dict) -> str:
    """A ``level`` event in one line."""
    views = measured_on(event)
    return short_level_line(event) + (f" on {views}" if views else "")


def short_level_line(event: dict) -> str:
    """The same without what its quality was measured on (`measured_on`), for narrow places."""
    views = measured_on(event)
    quality = f", {event[_MEASURED[views]]:.1f} dB" if views else ""
    return f"Level {event['level']}: {event['splats']:,} splats{quality}"


def measured_on(event: dict) -> str:
    """What a ``level`` event's quality is of: "held-out views", "training views", or "" for none."""
    return next((views for views, name in _MEASURED.items() if isinstance(event.get(name), float)), "")


_MEASURED = {"held-out views": "psnr", "training views": "train_psnr"}


def duration(seconds: float) -> str:
    """Seconds as a person would say them: 40 s, 3 min, 2 h 05 min."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"

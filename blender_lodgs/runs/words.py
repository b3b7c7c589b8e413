"""A run's events in words and numbers for people: for panels and command lines."""

from __future__ import annotations


def progress_facts(progress: dict) -> dict[str, str]:
    """The numbers of a ``progress`` event by name; none before the first."""
    if not progress:
        return {}
    return {
        "Level": f"{progress['level']} of {progress['levels']}",
        "Step": f"{progress['step']:,} of {progress['of']:,}",
        "Loss": f"{progress['loss']:.4f}",
        "PSNR, training": f"{progress['psnr']:.1f} dB",
        "Splats": f"{progress['splats']:,}",
        "Speed": f"{progress['steps_per_s']:.1f} steps/s",
        "Time left": duration(progress["eta_s"]),
    }


def level_line(event: dict) -> str:
    """A ``level`` event in one line."""
    quality = ""
    for name, views in (("train_psnr", " on training views"), ("psnr", " on held-out views")):
        if isinstance(event.get(name), float):
            quality = f", {event[name]:.1f} dB{views}"
    return f"Level {event['level']}: {event['splats']:,} splats{quality}"


def duration(seconds: float) -> str:
    """Seconds as a person would say them: 40 s, 3 min, 2 h 05 min."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"

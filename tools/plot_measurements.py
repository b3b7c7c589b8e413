"""Plot the levels of the table in docs/development/measurements.md."""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib as mpl

mpl.use("agg")
from matplotlib import pyplot as plt

DOCS = Path(__file__).resolve().parents[1] / "docs"
PAGE = DOCS / "development" / "measurements.md"
PLOT = DOCS / "images" / "measurements-levels.png"


def read_levels(text: str) -> dict[str, list[float]]:
    """Return the PSNR of levels 1 to 5 by scene from the page's table."""
    rows = [
        [cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if "|" in line
    ]
    head, *body = rows
    columns = [index for index, name in enumerate(head) if name.startswith("level ")]
    return {
        row[0].split(",")[0]: [float(row[index]) for index in columns] for row in body if row[1].isdigit()
    }


def main() -> None:
    argparse.ArgumentParser(description=__doc__).parse_args()
    figure, axes = plt.subplots(figsize=(8, 4.5), layout="constrained")
    labels = []
    for scene, values in read_levels(PAGE.read_text(encoding="utf-8")).items():
        (line,) = axes.plot(range(1, len(values) + 1), values, marker="o")
        labels.append((values[-1], scene, line.get_color()))
    height = -float("inf")
    for value, scene, color in sorted(labels):  # labels keep a distance from each other
        height = max(value, height + 1.0)
        text = f"{scene} {value:.1f}"
        axes.annotate(text, (5, value), (5.12, height), color=color, va="center", annotation_clip=False)
    axes.set(xlabel="level, coarse to fine", ylabel="PSNR on held-out views (dB)", xticks=range(1, 6))
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(PLOT, dpi=110)
    print(PLOT)


if __name__ == "__main__":
    main()

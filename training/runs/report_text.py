"""Reports of finished runs (``measure``) as text."""

from __future__ import annotations

from ..evaluate.messages import summary_lines
from ..evaluate.views import REDUCTIONS

_TITLES = {"psnr": "PSNR", "ssim": "SSIM", "lpips_alex": "LPIPS-A", "lpips_vgg": "LPIPS-V"}
"""Heads of the columns by measure."""


def size_lines(rows: list[dict]) -> list[str]:
    """Format the PSNR of levels by image size as lines, each with its merge in brackets, if any."""
    sizes = ["full" if factor == 1 else f"1/{factor}" for factor in REDUCTIONS]
    lines = [f"{'PSNR by image size (merged)':<28} {'splats':>9}" + "".join(f"{size:>16}" for size in sizes)]
    for row in rows:
        merged = [f"({value:.2f})" for value in row.get("merged", [])] or [""] * len(sizes)
        values = (f"{value:>8.2f} {base:>7}" for value, base in zip(row["by_size"], merged, strict=True))
        lines.append(f"level {row['level']:<22} {row['splats']:>9,}" + "".join(values))
    return lines


def format_report(report: dict) -> str:
    """Format the report of :func:`.measure.evaluate_run` as text."""
    prefix = "" if report["test_views"] else "train_"
    titles = {f"{prefix}{name}": title for name, title in _TITLES.items()}
    quality_names = [name for name in titles if name in report["levels"][-1]]
    measures = ("splats", "drawn", *quality_names, "frame_s", "veil", "by_size", "merged")
    heads = "".join(f" {titles[name]:>7}" for name in quality_names)
    lines = [f"{'':>28} {'splats':>9}{heads} {'ms/frame':>8} {'veiled':>7}"]
    rows = []
    for row in report["levels"]:
        facts = "".join(f", {k} {v:.5g}" for k, v in row.items() if k not in ("level", *measures))
        rows.append((f"level {row['level']}{facts}", row))
    for row in report["selective"]:
        values = ", ".join(f"{k} {v:g}" for k, v in row.items() if k not in ("set", *measures))
        if rows[-1] == (f"  ({values})", None):
            rows.pop()  # of the row before, with the same values
        rows += [(f"by distance, {row['set']}", row), (f"  ({values})", None)]
    for row in report.get("curve", []):
        (name, value), *_ = row.items()
        rows.append((f"{name} = {value:g}, {row['drawn']:,} drawn", row))
    if "networks" in report:
        rows.append(("with networks", report["networks"]))
    for name, row in rows:
        if row is None:
            lines.append(name)
            continue
        quality = "".join(f" {row[key]:>7.{2 if key.endswith('psnr') else 4}f}" if key in row else f" {'':>7}"
                          for key in quality_names)  # fmt: skip
        veil = f" {row['veil']['mean']:>7.1%}" if "veil" in row else ""
        lines.append(f"{name:<28} {row['splats']:>9,}{quality} {1e3 * row['frame_s']:>8.1f}{veil}")
    lines += [*size_lines(report["levels"]), *summary_lines(report)]
    for row in report.get("farther", []):
        lines.append(
            f"{row['factor']}x the distance: {row['drawn']:,} of {row['drawn_full']:,} splats drawn, "
            f"{row['psnr']:.1f} dB against full detail"
        )
    for name, jump in report.get("jumps", {}).items():
        lines.append(f"largest jump, {name}: {jump} times that of full detail")
    return "\n".join(lines)

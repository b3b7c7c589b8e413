"""Write the page of ``make demo``: levels side by side, a curve and numbers, in one HTML file.

python examples/demo_page.py RUN REPORT.json PAGE.html
"""

from __future__ import annotations

import base64
import html
import io
import json
import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from PIL import Image  # noqa: E402

from training import load_bundle, load_scene, render_image  # noqa: E402
from training.runs.folder import RunFolder  # noqa: E402
from training.runs.job import Job  # noqa: E402

WIDTH = 960
"""Width of the images, in pixels."""
CURVE = 420, 240, 46
"""Width, height and margin of the curve, in pixels."""


def main() -> int:
    run, report = RunFolder(Path(sys.argv[1])), json.loads(Path(sys.argv[2]).read_text("utf-8"))
    job = Job.from_file(run.job)
    scene = load_scene(job.scene)
    _, held_out = scene.split(job.test_every or 8)
    camera = held_out[len(held_out) // 2]
    camera = camera.scaled(min(WIDTH / camera.width, 1))
    bundle = load_bundle(run.path)
    images = {
        f"Level {level.number}": render_image(bundle, camera, level=level.number) for level in bundle.levels
    }
    if report.get("selective"):
        images["By distance"] = render_image(bundle, camera, controls={})
    photo = Image.open(scene.images_folder / camera.name).convert("RGB").resize((camera.width, camera.height))
    encoded = {"Photo": encode(photo)}
    encoded |= {name: encode(Image.fromarray((image.clip(0, 1) * 255 + 0.5).astype(np.uint8)))
                for name, image in images.items()}  # fmt: skip
    Path(sys.argv[3]).write_text(build_page(report, encoded, camera.name), encoding="utf-8")
    return 0


def encode(image: Image.Image) -> str:
    """Return an image as the address of an embedded JPEG."""
    file = io.BytesIO()
    image.save(file, "JPEG", quality=88)
    return "data:image/jpeg;base64," + base64.b64encode(file.getvalue()).decode()


def build_page(report: dict, images: dict[str, str], view: str) -> str:
    """Return the page as HTML.

    Args:
        report: levels, selective and curve of report.json.
        images: addresses of images by label. The last one is shown first, beside the first.
        view: name of the held-out photo.
    """
    names = list(images)
    options = "".join(f"<option>{html.escape(name)}</option>" for name in names)
    rows = [(f"Level {row['level']}", row) for row in report["levels"]]
    if report.get("selective"):
        rows.append(("By distance", report["selective"]))
    table = "".join(
        f"<tr><td>{label}</td><td>{row['splats']:,}</td><td>{row['psnr']:.2f}</td><td>{row['ssim']:.3f}</td>"
        f"<td>{1000 * row['frame_s']:.1f}</td></tr>"
        for label, row in rows
    )
    curve = draw_curve(report.get("curve") or report["levels"])
    page = Path(__file__).with_suffix(".html").read_text(encoding="utf-8")
    values = {"VIEW": html.escape(view), "OPTIONS": options, "TABLE": table, "CURVE": curve}
    values |= {"IMAGES": json.dumps(images), "NAMES": json.dumps(names)}
    for name, value in values.items():
        page = page.replace(f"@{name}@", value)
    return page


def draw_curve(rows: list[dict]) -> str:
    """Return an SVG of PSNR against the number of splats in the image; "" without rows.

    Args:
        rows: numbers of splats in the image and PSNR, of control values or levels.
    """
    if len(rows) < 2:
        return ""
    width, height, margin = CURVE
    x = np.array([row.get("splats_drawn", row.get("drawn")) for row in rows], float)
    y = np.array([row["psnr"] for row in rows], float)
    order = np.argsort(x)
    span = max(y.max() - y.min(), 0.1)
    left = margin + x[order] / x.max() * (width - 2 * margin)
    top = height - margin - (y[order] - y.min()) / span * (height - 2 * margin)
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(left, top, strict=True))
    dots = "".join(f'<circle cx="{a:.1f}" cy="{b:.1f}" r="3.5"/>' for a, b in zip(left, top, strict=True))
    bottom = height - margin
    return f"""<svg width="{width}" height="{height}" role="img" aria-label="PSNR by drawn splats">
<g fill="none" stroke="#999"><path d="M{margin},{margin}V{bottom}H{width - margin}"/></g>
<polyline points="{points}" fill="none" stroke="#2a6fb0" stroke-width="2"/><g fill="#2a6fb0">{dots}</g>
<text x="{margin}" y="{margin - 12}">PSNR, {y.min():.1f} to {y.max():.1f} dB</text>
<text x="{width - margin}" y="{bottom + 28}" text-anchor="end">splats in the image, 0 to {x.max():,.0f}</text>
</svg>"""


if __name__ == "__main__":
    sys.exit(main())

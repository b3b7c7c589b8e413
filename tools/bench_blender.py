"""Measure import, selection and viewports in Blender against the number of splats. Part of ``make bench``.

- Import: a plain PLY of SH degree 3, from file to a level's object, relative to reading it with plyfile.
- Selection: evaluating two levels after a camera move, relative to masking and copying with numpy.
- F12: tiny frames of two levels selected by distance along a camera path, selected by the renderer, or copied
  from Blender's evaluation, as with users' own modifiers.
- Viewport (needs graphics in background): time of the main thread after a camera move besides Blender's own
  evaluation, time of the worker thread (selection and sorting), and uploads of the first and later frames.
- Clean Up, five levels: time of the main thread for a moved crop, a search for floaters, and strokes that
  select or paint.
- Look, five levels: time per step of a slider, drawn by LODGS and by Blender.
- Streaming (needs graphics in background): flight through a tree larger than the budget: time of the main
  thread per redraw, and the time until everything is loaded.

All ratios are of times from one run. ``--tree FILE --budget N`` streams another bundle, for example with ten
million splats. ``--scene`` only measures time and memory of importing a COLMAP scene with five million points
and 5,000 photos (two minutes and 2 GB of disk).
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import patch

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import numpy as np
import plyfile

from lab.large_scene import write_large
from tests.training.lod.tree.trees import random_leaves, tree_of, write_in_pages
from tools.blender_module import EXTENSION, start_blender

PHOTO = Path(__file__).resolve().parent.parent / "examples" / "lantern_garden" / "images" / "view_00.jpg"
SCENE = 5_000_000, 5000
"""Points and photos of --scene."""
COUNTS = (10_000, 100_000, 1_000_000)
S_MIN = 0.003
"""s_min of the coarse level, so that the border between two levels is in the middle of the splats."""


def fastest(function: Callable[[], object], rounds: int = 3) -> float:
    """Return the seconds of the fastest of several calls."""
    seconds = []
    for _ in range(rounds):
        start = time.perf_counter()
        function()
        seconds.append(time.perf_counter() - start)
    return min(seconds)


def load(name: str):
    return importlib.import_module(f"{EXTENSION}.{name}")


def random_splats(count: int):
    random = np.random.default_rng(0)
    return load("training.splats.gaussians").Splats(
        means=random.normal(0, 5, (count, 3)).astype(np.float32),
        quats=random.normal(size=(count, 4)).astype(np.float32),
        log_scales=random.normal(-4, 0.5, (count, 3)).astype(np.float32),
        opacity_logits=random.normal(0, 1, count).astype(np.float32),
        sh=random.normal(0, 0.2, (count, 16, 3)).astype(np.float32),
    )


def import_seconds(bpy, path: Path) -> float:
    """Return the time from file to object, including display colours."""

    def import_splats() -> None:
        obj = load("blender_lodgs.data.objects").new_splats(
            "bench", load("training.splats.ply").read_ply(path)
        )
        bpy.data.pointclouds.remove(obj.data)

    return fastest(import_splats)


def large_scene(bpy) -> None:
    """Print time and memory of importing a large COLMAP scene with photos."""
    import resource  # missing on Windows

    with tempfile.TemporaryDirectory() as folder:
        write_large(Path(folder), *SCENE, PHOTO.read_bytes())
        previous_peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        start = time.process_time()
        root = load("blender_lodgs.data.importing").import_colmap(bpy.context, Path(folder))
        seconds = time.process_time() - start
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        points, views = len(root.lodgs.points.data.points), len(root.lodgs.cameras.objects)
        print(
            f"{points:,} points and {views:,} photos: {seconds:.1f} s of CPU time, "
            f"peak memory {peak / 1e6:.2f} GB ({previous_peak / 1e6:.2f} GB before)"
        )


def selection_seconds(bpy, path: Path) -> tuple[float, float]:
    """Return the time of an evaluation after a camera move, and of masking the same splats with numpy."""
    splats = load("training.splats.ply").read_ply(path)
    camera = two_levels(bpy, splats)
    root = load("blender_lodgs.data.roots").roots(bpy.context.scene)[0]

    def move() -> None:
        camera.location.x += 0.01
        bpy.context.view_layer.update()

    rule = load("training.lod.rule").rules()["bands"]
    controls, levels = root.lodgs.bands, [(1, {"s_min": S_MIN}), (2, {"s_min": 0.0})]
    values = {control.name: getattr(controls, control.name) for control in rule.controls}
    facts = [load("training.lod.rule").collect_facts(rule, {}, levels, number) for number in (1, 2)]
    bands = [rule.distance_band(root.lodgs.focal_px, level_facts, values) for level_facts in facts]
    arrays = (splats.means, splats.quats, splats.log_scales, splats.opacity_logits, splats.sh)

    def by_numpy() -> None:
        distances = np.linalg.norm(splats.means, axis=1)
        for near, far in bands:
            selected = (distances >= near) & (distances < far)
            for array in arrays:
                array[selected]

    return fastest(move), fastest(by_numpy)


def two_levels(bpy, splats):
    """Create a scene with the same splats as two levels selected by distance; return its camera."""
    scenes, bundle = load("blender_lodgs.data.scenes"), load("training.splats.bundle")
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    bpy.context.scene.collection.objects.link(camera)
    bpy.context.scene.camera = camera
    with load("blender_lodgs.data.importing").new_scene(bpy.context, "bench") as root:
        scenes.set_bundle_facts(root, bundle.Bundle("flod", [], "bands"))
        scenes.set_level(root, bundle.Level(1, splats, {"s_min": S_MIN}))
        scenes.set_level(root, bundle.Level(2, splats, {"s_min": 0.0}))
    root.lodgs.mode = "SELECTIVE"
    bpy.context.view_layer.update()
    return camera


def f12_seconds(bpy, count: int) -> tuple[float, float]:
    """Return the median time of a small frame with splats selected by the renderer, and by Blender."""
    camera, seconds = two_levels(bpy, random_splats(count)), []
    engine = load("blender_lodgs.render.engine")

    def frame() -> None:
        engine.render_frame(bpy.context.evaluated_depsgraph_get(), 32, 18, (0, 0, 32, 18))

    for selected_by_renderer in (engine._is_selected_by_rule, lambda *args: False):
        frames = []
        with patch.object(engine, "_is_selected_by_rule", selected_by_renderer):
            for _ in range(6):
                camera.location.x += 0.05
                bpy.context.view_layer.update()
                frames.append(fastest(frame, 1))
        seconds.append(float(np.median(frames[1:])))
    load("blender_lodgs.render.renderer").close()
    return seconds[0], seconds[1]


def viewport(bpy, count: int) -> None:
    """Print viewport times with two levels of half as many splats each."""
    import gpu

    if not hasattr(gpu, "init"):
        print("viewport: not measured; this Blender has no graphics in background")
        return
    gpu.init()
    camera = two_levels(bpy, random_splats(count // 2))
    views, shown = load("blender_lodgs.viewport.views"), load("blender_lodgs.data.shown")
    resident = load("blender_lodgs.viewport.resident")
    main, thread, evaluated, first = [], [], [], []

    def sets():
        return shown.splat_instances(bpy.context.evaluated_depsgraph_get())

    def prepare(view, wait: bool = False) -> None:
        depsgraph, view_matrix = bpy.context.evaluated_depsgraph_get(), camera.matrix_world.inverted()
        views.prepare(view, sets(), depsgraph, view_matrix, 10 * count, wait)

    for _ in range(3):
        views.clear()
        view, uploaded = views.ViewState(), resident.bytes_uploaded
        first.append(fastest(lambda view=view: prepare(view, True), 1))
    first_upload, uploaded = resident.bytes_uploaded - uploaded, resident.bytes_uploaded
    for _ in range(10):
        camera.location.x += 0.1
        camera.rotation_euler.z += 0.1
        evaluated.append(fastest(bpy.context.view_layer.update, 1))
        seconds = fastest(lambda: prepare(view), 1)
        thread.append(fastest(lambda: view.pending[2].result(), 1))
        while view.pending or view.loading:
            seconds += fastest(lambda: prepare(view), 1)
        main.append(seconds)
    print(
        f"viewport, {count:,} splats, {view.arrangement.count:,} selected; ms, median of 10 camera moves:\n"
        f"  main thread {1e3 * np.median(main):.1f} (Blender's evaluation {1e3 * np.median(evaluated):.1f}),"
        f" worker thread {1e3 * np.median(thread):.1f}; splats of the first frame {1e3 * min(first):.0f},"
        f" {first_upload / 1e6:.1f} MB; each move {(resident.bytes_uploaded - uploaded) / 1e7:.2f} MB"
    )


def clean_up(bpy, count: int) -> None:
    """Print main thread times for editing five levels with this many splats in total."""
    scenes, cleaning = load("blender_lodgs.data.scenes"), load("blender_lodgs.data.cleaning")
    bundle = load("training.splats.bundle")
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    with load("blender_lodgs.data.importing").new_scene(bpy.context, "bench") as root:
        scenes.set_bundle_facts(root, bundle.Bundle("flod", [], "bands"))
        for number in range(1, 6):
            scenes.set_level(
                root, bundle.Level(number, random_splats(count // 5), {"s_min": 0.1 / 2**number})
            )
    root.lodgs.mode, root.lodgs.bands.first = "SELECTIVE", 1
    crop = load("blender_lodgs.operators.clean_up").add_crop(bpy.context, root, "BOX")
    bpy.context.view_layer.update()
    moves = []
    for _ in range(11):
        crop.location.x += 0.1
        start, cpu = time.perf_counter(), time.process_time()
        bpy.context.view_layer.update()
        moves.append((time.perf_counter() - start, time.process_time() - cpu))
    wall, cpu = 1e3 * np.median(moves, axis=0)
    steps = []
    for splats in (True, False):
        bpy.context.scene.lodgs_viewport.splats = splats
        root.lodgs_look.exposure = 0.0  # creates the look's modifiers
        bpy.context.view_layer.update()
        for _ in range(11):
            root.lodgs_look.exposure += 0.1
            steps.append(fastest(bpy.context.view_layer.update, 1))
    print(
        f"look, {count:,} splats in five levels, ms of the main thread: step of a slider"
        f" {1e3 * np.median(steps[:11]):.0f}, as points {1e3 * np.median(steps[11:]):.0f} (medians of 11)"
    )
    counts = fastest(
        lambda: (cleaning._counts.clear(), cleaning.count_remaining(root, bpy.context.view_layer.depsgraph))
    )
    floaters = fastest(lambda: cleaning.find_floaters(bpy.context, root, 0.0, 0.001))
    crop.lodgs_crop.use = False
    bpy.context.view_layer.update()
    everywhere = fastest(lambda: cleaning.find_floaters(bpy.context, root, 0.0, 0.001))
    floater_rows = cleaning.find_floaters(bpy.context, root, 0.0, 0.001)
    strokes, depsgraph = load("blender_lodgs.viewport.strokes"), bpy.context.evaluated_depsgraph_get()
    brushed = load("training.editing.brush").brush_coverage
    view_matrix, size = np.eye(4), (1280, 800)
    view_matrix[2, 3] = -15.0
    clip = np.array([[2, 0, 0, 0], [0, 3.2, 0, 0], [0, 0, -1, -0.1], [0, 0, -1, 0]], float)
    path = [(400, 400), (900, 400)]

    def begin():
        return strokes.StrokeTarget(root, depsgraph, view_matrix, clip, size)

    image = begin()
    begin_seconds, cover_seconds = fastest(begin), fastest(lambda: image.hits(brushed(path, 50, size)))
    selects = fastest(lambda: cleaning.extend_selection(root, image.hits(brushed(path, 50, size))))
    painting, step = load("blender_lodgs.data.painting"), path[:1] * 2
    previous_paint = painting.read_paint(root)

    def paint(along):
        hit = image.hits(brushed(along, 50, size, hardness=0.5), footprints=True)
        return painting.blend(previous_paint, hit, (0.8, 0.1, 0.1))

    follows = fastest(lambda: painting.preview_paint(root, paint(step)))
    painting.preview_paint(root, {})
    painting.write_paint(root, paint(path))  # adds the paint columns to all levels
    paints = fastest(lambda: painting.write_paint(root, paint(path)))
    hide = fastest(lambda: cleaning.hide(root, floater_rows), 1)
    print(
        f"clean up, {count:,} splats in five levels, ms of the main thread:\n"
        f"  moved crop {wall:.0f} (goal 100; median of 11, CPU time {cpu:.0f}; its counts"
        f" {1e3 * counts:.0f} more), floaters {1e3 * everywhere:.0f} (goal 500), within the crop"
        f" {1e3 * floaters:.0f}; hiding {sum(map(np.count_nonzero, floater_rows.values())):,}"
        f" {1e3 * hide:.0f};\n"
        f"  brush stroke: start {1e3 * begin_seconds:.0f} and hit test {1e3 * cover_seconds:.0f} (goal 300"
        f" together), select {1e3 * selects:.0f}; paint {1e3 * follows:.0f} per step of the"
        f" mouse, apply paint {1e3 * paints:.0f}"
    )


def streaming(bpy, path: Path, budget: int, frames: int = 100) -> None:
    """Print main thread times for a flight through a tree on disk."""
    import gpu
    from mathutils import Matrix

    if not hasattr(gpu, "init"):
        print("streaming: not measured; this Blender has no graphics in background")
        return
    gpu.init()
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    sources, views, view_camera = (
        load(f"blender_lodgs.viewport.{name}") for name in ("sources", "views", "view_camera")
    )
    visible = load("blender_lodgs.data.shown")
    import_start = time.perf_counter()
    root = load("blender_lodgs.data.importing").import_splats(bpy.context, path, upright=False, budget=budget)
    imported = time.perf_counter() - import_start
    means = load("blender_lodgs.data.objects").read_splats(root.lodgs.levels[-1].object).means
    low, high = np.quantile(means, (0.2, 0.8), axis=0)
    region, view = SimpleNamespace(as_pointer=lambda: 1, width=1000), views.ViewState()
    projection = Matrix(((2, 0, 0, 0), (0, 2, 0, 0), (0, 0, -1, -0.1), (0, 0, -1, 0)))

    def redraw(position: np.ndarray) -> tuple[float, float]:
        view_matrix = Matrix.Translation(-position)
        depsgraph = bpy.context.evaluated_depsgraph_get()
        wall_start, cpu_start = time.perf_counter(), time.thread_time()
        region_view = SimpleNamespace(
            view_matrix=view_matrix, window_matrix=projection @ view_matrix, view_distance=1.0
        )
        view_camera.track(region, bpy.context.scene, region_view, splats=True)
        views.prepare(
            view, visible.splat_instances(depsgraph), depsgraph, view_matrix, 2_000_000, moving=True
        )
        return time.perf_counter() - wall_start, time.thread_time() - cpu_start

    def wait() -> float:
        start = time.perf_counter()
        while not (stream := sources.stream(root)) or stream.busy or view.pending or views.wants_redraw(view):
            spent.append(redraw(positions[-1]))
            time.sleep(1 / 60)
        return time.perf_counter() - start

    spent: list[tuple[float, float]] = []
    positions = [low]
    first = redraw(low)  # splats of the scene, as after any import
    loading = wait()
    fractions = np.linspace(0, 1, frames)[:, None]
    positions = list(low + (high - low) * fractions)
    for position in positions:
        spent.append(redraw(position))
        time.sleep(1 / 60)
    settled = wait()

    def store_and_evaluate() -> None:
        view_camera.store_view(bpy.context.scene, tuple(low), 1000.0)
        bpy.context.view_layer.update()

    update = fastest(store_and_evaluate, 1)
    stream = sources.stream(root)
    assert stream is not None and not stream.problem, stream and stream.problem
    wall, cpu = 1e3 * np.array(spent).T
    print(
        f"streaming, {stream.source.total:,} splats with a budget of {budget:,}, {stream.splats:,} read;"
        f" ms of the main thread, {len(spent)} redraws:\n"
        f"  longest {wall.max():.1f} (CPU time {cpu.max():.1f}), 99 % {np.quantile(wall, 0.99):.1f},"
        f" median {np.median(wall):.1f}; import {1e3 * imported:.0f}, first redraw {1e3 * first[0]:.0f},"
        f" modifiers once the view rests {1e3 * update:.0f};\n"
        f"  loaded {loading:.1f} s after opening, {settled:.1f} s after the flight"
    )
    views.clear()
    sources.close_streams()


def main() -> None:
    parser = argparse.ArgumentParser(description="Measure LODGS in Blender against the number of splats.")
    parser.add_argument(
        "--scene", action="store_true", help="only measure the import of a large COLMAP scene"
    )
    parser.add_argument("--tree", type=Path, help="only measure streaming of this bundle")
    parser.add_argument("--budget", type=int, default=1_000_000, help="memory budget for --tree, in splats")
    options = parser.parse_args()
    bpy = start_blender()
    if options.scene:
        large_scene(bpy)
        sys.stdout.flush()
        os._exit(0)
    if options.tree:
        streaming(bpy, options.tree, options.budget)
        sys.stdout.flush()
        os._exit(0)
    print(f"Blender {bpy.app.version_string}; seconds, SH degree 3")
    print(f"{'splats':>9} {'import':>8} {'plyfile':>8} {'ratio':>6} {'select':>8} {'numpy':>8} {'ratio':>6}")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bench.ply"
        for count in COUNTS:
            load("training.splats.ply").write_ply(path, random_splats(count))
            seconds, plyfile_seconds = (
                import_seconds(bpy, path),
                fastest(lambda: np.array(plyfile.PlyData.read(path)["vertex"].data)),
            )
            select, mask = selection_seconds(bpy, path)
            print(
                f"{count:9,} {seconds:8.3f} {plyfile_seconds:8.3f} {seconds / plyfile_seconds:6.1f}"
                f" {select:8.4f} {mask:8.4f} {select / mask:6.2f}",
                flush=True,
            )
    if os.environ.get("LODGS_TRAINER_PYTHON"):
        selected, copied = f12_seconds(bpy, COUNTS[-1])
        print(
            f"F12, two levels of {COUNTS[-1]:,} splats, 32x18: {1e3 * selected:.0f} ms per frame selected by"
            f" the renderer, {1e3 * copied:.0f} ms copied from Blender, ratio {selected / copied:.2f}"
        )
    else:
        print("F12: not measured; set LODGS_TRAINER_PYTHON")
    clean_up(bpy, COUNTS[-1])
    viewport(bpy, 500_000)
    with tempfile.TemporaryDirectory() as folder:
        write_in_pages(
            Path(folder) / "tree.ply", tree_of(random_leaves(150_000, np.random.default_rng(0), 3))
        )
        streaming(bpy, Path(folder) / "tree.ply", 100_000)
    sys.stdout.flush()
    os._exit(0)  # Blender 4.5 as a module can hang when Python ends


if __name__ == "__main__":
    main()

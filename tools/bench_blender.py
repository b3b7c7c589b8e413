"""Measure import, selection and viewports in Blender against the number of splats: part of ``make bench``.

Import: a plain PLY of SH degree 3 from file to a level's object, against plyfile reading the same rows.
Selection: evaluating two levels after the eye moved, against numpy's masks and copies of the same splats.
Every ratio is of two times from one run.
F12: tiny frames of two levels by distance along a camera's way, where the renderer chooses by itself, against
splats copied out of Blender's evaluation, as where artists have modifiers of their own.
Viewport, where this Blender has graphics in background: what the main thread does after a camera move beside
Blender's own evaluation (the rules, the list of splats onto the graphics card), what the thread beside it
does (choosing and sorting), how long the first picture's splats take onto the card, from their attributes,
and what comes there later.
Clean Up, of five levels: how long a moved crop, a search for floaters, and strokes that select or paint hold
the main thread.
Look, of the same: how long each step of a slider does, where LODGS draws the splats and where Blender does.
Streaming, there as well: a tree is flown through of which a part fits into the budget. How long each redraw
holds up the main thread, all that LODGS does there but drawing itself, and how soon all has come at the end.
``--tree FILE --budget N`` takes a bundle of your own, of ten million splats say.
``--scene`` alone: how long a COLMAP scene of five million points and 5,000 photographs takes to come in, and
how much memory (two minutes and 2 GB of disk).
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

from tests.training.lod.trees import random_leaves, tree_of, write_in_pages
from tools.blender_module import EXTENSION, start_blender
from tools.large_scene import write_large

PHOTOGRAPH = Path(__file__).resolve().parent.parent / "examples" / "lantern_garden" / "images" / "view_00.jpg"
SCENE = 5_000_000, 5000
"""Points and photographs of --scene."""
COUNTS = (10_000, 100_000, 1_000_000)
S_MIN = 0.003
"""Puts the border between the two levels in the middle of the splats."""


def least(function: Callable[[], object], rounds: int = 3) -> float:
    """Seconds of the fastest of some calls."""
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
    """From file to an object in the scene, display colours included."""

    def once() -> None:
        obj = load("blender_lodgs.data.objects").new_splats(
            "bench", load("training.splats.ply").read_ply(path)
        )
        bpy.data.pointclouds.remove(obj.data)

    return least(once)


def large_scene(bpy) -> None:
    """Import of a large COLMAP scene, photographs and all."""
    import resource  # which Windows lacks

    with tempfile.TemporaryDirectory() as folder:
        write_large(Path(folder), *SCENE, PHOTOGRAPH.read_bytes())
        before, began = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
        root = load("blender_lodgs.data.scenes").import_colmap(bpy.context, Path(folder))
        seconds, most = time.process_time() - began, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        points, views = len(root.lodgs.points.data.points), len(root.lodgs.cameras.objects)
        print(f"{points:,} points and {views:,} photographs: {seconds:.1f} s of the processor, "
              f"at most {most / 1e6:.2f} GB (before {before / 1e6:.2f})")  # fmt: skip


def selection_seconds(bpy, path: Path) -> tuple[float, float]:
    """One evaluation after the eye moved, and numpy's way to the same splats' attributes."""
    splats = load("training.splats.ply").read_ply(path)
    camera = two_levels(bpy, splats)
    root = load("blender_lodgs.data.scenes").roots(bpy.context.scene)[0]

    def move() -> None:
        camera.location.x += 0.01
        bpy.context.view_layer.update()

    rule = load("training.lod.rule").rules()["bands"]
    controls, levels = root.lodgs.bands, [(1, {"s_min": S_MIN}), (2, {"s_min": 0.0})]
    values = {control.name: getattr(controls, control.name) for control in rule.controls}
    facts = [load("training.lod.rule").facts_of(rule, {}, levels, number) for number in (1, 2)]
    bands = [rule.band(root.lodgs.focal_px, each, values) for each in facts]
    arrays = (splats.means, splats.quats, splats.log_scales, splats.opacity_logits, splats.sh)

    def by_numpy() -> None:
        distances = np.linalg.norm(splats.means, axis=1)
        for near, far in bands:
            chosen = (distances >= near) & (distances < far)
            for array in arrays:
                array[chosen]

    return least(move), least(by_numpy)


def two_levels(bpy, splats):
    """A splat scene of the same splats as two levels, seen by distance, and its camera."""
    scenes, bundle = load("blender_lodgs.data.scenes"), load("training.splats.bundle")
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    camera = bpy.data.objects.new("eye", bpy.data.cameras.new("eye"))
    bpy.context.scene.collection.objects.link(camera)
    bpy.context.scene.camera = camera
    with scenes.new_scene(bpy.context, "bench") as root:
        scenes.set_bundle_facts(root, bundle.Bundle("flod", [], "bands"))
        scenes.set_level(root, bundle.Level(1, splats, {"s_min": S_MIN}))
        scenes.set_level(root, bundle.Level(2, splats, {"s_min": 0.0}))
    root.lodgs.mode = "SELECTIVE"
    bpy.context.view_layer.update()
    return camera


def f12_seconds(bpy, count: int) -> tuple[float, float]:
    """Of a small frame after the camera moved, median of five: chosen by the renderer, and by Blender."""
    camera, seconds = two_levels(bpy, random_splats(count)), []
    engine = load("blender_lodgs.render.engine")

    def frame() -> None:
        engine.frame(bpy.context.evaluated_depsgraph_get(), 32, 18, (0, 0, 32, 18))

    for chosen in (engine._chosen_by_rule, lambda *args: False):
        frames = []
        with patch.object(engine, "_chosen_by_rule", chosen):
            for _ in range(6):
                camera.location.x += 0.05
                bpy.context.view_layer.update()
                frames.append(least(frame, 1))
        seconds.append(float(np.median(frames[1:])))
    load("blender_lodgs.render.renderer").close()
    return seconds[0], seconds[1]


def viewport(bpy, count: int) -> None:
    """Prints what viewports cost with two levels of half as many splats each."""
    import gpu

    if not hasattr(gpu, "init"):
        print("viewport: not measured, this Blender has no graphics in background")
        return
    gpu.init()
    camera = two_levels(bpy, random_splats(count // 2))
    views, shown = load("blender_lodgs.viewport.views"), load("blender_lodgs.data.shown")
    resident = load("blender_lodgs.viewport.resident")
    main, thread, evaluated, first = [], [], [], []

    def sets():
        return shown.splat_instances(bpy.context.evaluated_depsgraph_get())

    def prepare(view, wait: bool = False) -> None:
        depsgraph, look = bpy.context.evaluated_depsgraph_get(), camera.matrix_world.inverted()
        views.prepare(view, sets(), depsgraph, look, 10 * count, wait)

    for _ in range(3):
        views.clear()
        view, before = views.ViewState(), resident.bytes_uploaded
        first.append(least(lambda view=view: prepare(view, True), 1))
    at_first, before = resident.bytes_uploaded - before, resident.bytes_uploaded
    for _ in range(10):
        camera.location.x += 0.1
        camera.rotation_euler.z += 0.1
        evaluated.append(least(bpy.context.view_layer.update, 1))
        asks = least(lambda: prepare(view), 1)
        thread.append(least(lambda: view.pending[2].result(), 1))
        while view.pending or view.loading:
            asks += least(lambda: prepare(view), 1)
        main.append(asks)
    print(
        f"viewport, {count:,} splats, {view.arrangement.count:,} chosen; ms, median of 10 camera moves:\n"
        f"  main thread {1e3 * np.median(main):.1f} (Blender's evaluation {1e3 * np.median(evaluated):.1f}),"
        f" thread beside it {1e3 * np.median(thread):.1f}; first picture's splats {1e3 * min(first):.0f},"
        f" {at_first / 1e6:.1f} MB; each move {(resident.bytes_uploaded - before) / 1e7:.2f} MB"
    )


def clean_up(bpy, count: int) -> None:
    """Prints what editing five levels of so many splats together costs the main thread."""
    scenes, cleaning = load("blender_lodgs.data.scenes"), load("blender_lodgs.data.cleaning")
    bundle = load("training.splats.bundle")
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    with scenes.new_scene(bpy.context, "bench") as root:
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
        begun, own = time.perf_counter(), time.process_time()
        bpy.context.view_layer.update()
        moves.append((time.perf_counter() - begun, time.process_time() - own))
    wall, own = 1e3 * np.median(moves, axis=0)
    steps = []
    for splats in (True, False):
        bpy.context.scene.lodgs_viewport.splats = splats
        root.lodgs_look.exposure = 0.0  # makes what shows it
        bpy.context.view_layer.update()
        for _ in range(11):
            root.lodgs_look.exposure += 0.1
            steps.append(least(bpy.context.view_layer.update, 1))
    print(
        f"look, {count:,} splats in five levels, ms of the main thread: a slider's step"
        f" {1e3 * np.median(steps[:11]):.0f}, as points {1e3 * np.median(steps[11:]):.0f} (medians of 11)"
    )
    counts = least(
        lambda: (cleaning._counts.clear(), cleaning.count_left(root, bpy.context.view_layer.depsgraph))
    )
    floaters = least(lambda: cleaning.find_floaters(bpy.context, root, 0.0, 0.001))
    crop.lodgs_crop.use = False
    bpy.context.view_layer.update()
    everywhere = least(lambda: cleaning.find_floaters(bpy.context, root, 0.0, 0.001))
    found = cleaning.find_floaters(bpy.context, root, 0.0, 0.001)
    strokes, depsgraph = load("blender_lodgs.viewport.strokes"), bpy.context.evaluated_depsgraph_get()
    brushed = load("training.lod.brush").brushed
    look, size = np.eye(4), (1280, 800)
    look[2, 3] = -15.0
    clip = np.array([[2, 0, 0, 0], [0, 3.2, 0, 0], [0, 0, -1, -0.1], [0, 0, -1, 0]], float)
    path = [(400, 400), (900, 400)]

    def begin():
        return strokes.Picture(root, depsgraph, look, clip, size)

    picture = begin()
    begins, covers = least(begin), least(lambda: picture.hits(brushed(path, 50, size)))
    selects = least(lambda: cleaning.select_also(root, picture.hits(brushed(path, 50, size))))
    painting, step = load("blender_lodgs.data.painting"), path[:1] * 2
    before = painting.read(root)

    def paint(along):
        hit = picture.hits(brushed(along, 50, size, hardness=0.5), footprints=True)
        return painting.over(before, hit, (0.8, 0.1, 0.1))

    follows = least(lambda: painting.show(root, paint(step)))
    painting.show(root, {})
    painting.write(root, paint(path))  # gives all levels their columns
    paints = least(lambda: painting.write(root, paint(path)))
    hide = least(lambda: cleaning.hide(root, found), 1)
    print(
        f"clean up, {count:,} splats in five levels, ms of the main thread:\n"
        f"  a moved crop {wall:.0f} (goal 100; median of 11, {own:.0f} of the processors; its counts"
        f" {1e3 * counts:.0f} more), floaters {1e3 * everywhere:.0f} (goal 500), within the crop"
        f" {1e3 * floaters:.0f}; hiding {sum(map(np.count_nonzero, found.values())):,} {1e3 * hide:.0f};\n"
        f"  a stroke of the brush: to begin {1e3 * begins:.0f} and to hit {1e3 * covers:.0f} (goal 300"
        f" together), to have it selected {1e3 * selects:.0f}; of paint {1e3 * follows:.0f} each step of the"
        f" mouse, to have it painted {1e3 * paints:.0f}"
    )


def streaming(bpy, path: Path, budget: int, frames: int = 100) -> None:
    """Prints what a flight through a tree in a file costs the main thread."""
    import gpu
    from mathutils import Matrix

    if not hasattr(gpu, "init"):
        print("streaming: not measured, this Blender has no graphics in background")
        return
    gpu.init()
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    views, eye, shown = (
        load(f"blender_lodgs.{name}") for name in ("viewport.views", "viewport.eye", "data.shown")
    )
    begun = time.perf_counter()
    root = load("blender_lodgs.data.scenes").import_splats(bpy.context, path, upright=False, budget=budget)
    imported = time.perf_counter() - begun
    means = load("blender_lodgs.data.objects").read_splats(root.lodgs.levels[-1].object).means
    low, high = np.quantile(means, (0.2, 0.8), axis=0)
    region, view = SimpleNamespace(as_pointer=lambda: 1, width=1000), views.ViewState()
    projection = Matrix(((2, 0, 0, 0), (0, 2, 0, 0), (0, 0, -1, -0.1), (0, 0, -1, 0)))

    def redraw(place: np.ndarray) -> tuple[float, float]:
        look = Matrix.Translation(-place)
        depsgraph = bpy.context.evaluated_depsgraph_get()
        wall, own = time.perf_counter(), time.thread_time()
        looks = SimpleNamespace(view_matrix=look, window_matrix=projection @ look, view_distance=1.0)
        eye.on_draw(region, bpy.context.scene, looks, splats=True)
        views.prepare(view, shown.splat_instances(depsgraph), depsgraph, look, 2_000_000, moving=True)
        return time.perf_counter() - wall, time.thread_time() - own

    def wait() -> float:
        begun = time.perf_counter()
        while not (stream := views.stream(root)) or stream.busy or view.pending or views.wants_redraw(view):
            spent.append(redraw(places[-1]))
            time.sleep(1 / 60)
        return time.perf_counter() - begun

    spent: list[tuple[float, float]] = []
    places = [low]
    first = redraw(low)  # of what the scene holds, as after any import
    came = wait()
    way = np.linspace(0, 1, frames)[:, None]
    places = list(low + (high - low) * way)
    for place in places:
        spent.append(redraw(place))
        time.sleep(1 / 60)
    settled = wait()
    update = least(
        lambda: (eye.follow(bpy.context.scene, tuple(low), 1000.0), bpy.context.view_layer.update()), 1
    )
    stream = views.stream(root)
    assert stream is not None and not stream.problem, stream and stream.problem
    wall, own = 1e3 * np.array(spent).T
    print(
        f"streaming, {stream.source.total:,} splats with a budget of {budget:,}, {stream.splats:,} read;"
        f" ms of the main thread, {len(spent)} redraws:\n"
        f"  longest {wall.max():.1f} ({own.max():.1f} of the processor), 99 % {np.quantile(wall, 0.99):.1f},"
        f" median {np.median(wall):.1f}; import {1e3 * imported:.0f}, first redraw {1e3 * first[0]:.0f},"
        f" modifiers when the view rests {1e3 * update:.0f};\n"
        f"  all there {came:.1f} s after opening, {settled:.1f} s after the flight"
    )
    views.clear()
    views.close_streams()


def main() -> None:
    parser = argparse.ArgumentParser(description="what LODGS costs in Blender, against the number of splats")
    parser.add_argument(
        "--scene", action="store_true", help="measure only the import of a large COLMAP scene"
    )
    parser.add_argument("--tree", type=Path, help="measure only streaming, of this bundle")
    parser.add_argument("--budget", type=int, default=1_000_000, help="splats in memory of --tree")
    chosen = parser.parse_args()
    bpy = start_blender()
    if chosen.scene:
        large_scene(bpy)
        sys.stdout.flush()
        os._exit(0)
    if chosen.tree:
        streaming(bpy, chosen.tree, chosen.budget)
        sys.stdout.flush()
        os._exit(0)
    print(f"Blender {bpy.app.version_string}; seconds, SH degree 3")
    print(f"{'splats':>9} {'import':>8} {'plyfile':>8} {'ratio':>6} {'select':>8} {'numpy':>8} {'ratio':>6}")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bench.ply"
        for count in COUNTS:
            load("training.splats.ply").write_ply(path, random_splats(count))
            whole, rows = (
                import_seconds(bpy, path),
                least(lambda: np.array(plyfile.PlyData.read(path)["vertex"].data)),
            )
            select, mask = selection_seconds(bpy, path)
            print(
                f"{count:9,} {whole:8.3f} {rows:8.3f} {whole / rows:6.1f}"
                f" {select:8.4f} {mask:8.4f} {select / mask:6.2f}",
                flush=True,
            )
    if os.environ.get("LODGS_TRAINER_PYTHON"):
        chosen, copied = f12_seconds(bpy, COUNTS[-1])
        print(
            f"F12, two levels of {COUNTS[-1]:,} splats, 32x18: {1e3 * chosen:.0f} ms a frame chosen by the"
            f" renderer, {1e3 * copied:.0f} ms copied from Blender, ratio {chosen / copied:.2f}"
        )
    else:
        print("F12: not measured, set LODGS_TRAINER_PYTHON")
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

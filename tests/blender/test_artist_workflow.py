"""An artist's workflow from photos to exported files: the same edits at every level, the same result by one
command, and undo step by step.

``LODGS_WAY=DIR`` runs it on another COLMAP folder with a full draft training, and prints the splat counts.
"""

import os
import subprocess
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest

from training.splats.bundle import read_bundle
from training.splats.ply import read_ply

ROOT = Path(__file__).resolve().parents[2]
OWN = os.environ.get("LODGS_WAY", "")
SCENE = Path(OWN or ROOT / "examples" / "lantern_garden")
QUICK = {"levels": 3, "steps": [30, 30, 40], "max_splats": 6000, "densify_until": [0.5] * 3,
         "densify_interval": [20] * 3, "budget_ratio": 0.35, "footprint": 8.0}  # fmt: skip
TINT = (0.75, 0.5, 1.0)
LENGTH = 3.0
HARMONIC = 0.28209479177387814
"""Y of degree 0: 1 / (2 sqrt pi)."""
SHARE = 0.01 if not OWN else 0.001
"""Largest cluster of floaters as a share of all splats; a short training leaves larger ones."""


def test_workflow_from_photos_to_exported_files(bpy, lodgs, tmp_path, monkeypatch, capfd):
    python = os.environ.get("LODGS_TRAINER_PYTHON")
    if not python:
        pytest.skip("no trainer; set LODGS_TRAINER_PYTHON")
    workflow = Workflow(bpy, lodgs, tmp_path)
    bpy.ops.ed.undo_push(message="Start")
    states = [workflow.state()]
    for step in (
        workflow.import_photos, workflow.train, workflow.crop, workflow.fit_crop, workflow.hide_floaters,
        workflow.ground, workflow.add_scale_marks, workflow.scale, workflow.tint,
    ):  # fmt: skip
        step()
        states.append(workflow.state())
        assert states[-1] != states[-2], step.__name__
    counts = workflow.assert_cropped()
    workflow.export()
    workflow.assert_equal_to_one_command(python, counts)
    assert workflow.state() == states[-1], "exports change nothing"

    undo_counts = [workflow.step_until(bpy.ops.ed.undo, state) for state in states[-2::-1]]
    levels = undo_counts.pop(-2)  # training: each level one to three times, the end, and Train
    # picking the ground adds empties in a step of its own
    expected = [1] * 3 + [1 if workflow.ground_found else 2] + [1] * 4
    assert undo_counts == expected and len(counts) + 2 <= levels <= 3 * len(counts) + 2
    for state in states[1:]:
        workflow.step_until(bpy.ops.ed.redo, state)
    assert workflow.assert_cropped() == counts
    workflow.assert_reimported(counts)
    if OWN:
        with capfd.disabled():
            print(
                f"\n{SCENE.name}:",
                *(f"level {n}: {visible:,} of {total:,} splats" for n, (visible, total) in counts.items()),
                sep="\n  ",
            )


class Workflow:
    """The workflow's steps, each of which Blender can undo."""

    def __init__(self, bpy, lodgs, folder: Path):
        self.bpy, self.lodgs, self.folder = bpy, lodgs, folder
        self.sphere = np.zeros(3), 1.0  # in the scene's coordinates
        self.factor = 1.0
        self.ground_found = True

    @property
    def root(self):
        (root,) = [obj for obj in self.bpy.data.objects if obj.lodgs.is_root]
        return root

    @property
    def crop_object(self):
        (crop,) = self.lodgs("data.crops").crops_of(self.root)
        return crop

    def push(self, message: str):
        """Push an undo step, as the window does after a change."""
        self.bpy.ops.ed.undo_push(message=message)

    def import_photos(self):
        assert self.bpy.ops.lodgs.import_colmap("EXEC_DEFAULT", True, directory=str(SCENE)) == {"FINISHED"}

    def train(self):
        settings = self.root.lodgs.training
        settings.method, settings.preset, settings.test_every = "flod", "draft", 8
        if OWN:
            assert self.bpy.ops.lodgs.train("EXEC_DEFAULT", True, folder=str(self.folder / "run")) == {
                "FINISHED"
            }
            return
        settings.image_scale = 0.25
        jobs = self.lodgs("runs.jobs")
        start = jobs.start
        jobs.start = lambda root, folder: start(root, folder, QUICK)
        try:
            assert self.bpy.ops.lodgs.train("EXEC_DEFAULT", True, folder=str(self.folder / "run")) == {
                "FINISHED"
            }
        finally:
            jobs.start = start

    def crop(self):
        assert self.bpy.ops.lodgs.add_crop("EXEC_DEFAULT", True, shape="SPHERE") == {"FINISHED"}

    def fit_crop(self):
        """Move the crop to the photographed subject and scale it."""
        camera, target = self.lodgs("data.photographs").photo_viewpoint(self.root)
        to_scene = np.linalg.inv(self.to_world())
        centre = to_scene[:3, :3] @ target + to_scene[:3, 3]
        radius = self.radius_between_splats(centre, 0.5 * (camera - target).length)
        self.crop_object.location, self.crop_object.scale = target, [radius] * 3
        self.bpy.context.view_layer.update()
        self.sphere = centre, radius
        self.push("Scale")

    def radius_between_splats(self, centre, radius: float) -> float:
        """Return a similar radius without splats close to the sphere, so that rounding has no effect."""
        means = np.concatenate([level.splats.means for level in self.trained().levels])
        distances = np.sort(np.linalg.norm(means - centre, axis=1))
        distances = distances[np.abs(distances - radius) < 0.02 * radius]
        widest = np.diff(distances).argmax()
        return float(distances[widest : widest + 2].mean())

    def hide_floaters(self):
        assert self.bpy.ops.lodgs.hide_splats("EXEC_DEFAULT", True, test="FLOATERS", share=100 * SHARE) == {
            "FINISHED"
        }

    def ground(self):
        """Detect the ground; if the photos show none, pick a level plane under the remaining splats."""
        try:
            assert self.bpy.ops.lodgs.set_ground("EXEC_DEFAULT", True, by="DETECT") == {"FINISHED"}
            return
        except RuntimeError as error:
            assert OWN and "plane" in str(error)
        self.ground_found = False
        finest = self.trained().levels[-1].splats.means
        inside = finest[np.linalg.norm(finest - self.sphere[0], axis=1) < self.sphere[1]]
        to_world = self.to_world()
        lowest = np.percentile(inside @ to_world[2, :3] + to_world[2, 3], 1)
        center = to_world[:3, :3] @ self.sphere[0] + to_world[:3, 3]
        for x, y in ((0, 0), (1, 0), (0, 1)):
            self.add_mark("ground", (center[0] + x, center[1] + y, lowest))
        self.select("ground")
        self.push("Add Empties")
        assert self.bpy.ops.lodgs.set_ground("EXEC_DEFAULT", True, by="SELECTION") == {"FINISHED"}
        assert abs(self.to_world() @ [*self.sphere[0], 1] - [*center[:2], center[2] - lowest, 1]).max() < 1e-4

    def add_scale_marks(self):
        """Add two empties at a distance of 2."""
        self.add_mark("begin", (0, 0, 0))
        self.add_mark("end", (0, 2, 0))
        self.push("Add Empties")

    def add_mark(self, name: str, position):
        mark = self.bpy.data.objects.new(name, None)
        mark.location = position
        self.bpy.context.scene.collection.objects.link(mark)
        self.bpy.context.view_layer.update()

    def select(self, *names: str):
        """Select the objects of these names and the root, and make the root active."""
        for obj in self.bpy.context.view_layer.objects:
            obj.select_set(obj.name.split(".")[0] in names or obj == self.root)
        self.bpy.context.view_layer.objects.active = self.root

    def scale(self):
        self.select("begin", "end")
        assert self.bpy.ops.lodgs.set_scale("EXEC_DEFAULT", True, length=LENGTH) == {"FINISHED"}
        self.factor = LENGTH / 2

    def tint(self):
        self.root.lodgs_look.tint = TINT
        self.push("Tint")

    def to_world(self) -> np.ndarray:
        self.bpy.context.view_layer.update()
        return np.array(self.root.lodgs.axes.matrix_world, np.float64)

    def state(self) -> dict:
        """Return everything that the steps change, bit for bit."""
        self.bpy.context.view_layer.update()
        return {
            obj.name: (
                obj.parent and obj.parent.name,
                np.array([obj.matrix_basis, obj.matrix_parent_inverse]).tobytes(),
                obj.select_get() if obj.name in self.bpy.context.view_layer.objects else None,
                [modifier.name for modifier in obj.modifiers],
                tuple(obj.lodgs_look.tint),
                obj.lodgs_crop.keep,
                obj.lodgs.training.run,
                [(item.number, item.exists) for item in obj.lodgs.levels],
                self.points_of(obj.data) if obj.type == "POINTCLOUD" else None,
            )
            for obj in self.bpy.data.objects
        }

    def points_of(self, cloud) -> dict[str, str]:
        """Return a digest of each attribute of a point cloud."""
        read = self.lodgs("attributes").read_attribute
        attributes = {attribute.name: read(cloud, attribute.name) for attribute in cloud.attributes}
        return {name: sha256(values.tobytes()).hexdigest() for name, values in attributes.items()}

    def step_until(self, step, state: dict) -> int:
        """Undo or redo until the state is restored, and return the number of steps."""
        for count in range(1, 20):
            assert step() == {"FINISHED"}
            if self.state() == state:
                return count
        raise AssertionError("The state was not restored.")

    def assert_cropped(self) -> dict[int, tuple[int, int]]:
        """Check that each level shows the splats in the sphere that are not hidden; return the counts."""
        cleaning = self.lodgs("data.cleaning")
        centre, radius = self.sphere
        graph = self.bpy.context.evaluated_depsgraph_get()
        counts = cleaning.count_remaining(self.root, graph)
        for level, item in zip(self.trained().levels, self.root.lodgs.levels, strict=True):
            inside = np.linalg.norm(level.splats.means - centre, axis=1) < radius
            hidden = cleaning.hidden_mask(item.object.data)
            assert not hidden[~inside].any(), "floaters are detected among the cropped splats"
            assert counts[item.number] == (np.count_nonzero(inside & ~hidden), len(inside))
            assert counts[item.number][0] < len(inside)
            assert counts[item.number][0] or OWN, "a small crop may exclude a draft's coarse levels"
            self.root.lodgs.mode, self.root.lodgs.single_level = "SINGLE", item.number
            self.bpy.context.view_layer.update()
            graph = self.bpy.context.evaluated_depsgraph_get()
            assert len(item.object.evaluated_get(graph).data.points) == counts[item.number][0]
        return counts

    def trained(self):
        return read_bundle(self.folder / "run" / "bundle.ply")

    def export(self):
        settings = {"placed": True, "looked": True}
        finest = self.root.lodgs.levels[-1].number
        operators = self.bpy.ops.lodgs
        assert operators.export_bundle(filepath=str(self.folder / "out.ply"), **settings) == {"FINISHED"}
        plain = {"source": "LEVEL", "level": finest, **settings}
        assert operators.export_plain(filepath=str(self.folder / "plain.ply"), **plain) == {"FINISHED"}
        assert operators.export_streamed(directory=str(self.folder / "web"), **settings) == {"FINISHED"}

    def assert_equal_to_one_command(self, python: str, counts: dict):
        centre, radius = self.sphere
        folder = self.folder
        placed = ["--ground", "--scale", self.factor]
        if not self.ground_found:
            placed = ["--matrix=" + ",".join(map(str, self.to_world().ravel()))]
        command = [
            python, "-m", "training", "edit", folder / "run" / "bundle.ply",
            "--out", folder / "edited.ply", "--plain", folder / "edited_plain.ply",
            "--streamed", folder / "edited_web",
            "--crop-sphere", *centre, radius, "--drop-floaters", "--share", SHARE,
            "--scene", SCENE, *placed, "--tint", *TINT,
        ]  # fmt: skip
        process = subprocess.run([str(part) for part in command], cwd=ROOT, capture_output=True, text=True)
        assert process.returncode == 0, process.stderr
        for number, (visible, total) in counts.items():
            assert f"level {number}: {visible:,} of {total:,} splats" in process.stdout
        from_blender, from_command = (
            read_bundle(self.folder / "out.ply"),
            read_bundle(self.folder / "edited.ply"),
        )
        pairs = [(a.splats, b.splats) for a, b in zip(from_blender.levels, from_command.levels, strict=True)]
        pairs.append((read_ply(self.folder / "plain.ply"), read_ply(self.folder / "edited_plain.ply")))
        for blender_splats, edited_splats in pairs:
            for name in ("means", "log_scales", "opacity_logits", "sh"):
                np.testing.assert_allclose(
                    getattr(blender_splats, name), getattr(edited_splats, name), rtol=1e-3, atol=1e-3
                )
            dots = np.abs((_unit(blender_splats.quats) * _unit(edited_splats.quats)).sum(axis=1))
            assert dots.min() > 1 - 1e-5

    def assert_reimported(self, counts: dict):
        """Check that exported files import at the scene's location and with its colours."""
        to_world = self.to_world()
        trained = self.trained()
        remaining = {}
        for level, item in zip(trained.levels, self.root.lodgs.levels, strict=True):
            inside = np.linalg.norm(level.splats.means - self.sphere[0], axis=1) < self.sphere[1]
            hidden = self.lodgs("data.cleaning").hidden_mask(item.object.data)
            remaining[level.number] = level.splats.select(inside & ~hidden)
        files = {
            "out.ply": list(remaining),
            "plain.ply": [max(remaining)],
            "web/lod-meta.json": list(remaining),
        }
        for name, numbers in files.items():
            previous = set(self.bpy.data.objects)
            upright = name == "out.ply"  # only bundles store the scene's orientation
            result = self.bpy.ops.lodgs.import_splats(filepath=str(self.folder / name), upright=upright)
            assert result == {"FINISHED"}
            (root,) = [obj for obj in self.bpy.data.objects if obj.lodgs.is_root and obj not in previous]
            self.bpy.context.view_layer.update()
            for item, number in zip(root.lodgs.levels, numbers, strict=True):
                truth, cloud = remaining[number], item.object.data
                assert len(cloud.points) == counts[number][0]
                matrix, read = np.array(item.object.matrix_world), self.lodgs("attributes").read_attribute
                positions = read(cloud, "position") @ matrix[:3, :3].T + matrix[:3, 3]
                expected = truth.means @ to_world[:3, :3].T + to_world[:3, 3]
                if name.startswith("web"):  # the format reorders and quantizes splats
                    error = np.sort(positions, axis=0) - np.sort(expected, axis=0)
                    assert abs(error).max() < 0.01 * self.sphere[1] * self.factor
                    continue
                np.testing.assert_allclose(positions, expected, atol=1e-3)
                colours = np.array(TINT) * (0.5 + HARMONIC * truth.sh[:, 0])
                base = read(cloud, "radiance:base")
                np.testing.assert_allclose(0.5 + HARMONIC * base[:, :3], colours, atol=1e-4)


def _unit(quats: np.ndarray) -> np.ndarray:
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)

"""File paths of scenes stay valid when the .blend is saved in another folder."""

import os
import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest


@pytest.fixture
def saved(bpy, lodgs, tmp_path):
    root = lodgs("data.importing").import_colmap(bpy.context, "examples/lantern_walk", photographs=False)
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a" / "file.blend"))
    root.lodgs.training.run, root.lodgs.training.output = "//runs/one", "/elsewhere"
    bpy.context.scene.lodgs_render.holdout = "//depth/####.exr"
    return root


def resolved_paths(bpy, root):
    run, holdout = root.lodgs.training.run, bpy.context.scene.lodgs_render.holdout
    return [os.path.normpath(bpy.path.abspath(path)) for path in (run, holdout)]


def test_paths_stay_valid_after_saving_in_another_folder(bpy, saved, tmp_path):
    before, name = resolved_paths(bpy, saved), saved.name
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "b" / "file.blend"))
    assert resolved_paths(bpy, saved) == before and saved.lodgs.training.run.startswith("//")
    assert saved.lodgs.training.output == "/elsewhere"
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "b" / "file.blend"))
    assert resolved_paths(bpy, bpy.data.objects[name]) == before


def test_saved_copy_leaves_the_open_file_unchanged(bpy, saved, tmp_path):
    before, name, run = resolved_paths(bpy, saved), saved.name, saved.lodgs.training.run
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "b" / "copy.blend"), copy=True)
    assert saved.lodgs.training.run == run and resolved_paths(bpy, saved) == before
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "b" / "copy.blend"))
    assert resolved_paths(bpy, bpy.data.objects[name]) == before


@pytest.mark.parametrize("blend_folder", ["beside the scene", "in another folder"])
def test_project_can_be_moved(bpy, lodgs, tmp_path, blend_folder):
    """A .blend beside its scene needs no preparation; elsewhere, Make Paths Relative is enough."""
    project, moved = tmp_path / "project", tmp_path / "moved"
    shutil.copytree("examples/lantern_garden", project / "scene")
    blend = Path("scene.blend" if blend_folder == "beside the scene" else "blend/scene.blend")
    (project / blend).parent.mkdir(exist_ok=True)
    root = lodgs("data.importing").import_colmap(bpy.context, str(project / "scene"))
    root.lodgs.training.output = "/elsewhere"
    bpy.ops.wm.save_as_mainfile(filepath=str(project / blend))
    if blend.parent.name:
        assert os.path.isabs(root.lodgs.scene_folder)
        bpy.ops.file.make_paths_relative()
        bpy.ops.wm.save_mainfile()
    name = root.name
    project.rename(moved)
    bpy.ops.wm.open_mainfile(filepath=str(moved / blend))
    root = bpy.data.objects[name]
    job = lodgs("runs.job_settings").make_job(root, tmp_path / "runs", {})
    assert Path(job.scene).resolve() == (moved / "scene").resolve()
    view = lodgs("data.photographs").views(root)[0]
    assert Path(bpy.path.abspath(view.data.lodgs.photograph)).is_file()
    assert root.lodgs.training.output == "/elsewhere"


@pytest.mark.parametrize("opened_by", ["real", "link"])
@pytest.mark.parametrize("saved_by", ["real", "link"])
def test_project_behind_a_symbolic_link_can_be_moved(bpy, lodgs, tmp_path, saved_by, opened_by):
    """Paths by the link's name and by the real one lead to the same files, before and after a move."""
    disk, home = tmp_path / "disk" / "a" / "project", tmp_path / "home"
    for folder in (disk / "runs" / "one", disk / "photos", home):
        folder.mkdir(parents=True)
    shutil.copytree("examples/lantern_garden", disk / "scene")
    (home / "link").symlink_to(disk)
    projects = {"real": disk, "link": home / "link"}
    root = lodgs("data.importing").import_colmap(
        bpy.context, projects[opened_by] / "scene", photographs=False
    )
    bpy.ops.wm.save_as_mainfile(filepath=str(projects[saved_by] / "file.blend"))
    lodgs("runs.run_folders").link_run(root, lodgs("training.runs.folder").RunFolder(disk / "runs" / "one"))
    capture = bpy.context.scene.lodgs_capture
    capture.folder = lodgs("data.paths").stored_path(projects[opened_by] / "photos")
    bpy.ops.wm.save_mainfile()
    moved = tmp_path / "other" / "b" / "c"
    moved.parent.mkdir(parents=True)
    name = root.name
    for blend in (projects[saved_by] / "file.blend", moved / "file.blend"):
        if blend.parent == moved:
            (home / "link").unlink()
            disk.rename(moved)
        bpy.ops.wm.open_mainfile(filepath=str(blend))
        settings, capture = bpy.data.objects[name].lodgs, bpy.context.scene.lodgs_capture
        for value in (settings.scene_folder, settings.training.run, capture.folder):
            assert value.startswith("//") and os.path.isdir(bpy.path.abspath(value)), value


def test_symbolic_links_of_a_project_stay(bpy, lodgs, tmp_path):
    """A folder of the project that links to another disk keeps its name."""
    (tmp_path / "disk" / "runs").mkdir(parents=True)
    (tmp_path / "project").mkdir()
    (tmp_path / "project" / "runs").symlink_to(tmp_path / "disk" / "runs")
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "project" / "file.blend"))
    assert lodgs("data.paths").stored_path(tmp_path / "project" / "runs") == "//runs"


def test_folder_beside_a_symbolic_link_is_found(bpy, lodgs, tmp_path):
    """Parent folders of a link's target differ from those of its name."""
    (tmp_path / "disk" / "deep" / "project").mkdir(parents=True)
    (tmp_path / "home" / "runs").mkdir(parents=True)
    (tmp_path / "home" / "link").symlink_to(tmp_path / "disk" / "deep" / "project")
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "home" / "link" / "file.blend"))
    value = lodgs("data.paths").stored_path(tmp_path / "home" / "runs")
    assert value.startswith("//") and os.path.samefile(bpy.path.abspath(value), tmp_path / "home" / "runs")


DEVICES = (r"\\.\PhysicalDrive0", "//\\\\.\\pipe" if os.name == "nt" else r"\\?\GLOBALROOT\x")


@pytest.mark.parametrize(
    "value", ["", r"\\server\share\a", "/\\server/share/a", r"\\?\UNC\server\share", *DEVICES]
)
def test_other_computers_and_devices_are_not_opened_automatically(bpy, lodgs, value):
    assert lodgs("data.paths").automatic_path(value) is None


def test_local_files_and_the_share_of_the_blend_are_opened(bpy, lodgs, saved, tmp_path, monkeypatch):
    paths = lodgs("data.paths")
    assert paths.automatic_path("//runs/one") == tmp_path / "a" / "runs" / "one"
    monkeypatch.setattr(
        paths, "bpy", SimpleNamespace(path=bpy.path, data=SimpleNamespace(filepath=r"\\NAS\city\a.blend"))
    )
    assert paths.automatic_path(r"\\nas\City\runs\one") is not None
    assert paths.automatic_path(r"\\nas\other\run") is None


@pytest.mark.parametrize("override", [False, True])
def test_relative_paths_of_linked_scenes_lead_to_their_library(
    bpy, lodgs, saved, tmp_path, monkeypatch, override
):
    view = lodgs("data.photographs").views(saved)[0]
    saved.lodgs.stream.file, view.data.lodgs.photograph = "//town.ply", "//images/view.jpg"
    saved.lodgs.source.file, saved.lodgs.source.watch = "//town.ply", True
    name, view_name = saved.users_collection[0].name, view.name
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "b" / "file.blend"))
    with bpy.data.libraries.load(str(tmp_path / "a" / "file.blend"), link=True) as (_, linked):
        linked.collections = [name]
    scene, [collection] = bpy.context.scene, linked.collections
    scene.collection.children.link(collection)
    if override:
        collection.override_hierarchy_create(scene, bpy.context.view_layer)
        scene.collection.children.unlink(collection)
    bpy.context.view_layer.update()
    [root] = lodgs("data.roots").roots(scene)
    photos, compare = [], lodgs("render.compare")
    monkeypatch.setattr(
        lodgs("render.renderer"), "draw_frame", lambda sets, view, _: photos.append(view.photograph)
    )
    compare.compare_view(bpy.context, root, scene.objects[view_name])
    assert photos == [tmp_path / "a" / "images" / "view.jpg"]
    assert lodgs("data.streams").file_of(root) == tmp_path / "a" / "town.ply"
    assert lodgs("runs.run_folders").automatic_run(root).path == tmp_path / "a" / "runs" / "one"
    lodgs("data.reloading").check_files()
    lodgs("runs.jobs").reattach()
    assert lodgs("data.reloading").watch_of(root) is None and lodgs("runs.watch").watch_of(root) is None


def test_hostile_paths_of_a_file_open_nothing(bpy, lodgs, saved, monkeypatch):
    """Viewports, panels and menus draw without a request of the user."""
    folders, streams = lodgs("runs.run_folders"), lodgs("data.streams")
    training = saved.lodgs.training
    opened = []
    for name in ("is_file", "is_dir", "exists", "resolve", "glob", "stat"):
        monkeypatch.setattr(Path, name, lambda path, *_, name=name, **__: opened.append((name, path)))
    for value in (r"\\server\share\run", *DEVICES):
        training.run = training.output = saved.lodgs.stream.file = saved.lodgs.scene_folder = value
        assert folders.cost_plot(saved) is None
        assert folders.automatic_run(saved) is None
        assert folders.find_runs(saved) == []
        assert streams.source_of(saved) is None
    assert opened == []


@pytest.mark.parametrize("value", DEVICES)
def test_devices_are_refused_on_request(lodgs, saved, value):
    saved.lodgs.stream.file = saved.lodgs.training.run = value
    error = lodgs("training.errors").LodgsError
    calls = (
        lambda: lodgs("data.streams").file_of(saved),
        lambda: lodgs("runs.run_folders").run_folder(saved),
        lambda: lodgs("render.engine").frame_path(value, saved.users_scene[0], 1),
    )
    for call in calls:
        with pytest.raises(error, match="names a device"):
            call()


def test_only_one_module_resolves_paths():
    package = Path(__file__).parents[3] / "blender_lodgs"
    users = [path.name for path in package.rglob("*.py") if "path.abspath(" in path.read_text("utf-8")]
    assert sorted(users) == ["mesh_depth.py", "paths.py"]  # the first only resolves the folder of the .blend


@pytest.mark.parametrize("is_saved", [False, True])
def test_appended_scenes_keep_their_paths(bpy, lodgs, saved, tmp_path, is_saved):
    """A scene of another folder is appended to an unsaved file and to a saved file."""
    expected = Path(bpy.path.abspath(saved.lodgs.training.run))
    bpy.ops.wm.save_mainfile()
    source, name = bpy.data.filepath, saved.name
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    if is_saved:
        (tmp_path / "other" / "place").mkdir(parents=True)
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "other" / "place" / "mine.blend"))
    bpy.ops.wm.append(directory=f"{source}/Object/", filename=name)
    appended = bpy.data.objects[name]
    assert appended.library is None and appended.lodgs.is_root
    run = appended.lodgs.training.run
    assert lodgs("data.paths").absolute_path(run).resolve() == expected.resolve()
    assert run.startswith("//") == is_saved and appended.lodgs.training.output == "/elsewhere"


@pytest.mark.parametrize("reopened", [False, True])
def test_scenes_made_local_keep_their_paths(bpy, lodgs, saved, tmp_path, reopened):
    saved.lodgs.stream.file = "//town.ply"
    name, collection = saved.name, saved.users_collection[0].name
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "b" / "file.blend"))
    bpy.ops.wm.link(
        directory=f"{tmp_path}/a/file.blend/Collection/", filename=collection, instance_collections=False
    )
    bpy.context.view_layer.update()
    if reopened:
        bpy.ops.wm.save_mainfile()
        bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    bpy.ops.object.select_all(action="SELECT")
    bpy.ops.object.make_local(type="ALL")
    root = bpy.data.objects[name]
    assert root.library is None
    assert lodgs("data.streams").file_of(root).resolve() == (tmp_path / "a" / "town.ply").resolve()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a" / "other.blend"))
    assert bpy.data.objects[name].lodgs.stream.file == "//town.ply"


@pytest.mark.parametrize("compressed", [False, True])
def test_truncated_blend_file_is_noticed(bpy, lodgs, tmp_path, compressed):
    """Blender 5.2 saves such a file on a full disk, and reports success."""
    path, is_complete_file = tmp_path / "scene.blend", lodgs("data.paths").is_complete_file
    bpy.ops.wm.save_as_mainfile(filepath=str(path), compress=compressed)
    assert is_complete_file(path)
    content = path.read_bytes()
    for size in (0, 4096, len(content) - 70):
        path.write_bytes(content[:size])
        assert not is_complete_file(path)


def test_false_reason_of_a_full_disk_is_corrected(bpy, lodgs, tmp_path, monkeypatch):
    def fail(**_):
        raise RuntimeError("Error: No such file or directory")

    paths, operators = lodgs("data.paths"), SimpleNamespace(wm=SimpleNamespace(save_as_mainfile=fail))
    monkeypatch.setattr(paths, "bpy", SimpleNamespace(ops=operators))
    with pytest.raises(RuntimeError, match="No space left"):
        paths.save_file(tmp_path / "a.blend")
    with pytest.raises(RuntimeError, match="No such file"):
        paths.save_file(tmp_path / "missing" / "a.blend")

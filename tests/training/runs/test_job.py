"""Jobs: files, presets, and errors."""

import json
from dataclasses import asdict, replace

import pytest

from training.errors import LodgsError
from training.runs.folder import RunFolder
from training.runs.job import Job, save_job


def write(path, text):
    path.write_text(text, encoding="utf-8")
    return path


def test_toml_and_json_jobs_are_equal_and_paths_are_relative_to_the_file(tmp_path):
    toml = write(tmp_path / "job.toml", 'scene = "my scene"\nout = "run"\nseed = 3\n[parameters]\nrho = 2\n')
    text = json.dumps({"scene": "my scene", "out": "run", "seed": 3, "parameters": {"rho": 2}})
    assert Job.from_file(toml) == Job.from_file(write(tmp_path / "job.json", text))
    assert Job.from_file(toml).scene == str(tmp_path / "my scene")


def test_home_folder_is_the_same_from_every_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("USERPROFILE", str(tmp_path / "home"))
    write(tmp_path / "job.toml", 'scene = "~/garden"\nout = "./~/run"\n')
    monkeypatch.chdir(tmp_path)
    for path in ("job.toml", tmp_path / "job.toml"):
        job = Job.from_file(path)
        assert job.scene == str(tmp_path / "home" / "garden") and job.out == str(tmp_path / "~" / "run")


def test_job_with_unusual_paths_round_trips(tmp_path):
    job = Job(
        scene='/a "quoted" \\ folder/ü 日本',
        out="/b\tc\x7f",
        parameters={"steps": [1, 2, 3], "levels": 3, "rho": 3.5},
    )
    job.write(tmp_path / "job.toml")
    assert asdict(Job.from_file(tmp_path / "job.toml")) == asdict(job)


def test_resolved_job_keeps_all_parameters(tmp_path):
    job = Job.from_dict({"scene": "/s", "out": "/o", "parameters": {"footprint": 30}}).resolved()
    job.write(tmp_path / "job.toml")
    reread = Job.from_file(tmp_path / "job.toml")
    assert reread.resolved_parameters() == job.resolved_parameters()
    assert reread.resolved_parameters().footprint == 30


def test_scalar_parameters_apply_to_all_levels_and_fewer_levels_keep_the_finest():
    job = Job.from_dict({"scene": "s", "out": "o", "parameters": {"levels": 3, "densify_interval": 50}})
    parameters = job.resolved_parameters()
    assert parameters.densify_interval == (50, 50, 50)
    assert parameters.steps == Job("s", "o").resolved_parameters().steps[-3:]


def test_captured_scenes_have_other_default_parameters():
    values = {"scene": "s", "out": "o", "method": "tree", "base": "b"}
    photographed = Job.from_dict(values).resolved_parameters()
    values |= {"capture": "dome", "scene": ""}
    captured = Job.from_dict(values).resolved_parameters()
    assert (captured.leaf_rate, captured.random_background) == (0, False)
    assert photographed.leaf_rate > 0 and photographed.random_background
    chosen = Job.from_dict(values | {"parameters": {"leaf_rate": 0.5}})
    assert chosen.resolved_parameters().leaf_rate == chosen.resolved().resolved_parameters().leaf_rate == 0.5


def test_paths_inside_a_run_follow_the_moved_run(tmp_path):
    run = tmp_path / "run"
    values = {"out": str(run), "method": "lodge", "base": str(run / "base.ply"), "capture": str(run / "dome")}
    Job.from_dict(values).write(run / "job.toml")
    moved = Job.from_file((run.rename(tmp_path / "moved")) / "job.toml")
    paths = [str(tmp_path / "moved" / name) for name in ("base.ply", "dome")]
    assert [moved.base, moved.capture] == paths and moved.out == str(tmp_path / "moved")
    assert (moved.scene, Job.from_dict(values | {"capture": "dome"}).capture) == ("", "dome")


@pytest.mark.parametrize(
    "text, message",
    [
        ('scene = "a"\nout = "b"\nsteps_total = 3\n', "Unknown key in job: 'steps_total'"),
        ('scene = "a"\nout = "b"\n[parameters]\nfootprnt = 3\n', "unknown parameter 'footprnt'"),
        ('out = "b"\n', "has no key 'scene'"),
        ("scene = 3\nout = 'b'\n", "scene = 3 is invalid. Use a text"),
        ('scene = "a"\nout = "b"\nmethod = "nerf"\n', "method = 'nerf' is invalid. Use one of: flod, octree"),
        ('scene = "a"\nout = "b"\npreset = "fast"\n', "preset = 'fast' is invalid. Use one of: draft"),
        (
            'scene = "a"\nout = "b"\nbackend = "metal"\n',
            "backend = 'metal' is invalid. Use one of: auto",
        ),
        ('scene = "a"\nout = "b"\nimage_scale = 0\n', "image_scale = 0"),
        ('scene = "a"\nout = "b"\nseed = -1\n', "seed = -1"),
        ('scene = "a"\nout = "b"\nseed = 1.5\n', "seed = 1.5"),
        ('scene = "a"\nout = "b"\nvalidation = 1\n', "validation = 1"),
        ('scene = "a"\nout = "b"\n[parameters]\nsteps = [1, 2]\n', "2 entries for 5 levels"),
        ('scene = "a"\nout = "b"\n[parameters]\nlevels = 0\n', "levels = 0"),
        ('scene = "a"\nout = "b"\n[parameters]\nrho = "four"\n', "rho = 'four'"),
        ('scene = "a"\nout = "b"\n[parameters]\nmax_splats = true\n', "max_splats = True"),
        ('scene = "a"\nout = "b"\n[parameters]\nrejoin_points = 1\n', "rejoin_points = 1"),
        ('out = "b"\ncapture = "dome"\n', "has no base"),
        (
            'scene = "a"\nout = "b"\ncapture = "dome"\nbase = "c"\nmethod = "lodge"\n',
            "both 'capture' and 'scene'",
        ),
        ('out = "b"\ncapture = "dome"\nbase = "c"\n', "method 'flod' cannot start from a base"),
        ('out = "b"\ncapture = 3\nbase = "c"\n', "capture = 3 is invalid"),
        ('out = "b"\ncapture = "dome"\nbase = "c"\nmethod = "lodge"\nviews = 1\n', "views = 1"),
        (
            'out = "b"\ncapture = "dome"\nbase = "c"\nmethod = "lodge"\nview_width = 9000\n',
            "view_width = 9000",
        ),
        ("scene = \n", "is not valid"),
        ('scene = "a"\nout = "b"\nexposure = nan\n', "exposure = nan is not a finite number"),
        ('scene = "a"\nout = "b"\nexposure = 33\n', "exposure = 33"),
        ('scene = "a"\nout = "b"\nphoto_memory = -1\n', "photo_memory = -1"),
        ('scene = "a"\nout = "b"\nexposure = true\n', "exposure = True"),
        ('scene = "a"\nout = "b"\nseed = true\n', "seed = True"),
        ('scene = "a"\nout = "b"\nseed = 2147483648\n', "seed = 2147483648"),
        (
            'scene = "a"\nout = "b"\nmethod = ["flod"]\n',
            r"method = \['flod'\]",
        ),
        ('scene = "a"\nout = "b"\npreset = {}\n', "preset = {}"),
        ('scene = "a"\nout = "b"\nparameters = 3\n', "parameters = 3"),
        ('scene = "a\\u0000b"\nout = "b"\n', "scene contains invalid characters"),
        ('scene = "a"\nout = "b"\n[parameters]\nlr_sh = 1e300\n', "lr_sh = 1e\\+300 is too large"),
        (
            'scene = "a"\nout = "b"\n[parameters]\nmax_splats = 2147483648\n',
            "max_splats = 2147483648 is too large",
        ),
        ("[" * 2000, "is not valid"),
        (f'scene = "{"x" * 2001}"\nout = "b"\n', "The path scene has 2[0-9]+ characters"),
    ],
)
def test_invalid_jobs_are_rejected(tmp_path, text, message):
    with pytest.raises(LodgsError, match=message):
        Job.from_file(write(tmp_path / "job.toml", text))


@pytest.mark.parametrize(
    ("method", "values", "message"),
    [
        ("flod", "densify_until = 1.5", "densify_until = 1.5 .* at most 1"),
        ("flod", "densify_interval = 0", "densify_interval = 0 .* above 0"),
        ("3dgs", "sh_degree = 4", "sh_degree = 4 .* at most 3"),
        ("octree", "widest = inf", "widest = inf"),
        ("octree", "lr_means = nan", "lr_means = nan"),
        ("octree", "nearest = 0.5\nfarthest = 0.5", "'nearest' is 0.5, .*'farthest', 0.5"),
        ("octree", "coarse_share = 2", "coarse_share = 2 .* at most 1"),
        ("octree", "coarse_factor = 0", "coarse_factor = 0 .* above 0"),
        ("octree", "grow_interval = 0", "grow_interval = 0 .* above 0"),
        ("octree", "max_splats = -1", "max_splats = -1 .* at least 0"),
        ("octree_neural", "offsets = 0", "offsets = 0 .* above 0"),
        ("octree_neural", "offsets = 101", "offsets = 101 .* at most 100"),
        ("octree_neural", "features = 1025", "features = 1025 .* at most 1024"),
        ("octree_neural", "appearance = 1025", "appearance = 1025 .* at most 1024"),
        ("octree_neural", "max_splats = 4", "'max_splats' is 4, .* 5 Gaussians"),
    ],
)
def test_invalid_parameters_are_rejected_before_training(tmp_path, method, values, message):
    text = f'scene = "a"\nout = "b"\nmethod = "{method}"\n[parameters]\n{values}\n'
    with pytest.raises(LodgsError, match=message):
        Job.from_file(write(tmp_path / "job.toml", text))


def test_path_that_is_not_utf_8_is_rejected():
    with pytest.raises(LodgsError, match=r"Invalid path out = '/b\\udcff': 'utf-8' codec can't encode"):
        Job.from_dict({"scene": "/a", "out": "/b\udcff"})


def test_missing_job_file_is_reported(tmp_path):
    with pytest.raises(LodgsError, match=r"absent\.toml"):
        Job.from_file(tmp_path / "absent.toml")


def test_other_files_are_not_read_as_jobs(tmp_path):
    with pytest.raises(LodgsError, match=r"scene\.zip: it is neither a job file"):
        Job.from_file(write(tmp_path / "scene.zip", 'scene = "x"'))


def test_unused_parameters_are_rejected():
    values = {"scene": "/s", "out": "/o", "method": "octree_neural", "parameters": {"dropout": 0.1}}
    with pytest.raises(LodgsError, match="'dropout'"):
        Job.from_dict(values)


def test_settings_may_change_after_a_failed_start_only(tmp_path):
    """A training that fails before its first step, such as for a missing device, has written its views."""
    run = RunFolder(tmp_path)
    run.create()
    first = Job.from_dict({"scene": "/s", "out": str(run.path)}).resolved()
    save_job(first, run)
    run.views.write_text('{"a.jpg": [6, 4]}')
    run.events_file.write_text("")
    other = replace(first, image_scale=0.25)
    save_job(other, run)
    assert Job.from_file(run.job).image_scale == 0.25
    run.level_file(1).write_bytes(b"splats")
    with pytest.raises(LodgsError, match="different: image_scale"):
        save_job(first, run)


def test_validation_needs_views_to_hold_out_and_to_train_on():
    values = {"scene": "photos", "out": "run", "validation": True}
    assert "test_every is 0. Set it to 3" in Job.from_dict({**values, "test_every": 0}).warnings()[0]
    assert Job.from_dict({**values, "test_every": 3}).warnings() == []
    with pytest.raises(LodgsError, match=r"test_every = 2 leaves no view to train on. Use 0 or at least 3"):
        Job.from_dict({**values, "test_every": 2})


def test_preset_paper_trains_at_full_size():
    """A smaller scale, also from before, is kept with a warning."""
    values = {"scene": "photos", "out": "run"}
    paper = Job.from_dict({**values, "preset": "paper"})
    assert (paper.image_scale, paper.warnings()) == (1.0, [])
    half = Job.from_dict({**values, "preset": "paper", "image_scale": 0.5})
    assert half.image_scale == 0.5 and "image_scale is 0.5. Set it to 1" in half.warnings()[0]
    draft = Job.from_dict(values)
    assert (draft.image_scale, draft.warnings()) == (0.5, [])

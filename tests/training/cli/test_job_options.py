"""Options of ``train`` are equivalent to a job file."""

import argparse
from dataclasses import fields, replace

import pytest

from training.__main__ import main
from training.cli.job_options import add_options, job_from_options, options_of, parse_resources
from training.errors import LodgsError
from training.runs.job import Job


def job(*words) -> Job:
    parser = argparse.ArgumentParser()
    add_options(parser)
    return job_from_options(parser.parse_args([str(word) for word in words]))


def test_every_key_of_a_job_has_an_option(capsys):
    with pytest.raises(SystemExit):
        job("--help")
    message = capsys.readouterr().out
    names = {field.name for field in fields(Job)} - {"parameters"} | {"set"}
    assert [name for name in names if f"--{name.replace('_', '-')} " not in message] == []


def test_options_and_file_give_the_same_job(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    parts = job(
        "--scene", "photos", "--out", "run", "--method", "octree", "--preset", "standard",
        "--image-scale", 0.25, "--test-every", 0, "--seed", 7, "--backend", "cpu", "--exposure", -1.5,
        "--model", "sparse/1", "--images", "small", "--set", "max_splats=5000", "--set", "nearest=0.1",
        "--validation",
    )  # fmt: skip
    (tmp_path / "job.toml").write_text(
        'scene = "photos"\nout = "run"\nmethod = "octree"\npreset = "standard"\nimage_scale = 0.25\n'
        'test_every = 0\nseed = 7\nbackend = "cpu"\nexposure = -1.5\nmodel = "sparse/1"\nimages = "small"\n'
        "validation = true\n[parameters]\nmax_splats = 5000\nnearest = 0.1\n"
    )
    assert parts == Job.from_file(tmp_path / "job.toml") == job("job.toml")


def test_missing_options_use_defaults(tmp_path):
    assert job("--scene", "/a", "--out", "/b") == Job("/a", "/b")


def test_options_override_the_file(tmp_path):
    Job("/a", "/b", seed=1, parameters={"rho": 3, "footprint": 9}).write(tmp_path / "job.toml")
    changed = job(tmp_path / "job.toml", "--seed", 2, "--out", "/c", "--set", "rho=2")
    assert changed == Job("/a", "/c", seed=2, parameters={"rho": 2, "footprint": 9})


def test_run_folder_resumes_its_run(tmp_path):
    written = Job("/a", str(tmp_path), method="octree", seed=4)
    written.write(tmp_path / "job.toml")
    assert job(tmp_path) == job(tmp_path / "job.toml") == written
    assert job(tmp_path, "--out", "/b") == Job(str(tmp_path), "/b")


def test_resources_are_names_with_numbers():
    assert parse_resources(["GPU=1", "memory=1.5e9"]) == {"GPU": 1.0, "memory": 1.5e9}
    assert parse_resources([]) is None
    for text in ("GPU", "=1", "GPU=0", "GPU=-1", "GPU=nan", "GPU=inf", "GPU=a"):
        with pytest.raises(LodgsError, match="Cannot read resource") as error:
            parse_resources([text])
        assert error.value.remedy == "Use for example GPU=1."


def test_two_scenes_are_refused(tmp_path):
    with pytest.raises(LodgsError, match="and --scene /a are two folders"):
        job(tmp_path, "--scene", "/a", "--out", "/b")


def test_check_of_a_run_checks_its_scene(tmp_path, capsys):
    (tmp_path / "run").mkdir()
    Job(str(tmp_path / "scene"), str(tmp_path / "run")).write(tmp_path / "run" / "job.toml")
    assert main(["train", str(tmp_path / "run"), "--check"]) == 2
    assert f"Cannot open {tmp_path / 'scene'}" in capsys.readouterr().out


@pytest.mark.parametrize(
    "values",
    [
        Job("/a", "/b"),
        Job("/a b", "/b'c", "octree", "paper", seed=3, exposure=-1.5, test_every=0, validation=True,
            cells="2x3", image_scale=0.65, parameters={"levels": 3, "far_share": 0.25}),
        Job("/a", "/b", preset="paper", image_scale=0.5),
        Job("/a", "/b", preset="paper", image_scale=1.0),
        Job("/a", "/b", "lodge", base="/c", parameters={"distances": [8.0, 4.5, 0.0], "antialias": True}),
    ],
)  # fmt: skip
def test_options_of_a_job_recreate_it(values):
    assert job(*options_of(values)) == values
    assert job("--scene", "/x", *options_of(values, exclude=("scene",))) == replace(values, scene="/x")


@pytest.mark.parametrize(
    ("text", "preset", "scale"),
    [
        ("", "paper", 1.0),
        ('preset = "paper"', "draft", 0.5),
        ("image_scale = 0.5", "paper", 0.5),
        ('preset = "paper"\nimage_scale = 1', "draft", 1.0),
        ("", "standard", 0.5),
    ],
)
def test_preset_of_an_option_has_its_image_scale_unless_the_file_sets_one(tmp_path, text, preset, scale):
    (tmp_path / "a.toml").write_text(f'scene = "a"\nout = "b"\n{text}\n')
    assert job(tmp_path / "a.toml", "--preset", preset).image_scale == scale


def test_words_need_no_quotation_marks():
    for value in ("points", '"points"'):
        parameters = job("--scene", "a", "--out", "b", "--set", f"depth={value}").resolved_parameters()
        assert parameters.depth == "points"
    flags = job("--scene", "a", "--out", "b", "--set", "antialias=true").resolved_parameters()
    assert flags.antialias is True


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "no job, or no run folder"),
        (["--scene", "a"], "--out RUN"),
        (["--scene", "a", "--out", "b", "--set", "rho"], "Cannot read --set rho: it is not NAME=VALUE"),
        (
            ["--scene", "a", "--out", "b", "--set", "rho=4 5"],
            "Cannot read --set rho=4 5: it is not NAME=VALUE",
        ),
        (["--scene", "a", "--out", "b", "--set", "steps=1,2"], r"not NAME=VALUE.*'steps=\[100, 200\]' for a"),
        (["--scene", "a", "--out", "b", "--set", "rho=four"], "rho"),
        (["--scene", "a", "--out", "b", "--set", "depth=deep"], "depth"),
        (["--scene", "a", "--out", "b", "--set", "wings=2"], "'wings'"),
        (["--scene", "a", "--out", "b", "--image-scale", "7"], "image_scale"),
        (["--scene", "a", "--out", "b", "--test-every", "1"], "test_every"),
        (["--scene", "a", "--out", "b", "--base", "c"], "base"),
        (["absent.toml"], r"absent\.toml"),
    ],
)
def test_invalid_options_are_reported(words, message):
    with pytest.raises(LodgsError, match=message):
        job(*words)


def test_command_reports_errors_as_events(capsys):
    assert main(["train", "--scene", "a", "--out", "b", "--set", "wings=2"]) == 2
    out, err = capsys.readouterr()
    assert "'wings'" in out and out.startswith('{"event": "error"') and not err

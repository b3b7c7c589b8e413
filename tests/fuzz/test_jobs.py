"""Jobs: TOML and JSON files, regions, and parameters on the command line."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.fuzz.entry_points import attempt
from tests.fuzz.mutations import UNUSUAL_VALUES, corrupted, corrupted_value
from training.cli.job_options import add_options, job_from_options
from training.methods import METHODS
from training.runs.job import Job
from training.scenes.regions import Region

JOBS = [
    asdict(Job.from_dict({"scene": "/scene", "out": "/run", "method": method, "seed": 3}).resolved())
    for method in METHODS
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("jobs")


@pytest.fixture(scope="module")
def texts(folder) -> dict[str, list[bytes]]:
    """Return jobs in both file formats."""
    toml = []
    for values in JOBS:
        Job.from_dict(values).write(folder / "good.toml")
        toml.append((folder / "good.toml").read_bytes())
    return {".toml": toml, ".json": [json.dumps(values).encode() for values in JOBS]}


def check(path, content: object) -> None:
    """Check that an accepted job is unchanged after writing and reading it."""
    if job := attempt("job", lambda: Job.from_file(path).resolved(), content):
        job.write(path.with_name("again.toml"))
        assert Job.from_file(path.with_name("again.toml")) == job


@pytest.mark.cases(short=150, weight=2)
@given(data=st.data(), suffix=st.sampled_from([".toml", ".json"]))
def test_corrupt_job_files(folder, texts, data, suffix):
    text = data.draw(corrupted(texts[suffix]))
    path = folder / f"job{suffix}"
    path.write_bytes(text)
    check(path, text)


@pytest.mark.cases(short=150, weight=2)
@given(values=st.sampled_from(JOBS).flatmap(corrupted_value))
def test_jobs_with_unusual_values(folder, values):
    path = folder / "values.json"
    path.write_text(json.dumps(values))
    check(path, values)


@given(
    name=st.sampled_from(sorted(JOBS[0]["parameters"])),
    value=st.one_of(UNUSUAL_VALUES.map(json.dumps), st.text(max_size=20)),
)
def test_command_line_parameters(name, value):
    parser = argparse.ArgumentParser()
    add_options(parser)
    options = parser.parse_args(["--scene", "s", "--out", "o", "--set", f"{name}={value}"])
    attempt("--set", lambda: job_from_options(options).resolved(), value)


REGION = {
    "ground": [[1.0, 0, 0], [0, 1, 0], [0, 0, 1]], "cell": [[None, 1], [0, 2]], "area": [[None, 2], [-1, 3]],
    "views": ["a.jpg", "b.jpg"], "seam": True,
}  # fmt: skip


def check_region(path, content: object) -> None:
    """Check that an accepted region can be written and used."""
    if region := attempt("region", lambda: Region.read(path), content):
        region.write(path)
        region.near_border(np.zeros((3, 3), np.float32))


@given(data=st.data())
def test_corrupt_regions(folder, data):
    text = data.draw(corrupted([json.dumps(REGION).encode()]))
    (folder / "region.json").write_bytes(text)
    check_region(folder / "region.json", text)


@given(values=corrupted_value(REGION))
def test_regions_with_unusual_values(folder, values):
    (folder / "region.json").write_text(json.dumps(values))
    check_region(folder / "region.json", values)

"""Generated documentation pages match the declarations of methods, rules and commands."""

from pathlib import Path

import pytest

from tools import tables
from training.cli import COMMANDS
from training.cli.options import option_name
from training.lod.rule import rules
from training.methods import METHODS
from training.runs.job import KEYS

DOCS = Path(__file__).parents[2] / "docs"


@pytest.mark.parametrize("name", tables.PAGES)
def test_committed_pages_are_up_to_date(name):
    page = (DOCS / name).read_text(encoding="utf-8")
    assert page == tables.PAGES[name](), "run `make tables` and check the difference"


def test_every_parameter_and_control_has_one_row():
    parameters, controls = tables.parameters_page(), tables.controls_page()
    for method in METHODS.values():
        section = parameters.split(f"\n`{method.name}`: ")[1].split("\n## ")[0]
        rows = [line for line in section.splitlines() if line.startswith("| `")]
        assert [row.split("`")[1] for row in rows] == [f.name for f in method.fields]
        assert all(row.count(" | ") == 6 for row in rows)
    for rule in rules().values():
        section = controls.split(f"\n## {rule.name}\n")[1].split("\n## ")[0]
        for control in rule.controls:
            assert f"`--{control.name.replace('_', '-')}` | {control.label} | " in section


def test_every_command_has_its_options():
    page = tables.commands_page()
    for command in COMMANDS:
        assert f"\n## {command}\n" in page
    train = page.split("\n## train\n")[1].split("\n## ")[0]
    rows = [line for line in train.splitlines() if line.startswith("| `")]
    assert [row.split("`")[1].split()[0] for row in rows] == ["JOB", *_train_options(), "--check"]
    assert all(row.count(" | ") == 2 for row in rows)


def _train_options() -> list[str]:
    return [*map(option_name, KEYS), "--set"]

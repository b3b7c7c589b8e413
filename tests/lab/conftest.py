"""Tests of the laboratory's tools: ``make nightly`` runs them."""

from pathlib import Path

from tests.training.conftest import tiny_scene  # noqa: F401 - a fixture


def pytest_collection_modifyitems(items):
    for item in items:
        if item.path.is_relative_to(Path(__file__).parent):
            item.add_marker("nightly")

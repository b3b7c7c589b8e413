"""Fixtures for the tests of both packages."""

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def shared_scenes() -> Path:
    """Folder of real COLMAP scenes outside the repository: ``$LODGS_SCENES`` or ``../shared/scenes``."""
    default = Path(__file__).resolve().parents[2] / "shared" / "scenes"
    folder = Path(os.environ.get("LODGS_SCENES", default))
    if not folder.is_dir():
        pytest.skip(f"no real scenes at {folder}; set LODGS_SCENES")
    return folder.resolve()

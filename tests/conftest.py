"""Fixtures that every room's tests share."""

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def shared_scenes() -> Path:
    """Real COLMAP scenes, kept outside the repository: ``$LODGS_SCENES`` or ``../shared/scenes``."""
    beside = Path(__file__).resolve().parents[2] / "shared" / "scenes"
    folder = Path(os.environ.get("LODGS_SCENES", beside))
    if not folder.is_dir():
        pytest.skip(f"no real scenes at {folder}; set LODGS_SCENES")
    return folder.resolve()

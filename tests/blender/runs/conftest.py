"""Modules of training runs, and a scene to train."""

import pytest


@pytest.fixture
def jobs(lodgs):
    return lodgs("runs.jobs")


@pytest.fixture
def job_settings(lodgs):
    return lodgs("runs.job_settings")


@pytest.fixture
def root(bpy, tmp_path):
    """A scene root as after an import, without cameras."""
    collection = bpy.data.collections.new("tiny")
    bpy.context.scene.collection.children.link(collection)
    root = bpy.data.objects.new("tiny", None)
    collection.objects.link(root)
    root.lodgs.is_root, root.lodgs.scene_folder = True, str(tmp_path / "scene")
    return root

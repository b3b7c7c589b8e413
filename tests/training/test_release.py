"""Files of a release."""

import re
import zipfile

from tools import release
from training.scenes.colmap import read_scene


def test_example_archive_has_the_scene_in_its_folder(tmp_path):
    release.write_example(tmp_path / "example.zip")
    with zipfile.ZipFile(tmp_path / "example.zip") as archive:
        archive.extractall(tmp_path)
    scene = read_scene(tmp_path / "lantern_garden")
    assert len(scene.cameras) == 48 and not scene.warnings


def test_list_of_files_names_the_version():
    text = release.CONTENTS.format(version="1.2.3")
    assert text.startswith("# LODGS 1.2.3\n") and "`lodgs-1.2.3.zip`" in text


def test_site_is_searchable_without_a_server():
    """The plugin offline would load its script for workers from another server."""
    config = (release.ROOT / "mkdocs.yml").read_text("utf-8")
    (script,) = re.findall(r"^  polyfills: \[(\S+)\]", config, re.MULTILINE)
    assert "\n  - offline\n" in config and "iframe-worker" in script
    assert 'location.protocol === "file:"' in (release.ROOT / "docs" / script).read_text("utf-8")

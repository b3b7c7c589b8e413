"""Download the viewer for pages (`lodgs page`) from npm into training/viewer. Standard library only.

PlayCanvas' supersplat-viewer (MIT) streams levels within a splat budget, needs no network and no build, and
has a public interface for cameras and budgets. Releases contain it.
"""

from __future__ import annotations

import argparse
import base64
import hashlib
import io
import sys
import tarfile
import urllib.error
import urllib.request
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "training" / "viewer"
VERSION = "1.36.2"
ADDRESS = f"https://registry.npmjs.org/@playcanvas/supersplat-viewer/-/supersplat-viewer-{VERSION}.tgz"
SHA512 = "L7w0BlagAonRHQg5qhaDyBB8zrRtiU9QgglNU3kUgsqHpokCAtuf9j4P0kxsUaQn61FZ1qJGkRKsOCbrLCDR0w=="
FILES = ("public/index.js", "public/index.css", "LICENSE")


def fetch() -> bool:
    """Download the viewer unless it is there; return False without network.

    Exits if the archive differs from the pinned one.
    """
    mark = FOLDER / "VERSION"
    if mark.is_file() and mark.read_text("utf-8") == VERSION:
        return True
    try:
        with urllib.request.urlopen(ADDRESS, timeout=15) as response:
            data = response.read()
    except (urllib.error.URLError, OSError) as error:
        print(f"viewer: not downloaded ({error}); lodgs page needs it.", file=sys.stderr)
        return False
    if base64.b64encode(hashlib.sha512(data).digest()).decode() != SHA512:
        sys.exit(f"viewer: {ADDRESS} differs from the pinned archive.")
    FOLDER.mkdir(exist_ok=True)
    with tarfile.open(fileobj=io.BytesIO(data)) as archive:
        for name in FILES:
            member = archive.extractfile(f"package/{name}")
            assert member is not None
            (FOLDER / Path(name).name).write_bytes(member.read())
    mark.write_text(VERSION, "utf-8")
    return True


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__).parse_args()
    sys.exit(not fetch())

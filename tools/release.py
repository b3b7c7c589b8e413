"""Build all files of a release in dist/: ``make release``.

lodgs-VERSION.zip is the extension; repository/ holds it with an index.json that Blender accepts as a remote
repository; the wheel and the sdist are the Python package; lodgs-VERSION-site.zip is the documentation;
lodgs-VERSION-example.zip is the example scene; README.md lists the files; SHA256SUMS has the checksums.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from tools import extension  # noqa: E402

EXAMPLE = "examples/lantern_garden"
CONTENTS = """# LODGS {version}

| file | use |
|---|---|
| `lodgs-{version}.zip` | extension: drag it into Blender 4.5 or newer, do not unpack it |
| `lodgs-{version}-site.zip` | documentation: unpack it and open `site/start/install.html` |
| `lodgs-{version}-example.zip` | example scene of the first steps: unpack it |
| `lodgs-{version}-py3-none-any.whl` | Python package: `pip install` it in an environment of its own |
| `lodgs-{version}.tar.gz` | source of the Python package |
| `repository/` | extension repository for a web server of your own |
| `SHA256SUMS` | checksums of all files |
"""


def main() -> int:
    parser = argparse.ArgumentParser(description="Build all files of a release.")
    parser.add_argument("--out", type=Path, default=ROOT / "dist")
    parser.add_argument("--tag", help="fail unless it is v and the manifest's version")
    parser.add_argument("--site", help="address of the published documentation, for manifest and site")
    parser.add_argument("--dirty", action="store_true", help="allow uncommitted changes")
    options = parser.parse_args()
    version = extension.read_manifest()["version"]
    check_release(version, options.tag, options.dirty)
    out: Path = options.out.resolve()
    shutil.rmtree(out, ignore_errors=True)
    archive = extension.build(out, website=options.site)
    (out / "repository").mkdir()
    shutil.copy2(archive, out / "repository")
    extension.write_repository(out / "repository")
    run([sys.executable, "-m", "hatchling", "build", "--directory", str(out)])
    site = ROOT / "build" / "site"
    os.environ.update(SITE_URL=options.site or "", NO_MKDOCS_2_WARNING="1")
    shutil.rmtree(site, ignore_errors=True)
    run([sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict"])
    shutil.make_archive(str(out / f"lodgs-{version}-site"), "zip", site.parent, site.name)
    (out / "README.md").write_text(CONTENTS.format(version=version), encoding="utf-8")
    write_example(out / f"lodgs-{version}-example.zip")
    files = sorted(path for path in out.rglob("*") if path.is_file())
    lines = [f"{hashlib.sha256(p.read_bytes()).hexdigest()}  {p.relative_to(out).as_posix()}" for p in files]
    (out / "SHA256SUMS").write_text("\n".join(lines) + "\n", encoding="utf-8")
    for path in files:
        print(f"{path.stat().st_size / 1e6:8.2f} MB  {path.relative_to(out)}")
    return 0


def write_example(archive: Path) -> None:
    """Write the scene of the first steps, in a folder of its name."""
    names = subprocess.run(
        ["git", "ls-files", "-z", EXAMPLE], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout
    with zipfile.ZipFile(archive, "w") as file:  # photos do not shrink
        for name in filter(None, names.split("\0")):
            file.write(ROOT / name, Path(name).relative_to("examples"))


def check_release(version: str, tag: str | None, dirty: bool) -> None:
    """Exit if the working tree, the tag or the changelog do not fit the version."""
    if tag and tag != f"v{version}":
        sys.exit(f"release: the tag {tag} differs from the manifest's version {version}.")
    state = subprocess.run(
        ["git", "status", "--porcelain"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    if state.stdout and not dirty:
        sys.exit("release: the working tree has uncommitted changes. Commit them first.")
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    if not re.search(rf"^## {re.escape(version)} \(\d{{4}}-\d\d-\d\d\)$", changelog, re.MULTILINE):
        sys.exit(f"release: CHANGELOG.md has no dated heading for {version}.")


def run(command: list[str]) -> None:
    """Run a command in the repository's root; exit if it fails."""
    if code := subprocess.run(command, cwd=ROOT, check=False).returncode:
        sys.exit(code)


if __name__ == "__main__":
    sys.exit(main())

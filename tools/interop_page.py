"""Check that Chromium opens pages of ``lodgs page`` in time and without messages. Part of ``make interop``.

Writes the levels of FLoD, as ``interop_viewers.py`` trains them, as one file and as a folder, and opens the
file from disk and the folder from a server, without a graphics card.
Exit code 0: all checks pass; 1: some do not; 2: nothing was checked.
"""

from __future__ import annotations

import argparse
import functools
import http.server
import io
import re
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from tools.interop_results import store_result  # noqa: E402
from tools.interop_viewers import BROWSERS, PAGE_VIEWER, WALKED, run_browser, train_method  # noqa: E402
from training.runs.page.write import PAGE, write_page  # noqa: E402

MAX_SECONDS = 4.0
"""Maximum CPU time of all processes of the browser, from its start to the first image of all splats. It
hardly depends on other programs, unlike the time that passes, which is less on two idle cores."""
TIMEOUT = 240
REPORT = """<head><script>
const timer = setInterval(() => {
  if (!document.body?.dataset.loaded) return;
  clearInterval(timer);
  console.log("loaded");
}, 10);
</script>"""
EXPECTED = r"SuperSplat Viewer v.*|Renderer: \w+|No available adapters\."
"""Messages of a browser without a graphics card, as a regular expression."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "bundle", nargs="?", type=Path, metavar="BUNDLE.ply", help="use this bundle, without a record"
    )
    given = parser.parse_args().bundle
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        print("interop: Chromium is not installed. Pages are not checked.")
        return 2
    source = given or train_method(WALKED)
    failed = False
    with tempfile.TemporaryDirectory() as work:
        folder, single = Path(work, "page"), Path(work, "page.html")
        write_page(source, folder, backend="cpu")
        write_page(source, single, single=True, backend="cpu")
        for path in (folder / PAGE, single):
            path.write_text(path.read_text("utf-8").replace("<head>", REPORT, 1), "utf-8")
        with serve(folder) as address:
            for kind, place in (("page in one file", single.as_uri()), ("page in a folder", address)):
                seconds, messages = open_page(browser, place)
                passed = seconds <= MAX_SECONDS and not messages
                failed |= not passed
                print(f"{kind}: {seconds:.1f} s of CPU time  {'; '.join(messages)}", flush=True)
                if not given:
                    store_result({
                        "check": "page", "program": PAGE_VIEWER.label, "version": PAGE_VIEWER.version,
                        "format": kind, "method": WALKED, "passed": passed, "cpu_seconds": round(seconds, 1),
                        "messages": messages,
                    })  # fmt: skip
    return int(failed)


def open_page(browser: str, address: str) -> tuple[float, list[str]]:
    """Return the CPU time of a browser until a page has loaded all splats, and its unexpected messages.

    Args:
        browser: path of Chromium.
        address: address of a page with REPORT.
    """
    messages = []
    with run_browser(browser, address, "--enable-logging=stderr", stderr=subprocess.PIPE) as process:
        timer = threading.Timer(TIMEOUT, process.kill)
        timer.start()
        assert process.stderr is not None
        for line in io.TextIOWrapper(process.stderr, "utf-8", "replace"):
            text = re.search(r':CONSOLE.*?\] "(.*)", source: ', line)
            if text and text[1] == "loaded":
                timer.cancel()
                return cpu_time(process.pid), messages
            if text and not re.fullmatch(EXPECTED, text[1]):
                messages.append(text[1])
    return TIMEOUT, messages


def cpu_time(pid: int) -> float:
    """Return the CPU time of a process and its descendants, in seconds."""
    main = psutil.Process(pid)
    times = [process.cpu_times() for process in (main, *main.children(recursive=True))]
    return sum(time.user + time.system for time in times)


@contextmanager
def serve(folder: Path) -> Iterator[str]:
    """Serve a folder in the block, and yield its address."""

    class Handler(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            return

    server = http.server.ThreadingHTTPServer(
        ("127.0.0.1", 0), functools.partial(Handler, directory=str(folder))
    )
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/{PAGE}"
    finally:
        server.shutdown()
        server.server_close()


if __name__ == "__main__":
    sys.exit(main())

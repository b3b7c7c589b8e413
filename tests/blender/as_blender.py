"""Run ``blender --command lodgs ...`` with Blender's module: ``python as_blender.py --command lodgs ...``."""

import importlib
import os
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tools.blender_module import EXTENSION, start_blender

if __name__ == "__main__":
    if trusted := sys.argv[1] == "--enable-autoexec":
        del sys.argv[1]
    assert sys.argv[1:3] == ["--command", "lodgs"]
    start_blender().context.preferences.filepaths.use_scripts_auto_execute = trusted
    code = importlib.import_module(f"{EXTENSION}.blender_lodgs.commands").main(sys.argv[3:])
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)  # the module can hang when Python ends

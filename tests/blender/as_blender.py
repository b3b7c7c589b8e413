"""``python as_blender.py --command lodgs ...``: what ``blender`` does with that, by Blender's module."""

import importlib
import os
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tools.blender_module import EXTENSION, start_blender

if __name__ == "__main__":
    assert sys.argv[1:3] == ["--command", "lodgs"]
    start_blender()
    code = importlib.import_module(f"{EXTENSION}.blender_lodgs.commands").main(sys.argv[3:])
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)  # the module can hang when Python ends

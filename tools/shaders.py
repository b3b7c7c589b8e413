"""Translate our shaders with naga to the languages of macOS and Windows. Part of ``make interop``.

wgpu compiles WGSL shaders with naga to MSL for Metal, HLSL for Direct3D 12 and SPIR-V for Vulkan; naga-wasm
(from npm) is this compiler for Node. Apple's and Microsoft's compilers are not tested here. Exit code 0: all
shaders are translated; 1: errors; 2: nothing was checked.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from tools.interop import FOLDER, install, node_problem  # noqa: E402
from training.rasterize.gpu.source import SHADERS, source_of  # noqa: E402

PACKAGE, VERSION = "naga-wasm", "30.1.0"
PROGRAM = """
import { readFileSync } from "node:fs";
import { nagaVersion, parseWgsl, validate, writeHlsl, writeMsl, writeSpirv } from "naga-wasm";
const result = { naga: nagaVersion, shaders: {} };
for (const [name, source] of Object.entries(JSON.parse(readFileSync(0, "utf8")))) {
  try {
    const module = parseWgsl(source), info = validate(module);
    result.shaders[name] = {
      metal: writeMsl(module, info, {}), hlsl: writeHlsl(module, info, { shaderModel: "5_1" }),
      spirv: "x".repeat(writeSpirv(module, info, {}).length),
    };
  } catch (error) {
    result.shaders[name] = { error: String(error.formatted ?? error) };
  }
}
console.log(JSON.stringify(result));
"""


def translate() -> dict:
    """Return naga's version, and for each shader its translations by language or an ``error``.

    Raises:
        RuntimeError: Node cannot run the compiler.
    """
    names = sorted(path.stem for path in SHADERS.glob("*.wgsl") if path.stem != "common")
    program = FOLDER / "shaders.mjs"
    program.write_text(PROGRAM, encoding="utf-8")
    answer = subprocess.run(
        ["node", str(program)], input=json.dumps({name: source_of(name) for name in names}),
        capture_output=True, text=True, encoding="utf-8", check=False,
    )  # fmt: skip
    if answer.returncode:
        raise RuntimeError(answer.stderr)
    return json.loads(answer.stdout)


def main() -> int:
    argparse.ArgumentParser(description=__doc__).parse_args()
    if problem := node_problem():
        print(f"shaders: {problem} Install Node.js with npm and repeat.")
        return 2
    if not install(PACKAGE, VERSION):
        print(f"shaders: npm cannot install {PACKAGE} {VERSION}, see above.")
        return 2
    result = translate()
    texts = FOLDER / "shaders"
    texts.mkdir(exist_ok=True)
    failed = False
    for name, written in result["shaders"].items():
        if "error" in written:
            failed = True
            print(f"{name}: {written['error']}")
            continue
        (texts / f"{name}.metal").write_text(written["metal"], encoding="utf-8")
        (texts / f"{name}.hlsl").write_text(written["hlsl"], encoding="utf-8")
        sizes = ", ".join(f"{kind} {len(text):,}" for kind, text in written.items())
        print(f"naga {result['naga']} translates {name}: {sizes}")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())

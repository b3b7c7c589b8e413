"""Let naga translate our shaders to what macOS and Windows take: ``make interop``.

wgpu gives every WGSL shader to its compiler naga, which writes MSL for Metal, HLSL for Direct3D 12 and SPIR-V
for Vulkan. naga-wasm (from npm) is that compiler for Node. Whether Apple's and Microsoft's own compilers take
what it writes is seen on their systems only. Exit code 0: all are translated; 1: one is not; 2: nothing could
be checked.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from tools.interop import FOLDER, install  # noqa: E402
from training.rasterize.gpu.source import SHADERS, source_of  # noqa: E402

PACKAGE, VERSION = "naga-wasm", "30.1.0"
PROGRAM = """
import { readFileSync } from "node:fs";
import { nagaVersion, parseWgsl, validate, writeHlsl, writeMsl, writeSpirv } from "naga-wasm";
const found = { naga: nagaVersion, shaders: {} };
for (const [name, source] of Object.entries(JSON.parse(readFileSync(0, "utf8")))) {
  try {
    const module = parseWgsl(source), info = validate(module);
    found.shaders[name] = {
      metal: writeMsl(module, info, {}), hlsl: writeHlsl(module, info, { shaderModel: "5_1" }),
      spirv: "x".repeat(writeSpirv(module, info, {}).length),
    };
  } catch (error) {
    found.shaders[name] = { error: String(error.formatted ?? error) };
  }
}
console.log(JSON.stringify(found));
"""


def translated() -> dict:
    """naga's version, and of each shader the texts by language, or an ``error``.

    Raises:
        RuntimeError: Node could not run it.
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
    if not shutil.which("node") or not shutil.which("npm"):
        print("No shader was translated: Node.js is missing; install it (with npm) and run this again.")
        return 2
    if not install(PACKAGE, VERSION):
        print(f"No shader was translated: npm could not install {PACKAGE} {VERSION} (see above).")
        return 2
    found = translated()
    texts = FOLDER / "shaders"
    texts.mkdir(exist_ok=True)
    failed = False
    for name, written in found["shaders"].items():
        if "error" in written:
            failed = True
            print(f"{name}: {written['error']}")
            continue
        (texts / f"{name}.metal").write_text(written["metal"], encoding="utf-8")
        (texts / f"{name}.hlsl").write_text(written["hlsl"], encoding="utf-8")
        sizes = ", ".join(f"{kind} {len(text):,}" for kind, text in written.items())
        print(f"naga {found['naga']} translates {name}: {sizes}")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())

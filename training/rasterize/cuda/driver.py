"""Compile the kernels with NVRTC, and launch them through the CUDA driver.

NVRTC is a library of torch's CUDA packages, so no compiler has to be installed. Compilation takes seconds.
"""

from __future__ import annotations

import ctypes
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import suppress
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol

import torch

from .source import kernel_source


class Module(Protocol):
    """Compiled kernels."""

    def function(self, name: str) -> Any:
        """Return a kernel."""

    def launch(self, function: Any, blocks: int, threads: int, pointers: ctypes.Array) -> None:
        """Start a kernel, whose arguments are at the pointers, on torch's current stream."""


@cache
def kernels() -> Kernels:
    """Compile the kernels for the current device on the first call.

    Raises:
        OSError: NVRTC or the driver is not installed.
        RuntimeError: NVRTC or the driver reports an error.
    """
    return Kernels(_DeviceModule())


class Kernels:
    """Kernels of a module by name."""

    def __init__(self, module: Module) -> None:
        self._module = module
        self._functions: dict[str, Any] = {}

    def launch(self, name: str, blocks: int, threads: int, *arguments: Any) -> None:
        """Start a kernel with blocks of threads; nothing happens without blocks.

        Args:
            arguments: contiguous tensors or None (null) for pointers, bytes for structures, ctypes' numbers,
                or Python's for ``int`` and ``float``.

        Raises:
            RuntimeError: the driver reports an error.
        """
        if name not in self._functions:
            self._functions[name] = self._module.function(name)
        if not blocks:
            return
        values = [_as_ctypes(argument) for argument in arguments]
        pointers = (ctypes.c_void_p * len(values))(*map(ctypes.addressof, values))
        self._module.launch(self._functions[name], blocks, threads, pointers)


def _as_ctypes(argument: Any) -> Any:
    if argument is None:
        return ctypes.c_void_p()
    if isinstance(argument, torch.Tensor):
        if not argument.is_contiguous():
            raise ValueError(f"kernels require contiguous tensors, not strides of {argument.stride()}")
        return ctypes.c_void_p(argument.data_ptr())
    if isinstance(argument, bytes):
        return (ctypes.c_char * len(argument)).from_buffer_copy(argument)
    if isinstance(argument, float):
        return ctypes.c_float(argument)
    return ctypes.c_int(argument) if isinstance(argument, int) else argument


class _DeviceModule:
    """Kernels on torch's current GPU."""

    def __init__(self) -> None:
        self._driver = ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
        major, minor = torch.cuda.get_device_capability()
        image = compile_kernels(f"sm_{major}{minor}")
        torch.zeros(1, device="cuda")  # creates the context
        self._context, self._handle = ctypes.c_void_p(), ctypes.c_void_p()
        self._threads = threading.local()
        self._call("cuCtxGetCurrent", ctypes.byref(self._context))
        self._call("cuModuleLoadData", ctypes.byref(self._handle), image)

    def function(self, name: str) -> ctypes.c_void_p:
        """Return a kernel."""
        function = ctypes.c_void_p()
        self._call("cuModuleGetFunction", ctypes.byref(function), self._handle, name.encode())
        return function

    def launch(self, function: ctypes.c_void_p, blocks: int, threads: int, pointers: ctypes.Array) -> None:
        """Start a kernel on torch's current stream."""
        if not hasattr(self._threads, "ready"):  # autograd's threads may not have a context yet
            self._call("cuCtxSetCurrent", self._context)
            self._threads.ready = True
        stream = ctypes.c_void_p(torch.cuda.current_stream().cuda_stream)
        self._call("cuLaunchKernel", function, blocks, 1, 1, threads, 1, 1, 0, stream, pointers, None)

    def _call(self, name: str, *arguments: Any) -> None:
        if status := getattr(self._driver, name)(*arguments):
            text = ctypes.c_char_p()
            self._driver.cuGetErrorString(status, ctypes.byref(text))
            raise RuntimeError(f"{name}: {(text.value or b'unknown error').decode()}")


def compile_kernels(architecture: str, options: Sequence[str] = ("--std=c++17",)) -> bytes:
    """Compile the kernels for an architecture such as ``sm_90``; return a CUBIN.

    Raises:
        OSError: NVRTC is not installed.
        RuntimeError: NVRTC reports an error.
    """
    nvrtc = load_nvrtc()

    def call(name: str, *arguments: Any) -> None:
        if status := getattr(nvrtc, name)(*arguments):
            nvrtc.nvrtcGetErrorString.restype = ctypes.c_char_p
            raise RuntimeError(f"{name}: {nvrtc.nvrtcGetErrorString(status).decode()}{log()}")

    def log() -> str:
        size = ctypes.c_size_t()
        if not program or nvrtc.nvrtcGetProgramLogSize(program, ctypes.byref(size)):
            return ""
        text = ctypes.create_string_buffer(size.value)
        nvrtc.nvrtcGetProgramLog(program, text)
        return f"\n{text.value.decode(errors='replace')}".rstrip()

    program = ctypes.c_void_p()
    source = kernel_source().encode()
    call("nvrtcCreateProgram", ctypes.byref(program), source, b"kernels.cu", 0, None, None)
    try:
        flags = [f"--gpu-architecture={architecture}".encode(), *(option.encode() for option in options)]
        call("nvrtcCompileProgram", program, len(flags), (ctypes.c_char_p * len(flags))(*flags))
        size = ctypes.c_size_t()
        call("nvrtcGetCUBINSize", program, ctypes.byref(size))
        image = ctypes.create_string_buffer(size.value)
        call("nvrtcGetCUBIN", program, image)
        return image.raw
    finally:
        nvrtc.nvrtcDestroyProgram(ctypes.byref(program))


def load_nvrtc() -> ctypes.CDLL:
    """Load NVRTC from torch's packages, or from the system; OSError if it is not installed."""
    for path in _nvrtc_files():
        with suppress(OSError):
            for part in path.parent.glob("libnvrtc-builtins.so.*"):  # which NVRTC loads by name
                ctypes.CDLL(str(part))
            return ctypes.CDLL(str(path))
    for name in _nvrtc_names():
        with suppress(OSError):
            return ctypes.CDLL(name)
    raise OSError("NVRTC is not installed")


def _nvrtc_names() -> list[str]:
    major = (torch.version.cuda or "13").partition(".")[0]
    if sys.platform == "win32":
        return [f"nvrtc64_{major}0_0.dll"]
    return [f"libnvrtc.so.{major}", "libnvrtc.so"]


def _nvrtc_files() -> Iterator[Path]:
    """Find NVRTC of torch's CUDA version in torch's folder and NVIDIA's packages."""
    nvidia = find_spec("nvidia")
    for package in nvidia.submodule_search_locations or [] if nvidia else []:
        for name in _nvrtc_names():
            yield from sorted(Path(package).glob(f"*/*/{name}"))
    for name in _nvrtc_names():
        yield from sorted((Path(torch.__file__).parent / "lib").glob(name))

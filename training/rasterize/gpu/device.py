"""Compute on any graphics device, through wgpu: by Vulkan, D3D12 (Windows) or Metal (macOS).

A device records dispatches of compute shaders (:meth:`Device.run`) until something is read back. Buffers are
bound by the names that the shader gives them.
"""

from __future__ import annotations

import math
import re
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cache
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np

from ...errors import LodgsError
from .source import source_of

KINDS = {"DiscreteGPU": "discrete", "IntegratedGPU": "integrated", "CPU": "software"}
"""wgpu's kinds of adapters as ours; others are "other"."""
LANES = 64
"""Invocations of a workgroup, in every shader."""
UNIFORMS = 1 << 16
"""Bytes of the numbers that dispatches read, of as many as are submitted together."""
SMALLEST = 64
"""Bytes of a buffer of nothing: one element of whatever a shader takes it for."""
ALIGNED = 64
"""Rows after which a binding may begin: of 4 bytes and more, as no device asks for more than 256 bytes."""
BINDING = re.compile(r"@group\(0\) @binding\((\d+)\) var<(uniform|storage)[^>]*> (\w+)")
REMEDY = "Train on the CPU (Training Device in Blender, backend = cpu in a job), or install the GPU's driver."


class Adapter(NamedTuple):
    """A device that can be opened.

    Attributes:
        name: as its driver calls it.
        kind: "discrete", "integrated", "software" (shaders run on the processor) or "other".
        api: "Vulkan", "Metal" or "D3D12".
        driver: its name and version, where known.
    """

    name: str
    kind: str
    api: str
    driver: str

    @property
    def software(self) -> bool:
        """Whether it is no graphics device, but a program that stands for one."""
        return self.kind == "software"


@dataclass(frozen=True)
class Buffer:
    """An array of 4-byte numbers on a device; ``offset``: the bytes of the handle that lie before it."""

    handle: Any
    shape: tuple[int, ...]
    kind: np.dtype
    offset: int = 0

    @property
    def size(self) -> int:
        """Bytes that are bound for it."""
        return 4 * math.prod(self.shape) or SMALLEST

    def part(self, begin: int, end: int) -> Buffer:
        """Some of its rows."""
        before = self.offset + begin * replace(self, shape=self.shape[1:]).size
        return replace(self, shape=(end - begin, *self.shape[1:]), offset=before)


def adapters() -> list[Adapter]:
    """What can be opened on this computer: discrete devices first, software last, each name once.

    Raises:
        LodgsError: wgpu is not installed or finds no driver.
    """
    return list(_found())


def open_device(name: str = "") -> Device:
    """A device by its adapter's name, or by a part of it; the first of :func:`adapters` if that is empty.

    It is opened once, and kept; anew only after it was lost.

    Raises:
        LodgsError: there is none of this name, or it cannot be opened.
    """
    found = _found()
    fitting = [adapter for adapter in found if name.casefold() in adapter.name.casefold()]
    fitting.sort(key=lambda adapter: adapter.name != name)  # one may be called as another begins
    if not fitting:
        raise LodgsError(
            f'There is no graphics device "{name}" here.', f"There are: {', '.join(a.name for a in found)}."
        )
    device = _opened(fitting[0])
    if device.lost:
        _opened.cache_clear()
        device = _opened(fitting[0])
    return device


@cache
def _found() -> dict[Adapter, Any]:
    """wgpu's adapters by ours, best first."""
    wgpu = _wgpu()
    try:
        handles = wgpu.gpu.enumerate_adapters_sync()
    except Exception as error:
        raise LodgsError(f"Graphics devices cannot be listed: {_reason(error)}.", REMEDY) from error
    found: dict[str, tuple[Adapter, Any]] = {}
    for handle in handles:
        info = handle.info
        name, kind = info["device"] or info["vendor"], KINDS.get(info["adapter_type"], "other")
        if name not in found and info["backend_type"] != "OpenGL":
            found[name] = Adapter(name, kind, info["backend_type"], info["description"] or ""), handle
    if not found:
        raise LodgsError("No graphics device with Vulkan, Metal or D3D12 was found.", REMEDY)
    ranks = {"discrete": 0, "integrated": 1, "other": 2, "software": 3}
    return dict(sorted(found.values(), key=lambda pair: ranks[pair[0].kind]))


@cache
def _opened(adapter: Adapter) -> Device:
    return Device(adapter, _found()[adapter])


@cache
def _wgpu() -> Any:
    try:
        wgpu = import_module("wgpu")
        extras = import_module("wgpu.backends.wgpu_native.extras")
    except (ImportError, OSError, RuntimeError) as error:
        raise LodgsError(
            f"The rasterizer for graphics devices needs wgpu: {_reason(error)}.",
            f"Install it with: {sys.executable} -m pip install wgpu",
        ) from error
    with suppress(RuntimeError):  # somebody in this process has begun with all
        extras.set_instance_extras(backends=["Vulkan", "Metal", "DX12"])
    return wgpu


def _reason(error: BaseException) -> str:
    """wgpu's messages end in what went wrong."""
    return str(error).strip().rpartition("\n")[2].strip().rstrip(".") or type(error).__name__


class Device:
    """An opened adapter.

    Attributes:
        adapter: what it is.
        limits: by wgpu's names, all that the adapter has.
        most_bytes: that a shader sees of a buffer at a time.
        largest: bytes of the largest buffer.
        most_groups: workgroups that are submitted at a time.
        moved: bytes that went to the device and came from it.
        lost: it answers no more; :func:`open_device` opens another.
        lock: held by who records, so that two threads do not mix their dispatches.
    """

    def __init__(self, adapter: Adapter, handle: Any) -> None:
        self.adapter, self.lost, self.lock = adapter, False, threading.RLock()
        self.limits: dict[str, int] = dict(handle.limits)
        try:
            self._device = handle.request_device_sync(required_limits=self.limits)
        except Exception as error:  # of the driver
            raise LodgsError(f"{adapter.name} cannot be opened: {_reason(error)}.", REMEDY) from error
        self.largest = self.limits["max-buffer-size"]
        self.most_bytes = min(self.limits["max-storage-buffer-binding-size"], self.largest)
        self.most_groups = self.limits["max-compute-workgroups-per-dimension"]
        self.moved = 0
        self._firsts: dict[int, Any] = {}
        flags = _wgpu().BufferUsage
        self._uniforms = self._device.create_buffer(size=UNIFORMS, usage=flags.UNIFORM | flags.COPY_DST)
        self._numbers, self._told = np.zeros(UNIFORMS // 4, np.uint32), 0
        self._pipelines: dict[tuple[str, str], tuple[Any, Any, dict[str, int]]] = {}
        self._encoder: Any = None
        self._pass: Any = None

    def empty(self, kind: type, *shape: int) -> Buffer:
        """A buffer of zeros: of np.float32, np.uint32 or np.int32.

        Raises:
            LodgsError: it is larger than the device's largest, or than its memory.
        """
        flags = _wgpu().BufferUsage
        usage = flags.STORAGE | flags.COPY_SRC | flags.COPY_DST
        size = max(int(np.prod(shape, dtype=np.int64)) * 4, SMALLEST)
        self._require(size, self.largest)
        with self._said():
            handle = self._device.create_buffer(size=size, usage=usage)
        return Buffer(handle, shape, np.dtype(kind))

    def upload(self, array: np.ndarray) -> Buffer:
        """A copy of an array of 4-byte numbers; LodgsError as :meth:`empty`."""
        array = np.ascontiguousarray(array)
        buffer = self.empty(array.dtype.type, *array.shape)
        if array.size:
            self.moved += array.nbytes
            with self._said():
                self._device.queue.write_buffer(buffer.handle, 0, array.reshape(-1))
        return buffer

    def extended(self, buffer: Buffer, count: int, rows: np.ndarray | None = None) -> Buffer:
        """A copy with so many rows more at its end: zeros, or these; LodgsError as :meth:`empty`."""
        before, *row = buffer.shape
        found = self.empty(buffer.kind.type, before + count, *row)
        self.submit()
        with self._said():
            encoder = self._device.create_command_encoder()
            encoder.copy_buffer_to_buffer(buffer.handle, buffer.offset, found.handle, 0, buffer.size)
            self._device.queue.submit([encoder.finish()])
            if rows is not None:
                self.moved += rows.nbytes
                self._device.queue.write_buffer(found.handle, buffer.size, np.ascontiguousarray(rows))
        return found

    def parts(self, **buffers: Buffer) -> Iterator[dict[str, Buffer]]:
        """The rows of buffers that have the same number of them, as many at a time as the device binds."""
        (count,) = {buffer.shape[0] for buffer in buffers.values()}
        widest = max(buffer.part(0, 1).size for buffer in buffers.values())
        at_once = max(self.most_bytes // widest // ALIGNED, 1) * ALIGNED
        for begin in range(0, count, at_once):
            end = min(begin + at_once, count)
            yield {name: buffer.part(begin, end) for name, buffer in buffers.items()}

    def run(
        self,
        shader: str,
        entry: str,
        groups: int,
        numbers: tuple = (),
        at_once: int = 1 << 30,
        begin: int = 0,
        /,
        **buffers: Buffer,
    ) -> None:
        """Record a dispatch; it has run when something is read.

        Args:
            shader, entry: name of a file in ``shaders/`` without its ending, and of a function in it.
            groups: workgroups; each learns from ``group_of`` which one it is, counted from ``begin``.
            numbers: what the shader's uniform holds, in order: integers, floats or arrays of them.
            at_once: workgroups that are submitted at a time, at most: between them the device can do other
                things, such as draw windows.
            buffers: those that the function uses, by the shader's names.

        Raises:
            LodgsError: the device was lost, or does not bind so large a buffer.
        """
        self._require(max(buffer.size for buffer in buffers.values()), self.most_bytes)
        with self._said():
            pipeline, layout, bindings = self._pipeline(shader, entry)
            bound = {
                bindings[name]: {"buffer": buffer.handle, "offset": buffer.offset, "size": buffer.size}
                for name, buffer in buffers.items()
            }
            at_once = min(at_once, self.most_groups)
            for first in range(begin, begin + groups, at_once):
                if numbers:
                    bound[bindings["u"]] = self._uniform(*numbers)
                if first not in self._firsts:
                    usage = _wgpu().BufferUsage.UNIFORM
                    self._firsts[first] = self._device.create_buffer_with_data(
                        data=_words((first,)), usage=usage
                    )
                bound[bindings["first_group"]] = {"buffer": self._firsts[first]}
                entries = [{"binding": at, "resource": resource} for at, resource in bound.items()]
                group = self._device.create_bind_group(layout=layout, entries=entries)
                if self._pass is None:
                    self._encoder = self._device.create_command_encoder()
                    self._pass = self._encoder.begin_compute_pass()
                self._pass.set_pipeline(pipeline)
                self._pass.set_bind_group(0, group)
                self._pass.dispatch_workgroups(min(at_once, begin + groups - first))
                if groups > at_once:
                    self.submit()

    def read(self, buffer: Buffer, begin: int = 0) -> np.ndarray:
        """The rows of a buffer from ``begin`` on, once all that was recorded has run: a copy.

        Raises:
            LodgsError: the device was lost, or is out of memory.
        """
        self.submit()
        rows, *row = buffer.shape
        shape = rows - begin, *row
        size, row_size = (int(np.prod(each, dtype=np.int64)) * buffer.kind.itemsize for each in (shape, row))
        if not size:
            return np.zeros(shape, buffer.kind)
        self.moved += size
        with self._said():
            data = self._device.queue.read_buffer(buffer.handle, buffer.offset + begin * row_size, size)
        return np.frombuffer(data, buffer.kind).reshape(shape)

    def wait(self) -> None:
        """Until what was recorded has run, and what it alone needed is free; LodgsError as :meth:`read`."""
        self.read(self.empty(np.uint32, 1))

    def submit(self) -> None:
        """Let what was recorded begin; LodgsError: the device was lost."""
        if self._pass is None:
            return
        with self._said():
            recorded, encoder, self._pass, self._encoder = self._pass, self._encoder, None, None
            recorded.end()
            told, self._told = self._numbers[: self._told], 0
            if len(told):
                self.moved += told.nbytes
                self._device.queue.write_buffer(self._uniforms, 0, told)
            self._device.queue.submit([encoder.finish()])

    def _require(self, size: int, most: int) -> None:
        """LodgsError where a scene needs more bytes in one piece than the device has so."""
        if size > most:
            raise LodgsError(
                f"{self.adapter.name} takes {most >> 20} MB at a time, "
                f"and this scene needs {-(-size >> 20)} MB.",
                "Choose the cpu backend, fewer splats or smaller images.",
            )

    def _uniform(self, *numbers: Any) -> dict[str, Any]:
        """What a dispatch binds to read these numbers; they go to the device with what is recorded.

        Where there is no room for more, what was recorded begins first.
        """
        words = _words(numbers)
        aligned = self.limits["min-uniform-buffer-offset-alignment"] // 4
        if self._told + len(words) > len(self._numbers):
            self.submit()
        begin = self._told
        self._numbers[begin : begin + len(words)] = words
        self._told = begin + -(-len(words) // aligned) * aligned
        return {"buffer": self._uniforms, "offset": 4 * begin, "size": words.nbytes}

    def _pipeline(self, shader: str, entry: str) -> tuple[Any, Any, dict[str, int]]:
        """Compiled when it is first used: the pipeline, its layout, and the bindings by name."""
        if (shader, entry) not in self._pipelines:
            source = source_of(shader)
            module = self._device.create_shader_module(code=source)
            pipeline = self._device.create_compute_pipeline(
                layout="auto", compute={"module": module, "entry_point": entry}
            )
            bindings = {name: int(at) for at, _, name in BINDING.findall(source)}
            self._pipelines[shader, entry] = pipeline, pipeline.get_bind_group_layout(0), bindings
        return self._pipelines[shader, entry]

    @contextmanager
    def _said(self) -> Iterator[None]:
        """What goes wrong on a device, in a sentence; mistakes of ours stay what they are."""
        try:
            yield
        except (RuntimeError, MemoryError, _wgpu().GPUError) as error:
            self._pass = self._encoder = None
            self._told = 0
            name, said = self.adapter.name, str(error).lower()
            if "lost" not in said and (isinstance(error, MemoryError) or "memory" in said):
                raise LodgsError(
                    f"{name} has no more memory.",
                    "Close other programs that use it, take fewer splats or smaller images, or go on "
                    "with the run on the cpu.",
                ) from error
            if "lost" not in said and isinstance(error, _wgpu().GPUValidationError):
                raise
            self.lost = True
            raise LodgsError(
                f"{name} does not answer any more: {_reason(error)}.",
                "Resume the run, on this device or on the cpu; a newer driver may help.",
            ) from error


def _words(numbers: tuple) -> np.ndarray:
    """As a uniform has them: whole vectors of four."""
    parts = [_as_words(number) for number in numbers]
    count = sum(map(len, parts))
    words = np.zeros(-(-count // 4) * 4, np.uint32)
    np.concatenate(parts, out=words[:count])
    return words


def _as_words(number: Any) -> np.ndarray:
    array = np.atleast_1d(np.asarray(number)).reshape(-1)
    return array.astype(np.float32 if array.dtype.kind == "f" else np.uint32).view(np.uint32)

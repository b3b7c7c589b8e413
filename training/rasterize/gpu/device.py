"""Compute on graphics devices through wgpu, with Vulkan, D3D12 (Windows) or Metal (macOS).

A device records dispatches of compute shaders (:meth:`Device.run`) until data is read back. Buffers are bound
by their names in the shader. Dispatches that repeat are prepared once (:meth:`Device.record`).
"""

from __future__ import annotations

import math
import os
import re
import sys
import tempfile
import threading
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cache
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np

from ...errors import LodgsError
from .recording import Dispatch, Recording, encode, words_of
from .source import source_of

KINDS = {"DiscreteGPU": "discrete", "IntegratedGPU": "integrated", "CPU": "software"}
"""Our names of wgpu's adapter types; all further types are "other"."""
LANES = 64
"""Invocations per workgroup in every shader."""
UNIFORM_BYTES = 1 << 16
"""Size of the buffer for the uniforms of all dispatches that are submitted together."""
MIN_BUFFER_BYTES = 64
"""Size of an empty buffer: at least one element of any shader type."""
ROW_ALIGNMENT = 64
"""Bindings begin at multiples of this many rows of at least 4 bytes, as devices require up to 256 bytes."""
BINDING = re.compile(r"@group\(0\) @binding\((\d+)\) var<(uniform|storage)[^>]*> (\w+)")
REMEDY = "Train on the CPU (Training Device in Blender, backend = cpu in a job), or install the GPU's driver."


class Adapter(NamedTuple):
    """A graphics device that can be opened.

    Attributes:
        name: name that its driver reports.
        kind: "discrete", "integrated", "software" (shaders run on the CPU) or "other".
        api: "Vulkan", "Metal" or "D3D12".
        driver: name and version of the driver, if known.
    """

    name: str
    kind: str
    api: str
    driver: str

    @property
    def software(self) -> bool:
        """True if shaders run on the CPU instead of a graphics device."""
        return self.kind == "software"


@dataclass(frozen=True)
class Buffer:
    """An array of 4-byte numbers on a device; ``offset`` is its first byte in the handle."""

    handle: Any
    shape: tuple[int, ...]
    kind: np.dtype
    offset: int = 0

    @property
    def size(self) -> int:
        """Size of its binding in bytes."""
        return 4 * math.prod(self.shape) or MIN_BUFFER_BYTES

    def part(self, begin: int, end: int) -> Buffer:
        """Return the rows from ``begin`` to ``end`` as a view."""
        offset = self.offset + begin * replace(self, shape=self.shape[1:]).size
        return replace(self, shape=(end - begin, *self.shape[1:]), offset=offset)


def adapters() -> list[Adapter]:
    """List the devices of this computer: discrete devices first, software last, each name once.

    Raises:
        LodgsError: wgpu is not installed or finds no driver.
    """
    return list(_enumerate())


def open_device(name: str = "") -> Device:
    """Open a device by its adapter's name or a part of it; the first of :func:`adapters` if empty.

    Devices stay open, and are reopened only after they were lost.

    Raises:
        LodgsError: no device has this name, or it cannot be opened.
    """
    matches = [adapter for adapter in adapters() if name.casefold() in adapter.name.casefold()]
    matches.sort(key=lambda adapter: adapter.name != name)  # a name may be a prefix of another
    if not matches:
        raise LodgsError(
            f'Cannot open graphics device "{name}": it does not exist.',
            f"Choose from: {', '.join(adapter.name for adapter in adapters())}.",
        )
    device = _open(matches[0])
    if device.lost:
        _open.cache_clear()
        device = _open(matches[0])
    return device


@cache
def _enumerate() -> dict[Adapter, Any]:
    """Return wgpu's adapters by :class:`Adapter`, best first."""
    wgpu = _wgpu()
    try:
        with _runtime_folder():
            handles = wgpu.gpu.enumerate_adapters_sync()
    except Exception as error:
        raise LodgsError(f"Cannot list graphics devices: {_reason(error)}.", REMEDY) from error
    available: dict[str, tuple[Adapter, Any]] = {}
    for handle in handles:
        info = handle.info
        name, kind = info["device"] or info["vendor"], KINDS.get(info["adapter_type"], "other")
        if name not in available and info["backend_type"] != "OpenGL":
            available[name] = Adapter(name, kind, info["backend_type"], info["description"] or ""), handle
    if not available:
        raise LodgsError("Cannot detect a graphics device with Vulkan, Metal or D3D12.", REMEDY)
    ranks = {"discrete": 0, "integrated": 1, "other": 2, "software": 3}
    return dict(sorted(available.values(), key=lambda pair: ranks[pair[0].kind]))


@contextmanager
def _runtime_folder() -> Iterator[None]:
    """Set XDG_RUNTIME_DIR meanwhile, without which drivers of Linux print errors of a window system."""
    missing = {"XDG_RUNTIME_DIR"} - os.environ.keys() if sys.platform == "linux" else set()
    os.environ |= dict.fromkeys(missing, tempfile.gettempdir())
    try:
        yield
    finally:
        for name in missing:
            os.environ.pop(name, None)


@cache
def _open(adapter: Adapter) -> Device:
    return Device(adapter, _enumerate()[adapter])


@cache
def _wgpu() -> Any:
    try:
        wgpu = import_module("wgpu")
        extras = import_module("wgpu.backends.wgpu_native.extras")
    except (ImportError, OSError, RuntimeError) as error:
        raise LodgsError(
            f"Cannot import wgpu, which the gpu backend requires: {_reason(error)}.",
            f"Install it with: {sys.executable} -m pip install wgpu",
        ) from error
    with suppress(RuntimeError):  # this process has already used wgpu with all backends
        extras.set_instance_extras(backends=["Vulkan", "Metal", "DX12"])
    return wgpu


def _reason(error: BaseException) -> str:
    """Return the last line of a message, in which wgpu states the cause."""
    return str(error).strip().rpartition("\n")[2].strip().rstrip(".") or type(error).__name__


class Device:
    """An opened adapter.

    Attributes:
        adapter: the opened adapter.
        limits: all limits of the adapter, by wgpu's names.
        binding_bytes: maximum size of a binding, the part of a buffer that a shader accesses.
        buffer_bytes: maximum size of a buffer.
        max_groups: maximum number of workgroups per dispatch.
        transferred: bytes copied to and from the device so far.
        counts: number of dispatches, buffers, bind groups, submissions and blocking reads so far.
        lost: true after the device stopped responding; :func:`open_device` then opens it again.
        lock: held while recording, so that threads do not mix their dispatches.
    """

    def __init__(self, adapter: Adapter, handle: Any) -> None:
        self.adapter = adapter
        self.lost = False
        self.lock = threading.RLock()
        self.limits: dict[str, int] = dict(handle.limits)
        try:
            self._device = handle.request_device_sync(required_limits=self.limits)
        except Exception as error:  # from the driver
            raise LodgsError(f"Cannot open {adapter.name}: {_reason(error)}.", REMEDY) from error
        self.buffer_bytes = self.limits["max-buffer-size"]
        self.binding_bytes = min(self.limits["max-storage-buffer-binding-size"], self.buffer_bytes)
        self.max_groups = self.limits["max-compute-workgroups-per-dimension"]
        self.transferred = 0
        self.counts: Counter[str] = Counter()
        self._first_groups: dict[int, Any] = {}
        flags = _wgpu().BufferUsage
        self._uniforms = self._device.create_buffer(size=UNIFORM_BYTES, usage=flags.UNIFORM | flags.COPY_DST)
        self._numbers = np.zeros(UNIFORM_BYTES // 4, np.uint32)
        self._number_count = 0
        self._pipelines: dict[tuple[str, str], tuple[Any, Any, dict[str, int]]] = {}
        self._encoder: Any = None
        self._pass: Any = None
        self._recording: Recording | None = None

    def empty(self, kind: type, *shape: int) -> Buffer:
        """Create a buffer of zeros of type np.float32, np.uint32 or np.int32.

        A buffer that is created in :meth:`record` is cleared before each replay.

        Raises:
            LodgsError: it exceeds the device's maximum or its memory.
        """
        buffer = self.scratch(kind, *shape)
        if self._recording is not None:
            self._recording.cleared.append((buffer.handle, buffer.size))
        return buffer

    def scratch(self, kind: type, *shape: int) -> Buffer:
        """Create a buffer of any content, for shaders that write all of it; LodgsError as in `empty`.

        In :meth:`record` it may be a buffer of another recording.
        """
        size = 4 * math.prod(shape)
        create, recording = self._create_buffer, self._recording
        handle = create(size) if recording is None else recording.take_buffer(size, create)
        return Buffer(handle, shape, np.dtype(kind))

    def _create_buffer(self, size: int) -> Any:
        size = max(size, MIN_BUFFER_BYTES)
        self._require(size, self.buffer_bytes)
        flags = _wgpu().BufferUsage
        usage = flags.STORAGE | flags.COPY_SRC | flags.COPY_DST
        with self._translate_errors():
            handle = self._device.create_buffer(size=size, usage=usage)
        self.counts["buffers"] += 1
        return handle

    def upload(self, array: np.ndarray) -> Buffer:
        """Copy an array of 4-byte numbers to the device; LodgsError as in :meth:`empty`."""
        array = np.ascontiguousarray(array)
        handle = self._create_buffer(array.nbytes)
        if array.size:
            self._write(handle, array)
        return Buffer(handle, array.shape, array.dtype)

    def write(self, buffer: Buffer, array: np.ndarray) -> None:
        """Replace a buffer's content after all recorded dispatches; LodgsError as in :meth:`read`."""
        self.submit()
        self._write(buffer.handle, np.ascontiguousarray(array))

    def clear(self, buffer: Buffer) -> None:
        """Set a buffer to zeros after all recorded dispatches; LodgsError as in :meth:`read`."""
        self.submit()
        with self._translate_errors():
            encoder = self._device.create_command_encoder()
            encoder.clear_buffer(buffer.handle)
            self._device.queue.submit([encoder.finish()])

    def _write(self, handle: Any, array: np.ndarray) -> None:
        self.transferred += array.nbytes
        with self._translate_errors():
            self._device.queue.write_buffer(handle, 0, array.reshape(-1))

    def extended(self, buffer: Buffer, count: int, rows: np.ndarray | None = None) -> Buffer:
        """Copy a buffer and append ``count`` rows: ``rows`` or zeros; LodgsError as in :meth:`empty`."""
        old_count, *row = buffer.shape
        extended = self.empty(buffer.kind.type, old_count + count, *row)
        self.submit()
        with self._translate_errors():
            encoder = self._device.create_command_encoder()
            encoder.copy_buffer_to_buffer(buffer.handle, buffer.offset, extended.handle, 0, buffer.size)
            self._device.queue.submit([encoder.finish()])
            if rows is not None:
                self.transferred += rows.nbytes
                self._device.queue.write_buffer(extended.handle, buffer.size, np.ascontiguousarray(rows))
        return extended

    def parts(self, **buffers: Buffer) -> Iterator[dict[str, Buffer]]:
        """Split buffers with the same number of rows into parts that the device can bind."""
        (count,) = {buffer.shape[0] for buffer in buffers.values()}
        widest = max(buffer.part(0, 1).size for buffer in buffers.values())
        size = max(self.binding_bytes // widest // ROW_ALIGNMENT, 1) * ROW_ALIGNMENT
        for begin in range(0, count, size):
            end = min(begin + size, count)
            yield {name: buffer.part(begin, end) for name, buffer in buffers.items()}

    def run(
        self,
        shader: str,
        entry: str,
        groups: int,
        numbers: tuple = (),
        chunk: int = 1 << 30,
        begin: int = 0,
        /,
        **buffers: Buffer,
    ) -> None:
        """Record a dispatch; it runs before the next read.

        Args:
            shader, entry: name of a file in ``shaders/`` without extension, and of a function in it.
            groups: number of workgroups; ``group_of`` in the shader returns their indices from ``begin``.
            numbers: values of the shader's uniform, in order: integers, floats or arrays.
            chunk: maximum number of workgroups to submit at once. Between chunks the device can do other
                work, such as drawing windows.
            buffers: buffers that the function uses, by their names in the shader.

        Raises:
            LodgsError: the device was lost, or a buffer exceeds its maximum binding.
        """
        self._require(max(buffer.size for buffer in buffers.values()), self.binding_bytes)
        with self._translate_errors():
            pipeline, layout, bindings = self._pipeline(shader, entry)
            bound = {
                bindings[name]: {"buffer": buffer.handle, "offset": buffer.offset, "size": buffer.size}
                for name, buffer in buffers.items()
            }
            chunk = self.max_groups if self.adapter.kind == "discrete" else min(chunk, self.max_groups)
            uniform = None
            for first in range(begin, begin + groups, chunk):
                if self._recording is None:
                    if numbers and (first == begin or not self._number_count):
                        bound[bindings["u"]] = self._uniform(*numbers)
                elif numbers and first == begin:
                    uniform = bindings["u"], *self._recording.add_numbers(numbers, words_of(numbers))
                bound[bindings["first_group"]] = self._first_group(first)
                self._dispatch(
                    Dispatch(pipeline, layout, dict(bound), uniform, min(chunk, begin + groups - first))
                )
                if groups > chunk:
                    self.submit()

    @contextmanager
    def record(self, shared: list[Any]) -> Iterator[Recording]:
        """Prepare the dispatches of a block for :meth:`replay` instead of running them.

        Buffers that the block creates with :meth:`empty` are cleared before each replay. It cannot read.

        Args:
            shared: buffers that recordings share, see :class:`Recording`.
        """
        self.submit()
        aligned = self.limits["min-uniform-buffer-offset-alignment"] // 4
        recording = self._recording = Recording(aligned, shared)
        try:
            yield recording
        finally:
            self._recording = None
        usage = _wgpu().BufferUsage.UNIFORM | _wgpu().BufferUsage.COPY_DST
        with self._translate_errors():
            recording.finish(
                lambda size: self._device.create_buffer(size=size, usage=usage),
                self._device.create_bind_group,
            )
        self.counts["bind_groups"] += recording.count

    def replay(self, recording: Recording, copies: Iterable[tuple[Buffer, Buffer]] = ()) -> None:
        """Submit recorded dispatches, after copies of buffers (source, target) of the same size.

        Raises:
            LodgsError: the device was lost.
        """
        self.submit()
        handles = [(a.handle, a.offset, b.handle, b.offset, a.size) for a, b in copies]
        with self._translate_errors():
            recording.replay(self._device, handles)
        self.transferred += recording.uniforms.size
        self.counts["dispatches"] += recording.count
        self.counts["submissions"] += len(recording.parts)

    def read(self, buffer: Buffer, begin: int = 0) -> np.ndarray:
        """Run all recorded dispatches, and copy a buffer's rows from ``begin`` on to the host.

        Raises:
            LodgsError: the device was lost or is out of memory.
        """
        self.submit()
        rows, *row = buffer.shape
        shape = rows - begin, *row
        size, row_size = (int(np.prod(dims, dtype=np.int64)) * buffer.kind.itemsize for dims in (shape, row))
        if not size:
            return np.zeros(shape, buffer.kind)
        self.transferred += size
        self.counts["reads"] += 1
        with self._translate_errors():
            data = self._device.queue.read_buffer(buffer.handle, buffer.offset + begin * row_size, size)
        return np.frombuffer(data, buffer.kind).reshape(shape)

    def wait(self) -> None:
        """Wait until all recorded dispatches have run and released memory; LodgsError as in :meth:`read`."""
        self.read(self.empty(np.uint32, 1))

    def submit(self) -> None:
        """Submit all recorded dispatches; LodgsError if the device was lost."""
        if self._recording is not None:
            self._recording.divide()
        if self._pass is None:
            return
        with self._translate_errors():
            compute_pass = self._pass
            encoder = self._encoder
            self._pass = self._encoder = None
            compute_pass.end()
            numbers = self._numbers[: self._number_count]
            self._number_count = 0
            if len(numbers):
                self.transferred += numbers.nbytes
                self._device.queue.write_buffer(self._uniforms, 0, numbers)
            self._device.queue.submit([encoder.finish()])
        self.counts["submissions"] += 1

    def _dispatch(self, dispatch: Dispatch) -> None:
        """Add a dispatch to the recording or to the next submission."""
        if self._recording is not None:
            self._recording.add(dispatch)
            return
        entries = [{"binding": at, "resource": resource} for at, resource in dispatch.bound.items()]
        group = self._device.create_bind_group(layout=dispatch.layout, entries=entries)
        self.counts.update(dispatches=1, bind_groups=1)
        if self._pass is None:
            self._encoder = self._device.create_command_encoder()
            self._pass = self._encoder.begin_compute_pass()
        encode(self._pass, [(dispatch.pipeline, group, dispatch.groups)])

    def _first_group(self, first: int) -> dict[str, Any]:
        """Return the binding of ``first_group`` with this value."""
        if first not in self._first_groups:
            usage = _wgpu().BufferUsage.UNIFORM
            self._first_groups[first] = self._device.create_buffer_with_data(
                data=words_of((first,)), usage=usage
            )
        return {"buffer": self._first_groups[first]}

    def _require(self, size: int, limit: int) -> None:
        """Raise LodgsError if a buffer or binding exceeds the device's limit in bytes."""
        if size > limit:
            raise LodgsError(
                f"Cannot use {self.adapter.name}: this scene needs a buffer of {-(-size >> 20)} MB, "
                f"the limit is {limit >> 20} MB.",
                "Choose the cpu backend, fewer splats or smaller images.",
            )

    def _uniform(self, *numbers: Any) -> dict[str, Any]:
        """Store the numbers of a dispatch for the next submission, and return their binding.

        If the uniform buffer is full, recorded dispatches are submitted first.
        """
        words = words_of(numbers)
        aligned = self.limits["min-uniform-buffer-offset-alignment"] // 4
        if self._number_count + len(words) > len(self._numbers):
            self.submit()
        begin = self._number_count
        self._numbers[begin : begin + len(words)] = words
        self._number_count = begin + -(-len(words) // aligned) * aligned
        return {"buffer": self._uniforms, "offset": 4 * begin, "size": words.nbytes}

    def _pipeline(self, shader: str, entry: str) -> tuple[Any, Any, dict[str, int]]:
        """Return a pipeline, its layout and its bindings by name; it is compiled on first use."""
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
    def _translate_errors(self) -> Iterator[None]:
        """Convert device errors to LodgsError; validation errors, which are bugs, stay unchanged."""
        try:
            yield
        except (RuntimeError, MemoryError, _wgpu().GPUError) as error:
            self._pass = self._encoder = None
            self._number_count = 0
            name = self.adapter.name
            message = str(error).lower()
            if "lost" not in message and (isinstance(error, MemoryError) or "memory" in message):
                raise LodgsError(
                    f"{name} is out of memory.",
                    "Close other programs that use it, choose fewer splats or smaller images, or resume "
                    "the run on the cpu.",
                ) from error
            if "lost" not in message and isinstance(error, _wgpu().GPUValidationError):
                raise
            self.lost = True
            raise LodgsError(
                f"{name} stopped responding: {_reason(error)}.",
                "Resume the run on this device or on the cpu; a newer driver may help.",
            ) from error

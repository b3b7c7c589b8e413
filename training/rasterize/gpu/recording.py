"""Dispatches that are prepared once and replayed many times.

A replay creates no buffer and no bind group. It writes the changed numbers, and calls wgpu-native directly,
because wgpu-py's checks of a call take longer than the call.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import cache
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np

Copy = tuple[Any, int, Any, int, int]
"""Copy of a buffer: source, its offset, target, its offset, and size in bytes."""
Pointers = tuple[Any, list[tuple[Any, int]], list[list[tuple[Any, Any, int]]]]
"""Numbers, cleared buffers with their sizes, and parts of a recording, as wgpu-native's pointers."""
FUNCTIONS = (
    "QueueWriteBuffer", "DeviceCreateCommandEncoder", "CommandEncoderCopyBufferToBuffer",
    "CommandEncoderClearBuffer", "CommandEncoderBeginComputePass", "ComputePassEncoderSetPipeline",
    "ComputePassEncoderSetBindGroup", "ComputePassEncoderDispatchWorkgroups", "ComputePassEncoderEnd",
    "CommandEncoderFinish", "QueueSubmit", "ComputePassEncoderRelease", "CommandBufferRelease",
    "CommandEncoderRelease",
)  # fmt: skip
"""Functions of wgpu-native that a replay calls."""


class Dispatch(NamedTuple):
    """A dispatch to prepare.

    Attributes:
        pipeline, layout: compute pipeline and layout of its bind group.
        bound: resources by binding.
        uniform: binding, first word and number of words of its numbers; None without recorded numbers.
        groups: number of workgroups.
    """

    pipeline: Any
    layout: Any
    bound: dict[int, dict[str, Any]]
    uniform: tuple[int, int, int] | None
    groups: int


class Recording:
    """Dispatches, the buffers to clear before them, and their numbers.

    Arrays among the numbers are read again before each replay, so their owner changes them in place.

    Args:
        alignment: words between the beginnings of two dispatches' numbers.
        shared: wgpu's buffers that recordings share, which are replayed one after another. New ones are
            added.

    Attributes:
        cleared: wgpu's buffers to clear, and their number of bytes.
        parts: pipelines, bind groups and numbers of workgroups, by submission.
        count: number of dispatches.
        uniforms: wgpu's buffer of all numbers.
        native: pointers of wgpu-native in the form of :data:`Pointers`, once they are needed.
    """

    def __init__(self, alignment: int, shared: list[Any]) -> None:
        self.cleared: list[tuple[Any, int]] = []
        self.parts: list[list[tuple[Any, Any, int]]] = []
        self.count = 0
        self.uniforms: Any = None
        self.native: Pointers | None = None
        self._alignment = alignment
        self._shared, self._free = shared, list(shared)
        self._dispatches: list[list[Dispatch]] = [[]]
        self._words: list[np.ndarray] = []
        self._size = 0
        self._arrays: list[tuple[int, np.ndarray]] = []
        self._numbers = np.zeros(0, np.uint32)

    def take_buffer(self, size: int, create: Callable[[int], Any]) -> Any:
        """Return the smallest shared buffer of at least ``size`` bytes that is not in use, or a new one."""
        fitting = [buffer for buffer in self._free if buffer.size >= size]
        if not fitting:
            self._shared.append(create(size))
            return self._shared[-1]
        smallest = min(fitting, key=lambda buffer: buffer.size)
        self._free.remove(smallest)
        return smallest

    def add(self, dispatch: Dispatch) -> None:
        """Append a dispatch."""
        self._dispatches[-1].append(dispatch)

    def divide(self) -> None:
        """Submit all later dispatches separately."""
        if self._dispatches[-1]:
            self._dispatches.append([])

    def add_numbers(self, numbers: tuple, words: np.ndarray) -> tuple[int, int]:
        """Append the numbers of a dispatch, given as words too; return their first word and their count."""
        begin = at = self._size
        for number in numbers:
            if isinstance(number, np.ndarray):
                self._arrays.append((at, number))
            at += np.size(number)
        self._size += -(-len(words) // self._alignment) * self._alignment
        self._words.append(np.pad(words, (0, self._size - begin - len(words))))
        return begin, len(words)

    def finish(self, create_uniforms: Callable[[int], Any], create_bind_group: Callable[..., Any]) -> None:
        """Create the buffer of all numbers, and the bind groups."""
        self._numbers = np.concatenate([*self._words, np.zeros(4, np.uint32)])
        self.uniforms = create_uniforms(self._numbers.nbytes)
        for dispatches in filter(None, self._dispatches):
            part = []
            for pipeline, layout, bound, uniform, groups in dispatches:
                if uniform is not None:
                    binding, begin, count = uniform
                    bound[binding] = {"buffer": self.uniforms, "offset": 4 * begin, "size": 4 * count}
                entries = [{"binding": at, "resource": resource} for at, resource in bound.items()]
                part.append((pipeline, create_bind_group(layout=layout, entries=entries), groups))
            self.parts.append(part)
            self.count += len(part)
        self._dispatches, self._words, self._free = [], [], []

    def replay(self, device: Any, copies: list[Copy]) -> None:
        """Submit the dispatches to wgpu's device, after copies of buffers."""
        (_native_replay() or _replay)(self, device, copies)

    def numbers(self) -> np.ndarray:
        """Return the current numbers of all dispatches."""
        for begin, array in self._arrays:
            self._numbers[begin : begin + array.size] = array.view(np.uint32)
        return self._numbers


def words_of(numbers: tuple) -> np.ndarray:
    """Convert numbers to the words of a uniform, padded to vectors of four."""
    parts = [_as_words(number) for number in numbers]
    count = sum(map(len, parts))
    words = np.zeros(-(-count // 4) * 4, np.uint32)
    np.concatenate(parts, out=words[:count])
    return words


def _as_words(number: Any) -> np.ndarray:
    array = np.atleast_1d(np.asarray(number)).reshape(-1)
    return array.astype(np.float32 if array.dtype.kind == "f" else np.uint32).view(np.uint32)


def encode(compute_pass: Any, dispatches: Iterable[tuple[Any, Any, int]]) -> None:
    """Encode prepared dispatches in a compute pass."""
    for pipeline, group, groups in dispatches:
        compute_pass.set_pipeline(pipeline)
        compute_pass.set_bind_group(0, group)
        compute_pass.dispatch_workgroups(groups)


def _replay(recording: Recording, device: Any, copies: list[Copy]) -> None:
    """Submit a recording through wgpu-py."""
    device.queue.write_buffer(recording.uniforms, 0, recording.numbers())
    encoder = device.create_command_encoder()
    for copy in copies:
        encoder.copy_buffer_to_buffer(*copy)
    for handle, size in recording.cleared:
        encoder.clear_buffer(handle, 0, size)
    for part in recording.parts:
        encoder = encoder or device.create_command_encoder()
        compute_pass = encoder.begin_compute_pass()
        encode(compute_pass, part)
        compute_pass.end()
        device.queue.submit([encoder.finish()])
        encoder = None


@cache
def _native_replay() -> Callable[[Recording, Any, list[Copy]], None] | None:
    """Return :func:`_replay` through wgpu-native's functions; None if wgpu-py hides them.

    wgpu-py raises an exception for errors that wgpu-native reports during the call.
    """
    try:
        wgpu = import_module("wgpu.backends.wgpu_native._api")
        lib, null, new, from_buffer = wgpu.lib, wgpu.ffi.NULL, wgpu.ffi.new, wgpu.ffi.from_buffer
        functions = [getattr(lib, f"wgpu{name}") for name in FUNCTIONS]
        raise_errors = wgpu.libf._make_proxy_func
    except (ImportError, AttributeError):
        return None
    (
        write, create_encoder, copy_buffer, clear, begin, set_pipeline, set_group, dispatch, end, finish,
        submit, release_pass, release_commands, release_encoder,
    ) = functions  # fmt: skip

    def pointers(recording: Recording) -> Pointers:
        return (
            recording.uniforms._internal,
            [(buffer._internal, size) for buffer, size in recording.cleared],
            [
                [(pipeline._internal, group._internal, n) for pipeline, group, n in part]
                for part in recording.parts
            ],
        )

    def replay(recording: Recording, device: Any, copies: list[Copy]) -> None:
        uniforms, cleared, parts = recording.native = recording.native or pointers(recording)
        queue, numbers = device.queue._internal, recording.numbers()
        commands = new("WGPUCommandBuffer[1]")
        write(queue, uniforms, 0, from_buffer(numbers), numbers.nbytes)
        encoder = create_encoder(device._internal, null)
        for source, source_offset, target, offset, size in copies:
            copy_buffer(encoder, source._internal, source_offset, target._internal, offset, size)
        for handle, size in cleared:
            clear(encoder, handle, 0, size)
        for part in parts:
            encoder = encoder or create_encoder(device._internal, null)
            compute_pass = begin(encoder, null)
            for pipeline, group, groups in part:
                set_pipeline(compute_pass, pipeline)
                set_group(compute_pass, 0, group, 0, null)
                dispatch(compute_pass, groups, 1, 1)
            end(compute_pass)
            release_pass(compute_pass)
            commands[0] = finish(encoder, null)
            submit(queue, 1, commands)
            release_commands(commands[0])
            release_encoder(encoder)
            encoder = None

    return raise_errors("replay", replay)

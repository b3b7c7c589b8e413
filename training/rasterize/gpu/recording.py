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

    Attributes:
        cleared: wgpu's buffers to clear.
        parts: pipelines, bind groups and numbers of workgroups, by submission.
        uniforms: wgpu's buffer of all numbers.
    """

    def __init__(self, alignment: int) -> None:
        self.cleared: list[Any] = []
        self.parts: list[list[tuple[Any, Any, int]]] = []
        self.uniforms: Any = None
        self._alignment = alignment
        self._dispatches: list[list[Dispatch]] = [[]]
        self._words: list[np.ndarray] = []
        self._size = 0
        self._arrays: list[tuple[int, np.ndarray]] = []
        self._numbers = np.zeros(0, np.uint32)

    def __len__(self) -> int:
        return sum(map(len, self.parts))

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
        self._dispatches, self._words = [], []

    def numbers(self) -> np.ndarray:
        """Return the current numbers of all dispatches."""
        for begin, array in self._arrays:
            self._numbers[begin : begin + array.size] = array.view(np.uint32)
        return self._numbers


def encode(compute_pass: Any, dispatches: Iterable[tuple[Any, Any, int]]) -> None:
    """Encode prepared dispatches in a compute pass."""
    native = _native()
    if native is None:
        for pipeline, group, groups in dispatches:
            compute_pass.set_pipeline(pipeline)
            compute_pass.set_bind_group(0, group)
            compute_pass.dispatch_workgroups(groups)
        return
    set_pipeline, set_bind_group, dispatch, null = native
    handle = compute_pass._internal
    for pipeline, group, groups in dispatches:
        set_pipeline(handle, pipeline._internal)
        set_bind_group(handle, 0, group._internal, 0, null)
        dispatch(handle, groups, 1, 1)


@cache
def _native() -> tuple | None:
    """Return wgpu-native's functions of a compute pass and a null pointer; None if wgpu-py hides them."""
    try:
        module = import_module("wgpu.backends.wgpu_native._ffi")
        names = "SetPipeline", "SetBindGroup", "DispatchWorkgroups"
        functions = [getattr(module.lib, f"wgpuComputePassEncoder{name}") for name in names]
        return *functions, module.ffi.NULL
    except (ImportError, AttributeError):
        return None

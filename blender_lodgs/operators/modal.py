"""Operators that work in steps: Blender stays responsive between two steps, and Esc stops the work."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from typing import Any

import bpy

from .base import report_errors


class SteppedOperator:
    """Base class of operators that work in steps.

    A script waits for all steps. In a window :meth:`start_modal` runs them while Blender stays responsive.
    """

    _steps: Iterator[object] | None = None

    def work(self, context: bpy.types.Context) -> Iterator[object]:
        """Do one step after the other and yield after each. Closing the iterator early cleans up.

        Raises:
            LodgsError: a step fails.
        """
        raise NotImplementedError

    def result_text(self, count: int) -> str:
        """Return the operator's report after ``count`` steps."""
        raise NotImplementedError

    def status_text(self, context: bpy.types.Context, count: int) -> str:
        """Return the status bar's text after ``count`` steps, while more follow."""
        raise NotImplementedError

    def has_changed_data(self) -> bool:
        """Return True if the steps so far changed Blender's data, which needs an undo step if they stop."""
        return False

    def step_count(self, context: bpy.types.Context) -> int:
        """Return the number of steps, or 1 if it is unknown."""
        return 1

    @report_errors
    def execute(self, context):
        self.report({"INFO"}, self.result_text(sum(1 for _ in self.work(context))))
        return {"FINISHED"}

    def start_modal(self, context):
        """Run the steps from a timer and return the result of ``invoke``."""
        manager = context.window_manager
        self._steps = self.work(context)
        self._count = 0
        self._timer = manager.event_timer_add(0.01, window=context.window)
        manager.modal_handler_add(self)
        manager.progress_begin(0, self.step_count(context))
        return {"RUNNING_MODAL"}

    def cancel(self, context):
        """Stop when Blender closes the window, loads another file or quits; also called by a File Browser."""
        if self._steps is not None:
            self._finish(context, {"CANCELLED"}, "")

    def modal(self, context, event):
        try:
            if event.type == "ESC":
                return self._finish(context, {"CANCELLED"}, f"Stopped. {self.result_text(self._count)}")
            return self._advance(context) if event.type == "TIMER" else {"RUNNING_MODAL"}
        except Exception:
            self._finish(context, {"CANCELLED"}, "")
            raise

    def _advance(self, context):
        result = self._do_step(context)
        if result == {"RUNNING_MODAL"}:
            self._count += 1
            context.window_manager.progress_update(min(self._count, self.step_count(context)))
            context.workspace.status_text_set(self.status_text(context, self._count))
            return result
        message = self.result_text(self._count) if result == {"FINISHED"} else ""
        return self._finish(context, result, message)

    @report_errors
    def _do_step(self, context):
        return {"FINISHED"} if next(self._steps, StopIteration) is StopIteration else {"RUNNING_MODAL"}

    def _finish(self, context, result: set[str], message: str) -> set[str]:
        self._steps.close()
        context.window_manager.event_timer_remove(self._timer)
        context.window_manager.progress_end()
        context.workspace.status_text_set(None)
        if message:
            self.report({"INFO"}, message)
        return {"FINISHED"} if self.has_changed_data() else result


class WaitingOperator(SteppedOperator):
    """Base class of operators that wait for a thread and need none of Blender's data meanwhile.

    In a window the user continues to work; a script waits.
    """

    _is_waiting = False

    @classmethod
    def poll(cls, context):
        if cls._is_waiting:
            cls.poll_message_set("Already running")
            return False
        return super().poll(context)

    def invoke(self, context, event):
        return self.execute(context) if bpy.app.background else self.start_modal(context)

    def start_modal(self, context):
        result = super().start_modal(context)
        type(self)._is_waiting = True
        return result

    def modal(self, context, event):
        result = super().modal(context, event)
        return {"PASS_THROUGH"} if result == {"RUNNING_MODAL"} else result

    def _finish(self, context, result, message):
        type(self)._is_waiting = False
        return super()._finish(context, result, message)


def wait_for(task: Callable[[], Any]) -> Generator[None, None, Any]:
    """Run a task in a thread, yield until it ends, and return its result.

    The task continues if the generator is closed earlier.
    """
    worker = ThreadPoolExecutor(1, "lodgs-wait")
    try:
        result = worker.submit(task)
        while wait([result], 0.01).not_done:
            yield
    finally:
        worker.shutdown(wait=False)
    return result.result()


class BackgroundOperator(SteppedOperator):
    """Base class of operators that wait for a thread or another program.

    In a window Blender stays responsive after a file is chosen or dropped; a script waits.
    """

    def execute(self, context):
        interactive = self.options.is_invoke and not self.options.is_repeat
        self._modal = interactive and not bpy.app.background and context.window is not None
        return self.start_modal(context) if self._modal else super().execute(context)


class FrameOperator(SteppedOperator):
    """Base class of operators that render frames: the current one, or with ``animation`` the frame range."""

    animation: bpy.props.BoolProperty(options={"HIDDEN", "SKIP_SAVE"})

    def frames(self, context: bpy.types.Context) -> range:
        """Return the current frame, or all frames of the scene's range."""
        scene = context.scene
        if self.animation:
            return range(scene.frame_start, scene.frame_end + 1, scene.frame_step)
        return range(scene.frame_current, scene.frame_current + 1)

    def step_count(self, context):
        return len(self.frames(context))

    def status_text(self, context, count):
        return f"Frame {count} of {self.step_count(context)}, Esc to stop"

    def invoke(self, context, event):
        if not self.animation or bpy.app.background:
            return self.execute(context)
        return self.start_modal(context)

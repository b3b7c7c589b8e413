"""Operators that work piece by piece: in a window Blender goes on between two, and Escape stops them."""

from __future__ import annotations

from collections.abc import Iterator

import bpy

from .parts import report_errors


class PieceByPiece:
    """What such an operator inherits: a script waits for all pieces, and a window may :meth:`begin` them."""

    def work(self, context: bpy.types.Context) -> Iterator[object]:
        """Does one piece after the other and yields after each; closed early, it leaves things tidy.

        Raises:
            LodgsError: a piece is not possible.
        """
        raise NotImplementedError

    def done(self, count: int) -> str:
        """The report after so many pieces."""
        raise NotImplementedError

    def status(self, context: bpy.types.Context, count: int) -> str:
        """What is told after so many pieces, while there are more."""
        raise NotImplementedError

    def pieces(self, context: bpy.types.Context) -> int:
        """How many there are; 1 where that is not known."""
        return 1

    @report_errors
    def execute(self, context):
        self.report({"INFO"}, self.done(sum(1 for _ in self.work(context))))
        return {"FINISHED"}

    def begin(self, context):
        """Has the pieces done while Blender goes on; what ``invoke`` returns."""
        manager = context.window_manager
        self._work, self._done = self.work(context), 0
        self._timer = manager.event_timer_add(0.01, window=context.window)
        manager.modal_handler_add(self)
        manager.progress_begin(0, self.pieces(context))
        return {"RUNNING_MODAL"}

    def modal(self, context, event):
        try:
            if event.type == "ESC":
                return self._finish(context, {"CANCELLED"}, f"Stopped. {self.done(self._done)}")
            return self._next(context) if event.type == "TIMER" else {"RUNNING_MODAL"}
        except Exception:
            self._finish(context, {"CANCELLED"}, "")
            raise

    def _next(self, context):
        result = self._one(context)
        if result == {"RUNNING_MODAL"}:
            self._done += 1
            context.window_manager.progress_update(min(self._done, self.pieces(context)))
            context.workspace.status_text_set(self.status(context, self._done))
            return result
        message = self.done(self._done) if result == {"FINISHED"} else ""
        return self._finish(context, result, message)

    @report_errors
    def _one(self, context):
        return {"FINISHED"} if next(self._work, StopIteration) is StopIteration else {"RUNNING_MODAL"}

    def _finish(self, context, result: set[str], message: str) -> set[str]:
        self._work.close()
        context.window_manager.event_timer_remove(self._timer)
        context.window_manager.progress_end()
        context.workspace.status_text_set(None)
        if message:
            self.report({"INFO"}, message)
        return result


class BesideBlender(PieceByPiece):
    """Such an operator whose work is somebody else's, a thread's or a program's, to be waited for: in a
    window Blender goes on, once a file has been chosen or dropped; a script waits."""

    def execute(self, context):
        pressed = self.options.is_invoke and not self.options.is_repeat
        self._beside = pressed and not bpy.app.background and context.window is not None
        return self.begin(context) if self._beside else super().execute(context)


class FrameByFrame(PieceByPiece):
    """What an operator inherits that draws frames; ``animation`` says whether there is more than one."""

    animation: bpy.props.BoolProperty(options={"HIDDEN", "SKIP_SAVE"})

    def frames(self, context: bpy.types.Context) -> range:
        """The frame that is shown, or all of the scene's range."""
        scene = context.scene
        if self.animation:
            return range(scene.frame_start, scene.frame_end + 1, scene.frame_step)
        return range(scene.frame_current, scene.frame_current + 1)

    def pieces(self, context):
        return len(self.frames(context))

    def status(self, context, count):
        return f"Frame {count} of {self.pieces(context)}; Esc stops"

    def invoke(self, context, event):
        if not self.animation or bpy.app.background:
            return self.execute(context)
        return self.begin(context)

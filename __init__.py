# SPDX-License-Identifier: GPL-3.0-or-later
"""The extension's front door: Blender calls these two; everything else lives in ``blender_lodgs``.

The imports wait for the calls, so that tools that import this folder (pytest does) need no Blender.
"""


def register() -> None:
    from . import blender_lodgs

    blender_lodgs.register()


def unregister() -> None:
    from . import blender_lodgs

    blender_lodgs.unregister()

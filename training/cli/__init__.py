"""Commands of the trainer, one module each: its arguments (``add_arguments``) and its work (``run``)."""

from __future__ import annotations

PROGRAM = "lodgs" if (__package__ or "").startswith("lodgs") else "python -m training"
"""Program name in help texts and messages."""

COMMANDS = {
    "train": "train splats from photos, or resume the run that the same command started",
    "blocks": "train a scene that is too large for one run, in cells",
    "methods": "list the methods, or the parameters of one",
    "evaluate": "measure a finished run on its held-out views and on views offset from the photos",
    "compare": "compare methods, or runs of one scene, on one page",
    "reproduce": "measure the tables of a paper on scenes, beside the published values",
    "render": "render one view as a PNG, or as an EXR with depth and levels",
    "capture": "render views of splats that have no photos, as a COLMAP scene to train from",
    "scene": "make a COLMAP scene from photos, or from another program's export",
    "undistort": "remove a scene's lens distortion once, for all runs and for Blender",
    "model": "write the COLMAP model of a folder of views that Blender captured",
    "serve": "render frames for Blender",
    "edit": "write a copy that is cleaned up, recoloured, or turned, scaled and moved",
    "page": "write a page that shows levels in a browser",
    "compress": "write a copy of a run or bundle that is a tenth of its size or smaller",
    "info": "describe a run, a bundle or any 3DGS PLY",
    "check": "print as JSON whether this Python can train",
    "devices": "list the devices that this computer can train on, and test them",
}
"""Help text of each command. A command is the module of the same name."""

"""Rendering of splats: one view to a file (``render``), or frame after frame for another program
(``serve``)."""

"""Pictures of splats: one view as a file (``render``), or frame after frame (``serve``)."""

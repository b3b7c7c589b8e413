"""Pictures of splats for eyes: one view as a file (``render``), or frame after frame (``serve``)."""

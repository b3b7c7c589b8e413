"""Programs that run outside Blender: the trainer, its environment, captures and photo preparation."""

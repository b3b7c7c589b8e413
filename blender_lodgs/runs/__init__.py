"""Programs that run beside Blender: the trainer, its environment, captures and photo preparation."""

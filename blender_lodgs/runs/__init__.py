"""What works beside Blender: the trainer's Python, its runs, and how Blender looks after them."""

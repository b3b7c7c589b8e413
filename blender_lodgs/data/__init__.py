"""What a .blend file holds of splat scenes: settings, levels, cameras, and which splats are shown."""

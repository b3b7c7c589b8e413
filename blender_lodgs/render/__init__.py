"""What LODGS draws into pictures: the engine, its renderer beside Blender, and what goes with renders."""

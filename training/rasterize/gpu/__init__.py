"""The rasterizer on any graphics card: compute shaders in WGSL, through wgpu."""

"""Rendering with LODGS: render engine, renderer process, compositing, captures and comparison with photos."""

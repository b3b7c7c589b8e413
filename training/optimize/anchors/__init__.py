"""Anchors in an octree (Octree-GS, Ren et al. 2024), explicit or neural."""

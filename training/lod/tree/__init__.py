"""Trees of splats: their shape, trees in pieces, and trees paged from disk."""

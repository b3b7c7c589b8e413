"""Editing of splats: clean-up, brush and lasso, looks, paint, placement, and baking of filters for export."""

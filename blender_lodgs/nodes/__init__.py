"""Geometry node groups built in code: display, clean-up, looks and level-of-detail rules."""

"""Level of detail: which splats an eye sees, as a weight in [0, 1] on the opacity of each."""

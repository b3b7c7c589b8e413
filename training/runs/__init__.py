"""Training runs: jobs, run folders, events, checkpoints and the training loop."""

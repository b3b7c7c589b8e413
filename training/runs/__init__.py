"""A run: its job, its folder, what it says, and the loop that trains it."""

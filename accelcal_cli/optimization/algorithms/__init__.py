"""The optimizers, one a file, found by name."""

"""The optimizers, one per file, found by name."""

"""The optimizers: one algorithm a file, and the one loop that runs them."""

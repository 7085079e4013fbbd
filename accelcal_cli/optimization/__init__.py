"""Optimization: problems, optimizers and the one loop that runs them."""

"""Measurements of speed beside other tools; run them with `python -m benchmarks.<name>`."""

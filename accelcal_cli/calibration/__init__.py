"""The calibration: the Loetters problem, the pipeline, quality, planner and result."""

"""The grey wolf optimizer for accelcal."""

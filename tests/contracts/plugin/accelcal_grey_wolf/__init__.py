"""The grey wolf optimizer and a text format for accelcal."""

"""accelcal: calibrate three-axis accelerometers without a turntable."""

__version__ = "0.1.0"

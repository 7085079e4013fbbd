"""Detection: static poses out of raw logs and live streams."""

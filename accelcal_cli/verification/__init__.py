"""Verification: an old result against new readings of the sensor."""

"""Verification: an old result against new readings."""

"""The navigation filters, one a file, found by name."""

"""Planning: which poses to take next."""

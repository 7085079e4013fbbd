"""Results in the formats that other tools read, one format per file."""

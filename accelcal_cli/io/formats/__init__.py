"""Native logs of loggers, vehicles and robots: one format a file, found by content, read in constant memory."""

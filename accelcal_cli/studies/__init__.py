"""Studies: optimizers on test functions and on calibrations, in many runs, repeatable to the last bit."""

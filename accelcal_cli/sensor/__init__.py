"""The sensor: error model, units, gravity, poses, readings and simulation."""

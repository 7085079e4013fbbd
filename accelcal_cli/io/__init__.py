"""Readings and logs: from files, streams and serial ports into arrays, and logs written anew."""

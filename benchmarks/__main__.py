"""Run every benchmark."""

from benchmarks import compression, csv_speed, startup

startup.main()
compression.main()
csv_speed.main()

"""Run every benchmark."""

from benchmarks import apply_speed, compression, csv_speed, startup

startup.main()
compression.main()
csv_speed.main()
apply_speed.main()

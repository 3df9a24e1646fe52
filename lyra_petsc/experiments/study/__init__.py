"""Error against run time: combinations of settings, each run, timed and compared with a reference."""

"""One file per case, each holding ``CASE``; the registry lists them by name."""

"""A run in the browser: a local page that plays it, and follows it while it goes on."""

"""A run in the browser: a local page that plays it and follows it while it goes on.

In: a run's folder. Out: a page at an address of this machine. `server` serves it, `live` starts it beside a
run.
"""

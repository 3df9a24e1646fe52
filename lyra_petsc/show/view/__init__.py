"""A run in the browser: a local page that plays the states and shows new ones while the run continues.

In: a run's folder. Out: a page at an address of this machine. `server` serves the page, `live` starts it
together with a run.
"""

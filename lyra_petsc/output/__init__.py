"""States, checkpoints, XDMF, history, summary, diagnostics."""

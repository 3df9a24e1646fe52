"""Block sparsity from the stencils of the active terms, and scatter of element blocks."""

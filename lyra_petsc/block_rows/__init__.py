"""Kernels on rows of 3×3 blocks: sums of element blocks, products, sweeps of Gauss-Seidel."""

"""Compiled element kernels: how they are compiled and cached, and SIMD operations on 3×3 blocks."""

"""Shared by kernels on the CPU: compilation, SIMD types, threads, and cameras."""

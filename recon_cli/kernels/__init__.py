"""What kernels on the CPU share: how they are compiled, SIMD types, threads, and cameras."""

"""The numba backend: vector kernels for any CPU, compiled once on the machine that runs them."""

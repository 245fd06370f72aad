"""The triton backend: kernels for GPUs that come with torch and need no CUDA toolkit."""

"""Hand-written kernels for the CPU and CUDA, and compilation of steps."""

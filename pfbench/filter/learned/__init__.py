"""Proposals and kernels with neural networks."""

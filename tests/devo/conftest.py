"""Fixtures of these tests only: the CUDA kernels, on a GPU or emulated."""

from tests.devo.cuda_backends import emulated_libraries, emulated_modules, kernels

__all__ = ["emulated_libraries", "emulated_modules", "kernels"]

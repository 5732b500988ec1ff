"""Thin command lines over `utils` and `evals`."""

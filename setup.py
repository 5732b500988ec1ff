"""Build script: a pure Python package by default.

The CUDA kernels of `devo.altcorr` and `devo.fastba` will be added to `ext_modules` here when the environment
asks for them; every operation has a torch twin, so nothing is missing without them.
"""

from setuptools import setup

setup()

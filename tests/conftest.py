"""Shared test set-up: the variant is set once, before any test module that imports kernels."""

from mgs import runtime

runtime.start()

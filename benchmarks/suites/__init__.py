"""Suites: matrices of cells, their captures, and the engine that runs them."""

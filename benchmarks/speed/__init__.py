"""Ratios of speed from one run."""

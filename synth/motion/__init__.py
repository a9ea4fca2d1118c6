"""Motions: generated and imported."""

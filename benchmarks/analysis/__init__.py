"""Scores, statistics and what follows from them."""

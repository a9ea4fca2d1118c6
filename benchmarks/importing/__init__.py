"""Captures without truth, made from the footage of users."""

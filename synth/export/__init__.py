"""Exports of a finished capture: not part of its hash."""

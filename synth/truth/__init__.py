"""Truth that is derived from a capture or rendered on demand: not part of its hash."""

"""A trained avatar in files that other programs read."""

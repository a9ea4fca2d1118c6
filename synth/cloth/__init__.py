"""How cloth moves."""

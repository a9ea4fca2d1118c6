"""How the template is learned, once per capture."""

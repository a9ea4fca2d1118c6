"""Trained avatars in motion: played in the browser, filmed, exported, shared."""

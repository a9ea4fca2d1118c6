"""Studies of one method: conformance checks, and evaluation on a foreign motion."""

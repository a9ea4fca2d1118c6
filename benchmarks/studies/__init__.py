"""Studies of one method: conformance, search, display, retargeting."""

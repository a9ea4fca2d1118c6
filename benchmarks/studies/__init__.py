"""Studies of one method: conformance, display, retargeting."""

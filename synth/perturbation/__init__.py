"""Captures with a known defect: not part of the hash of the capture that they start from."""

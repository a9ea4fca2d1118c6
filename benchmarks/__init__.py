"""The harness: trains methods on captures, measures them, and writes the reports."""

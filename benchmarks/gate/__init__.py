"""The gate: rules, planted defects, error rates."""

"""The gate: is a change worse or slower than a committed baseline? Exact comparisons first, statistics after."""

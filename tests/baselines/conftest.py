"""What tests of baselines share."""

from helpers.tube import capture  # noqa: F401  (a fixture)

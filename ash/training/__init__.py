"""Training: batches, losses, the optimiser and the loop."""

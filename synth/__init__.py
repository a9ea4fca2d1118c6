"""Ground truth: synthetic humans whose body, cloth, motion, light and cameras are known exactly."""

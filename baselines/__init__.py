"""What ASH is compared with: a DDC-style mesh avatar and the ablations' alternatives."""

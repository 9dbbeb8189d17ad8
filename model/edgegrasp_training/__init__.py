"""Data generation and training of edge-grasp networks."""

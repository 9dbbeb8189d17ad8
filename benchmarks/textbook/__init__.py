"""A straightforward implementation of the paper, to measure ours beside: formulas as printed."""

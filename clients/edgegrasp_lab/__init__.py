"""Commands of the laboratory: benchmarks, training data and training."""

"""What the way back through a fit costs: ``python -m benchmarks.gradients``."""

"""What precision costs and buys: ``python -m benchmarks.precision``."""

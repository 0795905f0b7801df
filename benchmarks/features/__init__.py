"""What features and scores cost: ``python -m benchmarks.features``."""

"""What a stream costs: ``python -m benchmarks.streaming``."""

"""What many bins cost: ``python -m benchmarks.throughput``."""

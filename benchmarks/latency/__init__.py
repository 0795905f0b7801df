"""What one bin costs: ``python -m benchmarks.latency``."""

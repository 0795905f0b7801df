"""What a deployed detector costs: ``python -m benchmarks.deployment``."""

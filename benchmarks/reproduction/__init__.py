"""Published numbers beside ours: ``python -m benchmarks.reproduction``."""

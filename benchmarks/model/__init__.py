"""What the kernel machine costs at any size: ``python -m benchmarks.model``."""

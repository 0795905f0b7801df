"""What each rung of the simulated hand costs and buys: ``python -m benchmarks.simulation``."""

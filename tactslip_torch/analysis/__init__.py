"""What a detector needs, costs and loses: sensors, latency, precision."""

"""A new material in closed form: recordings in, out and back again, without forgetting the old."""

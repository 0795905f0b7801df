"""What describes a bin: descriptors, the pool of features, and which to keep."""

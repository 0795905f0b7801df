"""What describes a bin: the 17 descriptors, the pool of 2582 features, and which to keep."""

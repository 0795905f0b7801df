"""The eager engine: a plan of features carried out by calls of PyTorch and NumPy."""

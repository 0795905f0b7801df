"""The compiled engine: a plan of features carried out by kernels that numba compiles."""

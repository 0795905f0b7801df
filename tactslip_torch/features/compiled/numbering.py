"""Each descriptor's number: its place among a row's values.

The numbers are compiled into kernels that are kept until a source here changes, so they may not
follow from a list elsewhere.
"""

DESCRIPTORS = (
    "mean",
    "median",
    "mode",
    "range",
    "mean_deviation",
    "std",
    "cv",
    "iqr",
    "skewness",
    "kurtosis",
    "energy",
    "entropy",
    "peak_factor",
    "correlation",
    "spectral_centroid",
    "spectral_spread",
)
MEAN = DESCRIPTORS.index("mean")
MEDIAN = DESCRIPTORS.index("median")
MODE = DESCRIPTORS.index("mode")
RANGE = DESCRIPTORS.index("range")
MEAN_DEVIATION = DESCRIPTORS.index("mean_deviation")
STD = DESCRIPTORS.index("std")
CV = DESCRIPTORS.index("cv")
IQR = DESCRIPTORS.index("iqr")
SKEWNESS = DESCRIPTORS.index("skewness")
KURTOSIS = DESCRIPTORS.index("kurtosis")
ENERGY = DESCRIPTORS.index("energy")
ENTROPY = DESCRIPTORS.index("entropy")
PEAK_FACTOR = DESCRIPTORS.index("peak_factor")
CORRELATION = DESCRIPTORS.index("correlation")
CENTROID = DESCRIPTORS.index("spectral_centroid")
SPREAD = DESCRIPTORS.index("spectral_spread")

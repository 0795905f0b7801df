"""Pooling over channels in plain NumPy, one bin and one descriptor at a time."""

import numpy as np


def pooled(values: np.ndarray, in_use: np.ndarray, knee: float, statistic: str) -> float:
    """A statistic of the compressed values ``[m]`` of the channels in use."""
    x = values[in_use]
    y = knee * np.sign(x) * np.log(1 + np.abs(x) / knee)
    if statistic == "mean":
        return float(np.mean(y))
    if statistic == "std":
        return float(np.std(y, ddof=1)) if len(y) > 1 else 0.0
    if statistic.startswith("rank"):
        fraction = (int(statistic[4:]) - 1) / (len(values) - 1)
    else:
        fraction = {"min": 0.0, "median": 0.5, "max": 1.0}[statistic]
    return float(np.quantile(y, fraction))

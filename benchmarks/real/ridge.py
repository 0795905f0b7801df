"""Ridge regression to +-1 under many penalties, for the price of about one."""

from __future__ import annotations

import numpy as np
from scipy.linalg import eigh

from benchmarks.real.windows import Array


def ridge_scores(rows: Array, is_slip: Array, others: Array, alphas: Array) -> Array:
    """Fitted to standardised rows with balanced classes, the scores of others.

    As scikit-learn's ``RidgeClassifier`` after ``StandardScaler``, but there are fewer windows than
    features, so one eigendecomposition of their inner products does for all penalties.

    Args:
        rows: ``[n, F]``.
        is_slip: ``[n]``, bool, of both classes.
        others: ``[m, F]``.
        alphas: ``[A]``, positive; the intercept has no penalty.

    Shape:
        - output: ``[A, m]``, float64; at least 0 means slip
    """
    from sklearn.preprocessing import StandardScaler

    scaler = StandardScaler().fit(rows)
    rows, others = scaler.transform(rows), scaler.transform(others)
    target, number = np.where(is_slip, 1.0, -1.0), len(is_slip)
    weight = balanced_weights(is_slip).astype(rows.dtype)
    middle, root = weight @ rows / number, np.sqrt(weight)
    rows = (rows - middle) * root[:, None]
    values, vectors = eigh((rows @ rows.T).astype(np.float64), driver="evd")
    wanted = vectors.T @ (root * target)  # balanced: the weighted mean of targets is 0
    known = (others - middle) @ rows.T @ vectors
    return np.stack([known @ (wanted / (values.clip(0) + alpha)) for alpha in alphas])


def balanced_weights(is_slip: Array) -> Array:
    """Weights ``[n]`` with which both classes count alike, their mean 1."""
    number = len(is_slip)
    return np.where(is_slip, number / is_slip.sum(), number / (~is_slip).sum()) / 2

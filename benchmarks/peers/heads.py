"""Heads of scikit-learn on scaled features, with the paper's kernel."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.kernel_ridge import KernelRidge
from sklearn.svm import SVC

Array = NDArray[np.float64]


def svc(z: Array, targets: Array, offset: float) -> Any:
    """A support vector machine; its ``decision_function`` is the score.

    Args:
        z: scaled features ``[N, K]``.
        targets: ``[N]``, +-1.
        offset: the paper's ``c``.
    """
    return SVC(kernel="poly", degree=2, gamma=1.0, coef0=offset).fit(z, targets)


def kernel_ridge(z: Array, targets: Array, offset: float, penalty: float) -> Any:
    """The paper's machine in the dual; ``predict`` is the score.

    Args:
        z: scaled features ``[N, K]``.
        targets: ``[N]``, +-1.
        offset: the paper's ``c``.
        penalty: the paper's ``C``.
    """
    ridge = KernelRidge(alpha=1 / penalty, kernel="poly", degree=2, gamma=1.0, coef0=offset)
    return ridge.fit(z, targets)

"""Classifiers by scikit-learn, fitted to sampled bins; decisions of linear ones are torch's.

Both classes count alike, and each sampled bin stands for ``represents`` bins.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tactslip_torch.features.bin_sample import SampledBins
from tactslip_torch.recipe import recalls_mean, sample_groups

NUM_TREES = 200
MOST_FOLDS = 6  # with 3, C of simple statistics costs two points on held-out materials
PENALTIES = (1e-3, 1e-2, 1e-1, 1.0)
"""scikit-learn's ``C`` of logistic regression, chosen by leaving groups out, strongest first."""
WIDE, WIDE_PENALTY = 256, 1e-2
"""With more columns than this, choosing would take longer than the detector's own validation: ``C``
is fixed. On 672 pooled columns of the simulated hand 1e-3 to 1 differ by .3 points."""
LOG_FLOOR = 1e-2  # of the training median of a magnitude, below which its logarithm levels out


@dataclass(frozen=True)
class LogisticRegression:
    """A linear decision, ``weights @ x + constant >= 0``.

    Shape:
        - weights: ``[K]``, float64
    """

    weights: Tensor
    constant: float
    penalty: float

    @classmethod
    def fit(cls, columns: Tensor, sample: SampledBins) -> LogisticRegression:
        """Fit standardised columns, with ``C`` chosen by leaving groups out unless they are many.

        Shape:
            - columns: ``[n, K]``, of the sampled bins

        Raises:
            ValueError: if a class is absent.
        """
        from sklearn.linear_model import LogisticRegression as Regression
        from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]  # sklearn's own

        x, is_wide = columns.double(), columns.shape[1] > WIDE
        sd, centre = torch.std_mean(x, 0, correction=0)
        scale = torch.where(sd > 0, sd, 1.0)
        z = (x - centre) / scale
        solver = "lbfgs" if is_wide else "newton-cholesky"

        def fitted(rows: Tensor, penalty: float) -> tuple[Tensor, float]:
            made = Regression(C=penalty, class_weight="balanced", max_iter=2000, solver=solver)
            weights = sample.represents[rows]
            with warnings.catch_warnings(), threadpool_limits(1):  # small: threads would wait
                warnings.simplefilter("ignore")  # newton-cholesky falls back to lbfgs by itself
                made.fit(z[rows].numpy(), sample.is_slip[rows].numpy(), weights.numpy())
            return torch.from_numpy(made.coef_[0]), float(made.intercept_[0])

        check_classes(sample.is_slip)
        everything = torch.ones(len(z), dtype=torch.bool)
        groups, names = sample_groups(sample)
        num_folds = min(len(names), MOST_FOLDS)
        folds = [groups % num_folds == fold for fold in range(num_folds)]
        folds = [out for out in folds if _has_both(sample.is_slip[~out])]
        penalty = WIDE_PENALTY
        if not is_wide and len(names) > 1 and folds:
            found = {}
            for candidate in PENALTIES:
                right = []
                for out in folds:
                    weights, constant = fitted(~out, candidate)
                    says_slip = z[out] @ weights + constant >= 0
                    right.append(recalls_mean(says_slip, sample.is_slip[out]))
                known = [value for value in right if value is not None]
                found[candidate] = sum(known) / max(len(known), 1)
            penalty = max(found, key=found.__getitem__)  # the strongest of equals
        weights, constant = fitted(everything, penalty)
        return cls(weights / scale, constant - float(weights @ (centre / scale)), penalty)

    def __call__(self, columns: Tensor) -> Tensor:
        """Decisions, ``[N, K] -> [N]``, bool."""
        return columns.double() @ self.weights + self.constant >= 0

    def metadata(self) -> dict[str, Any]:
        """What was chosen, JSON-able."""
        return {"C": self.penalty}


class SimpleLogisticRegression:
    """``LogisticRegression`` on simple statistics and the logarithms of their magnitudes.

    Amplitudes range over decades, so logarithms are worth seven points on the simulated hand.
    """

    def __init__(self, statistics: Tensor, sample: SampledBins) -> None:
        floor = LOG_FLOOR * statistics.abs().median(0).values
        self._floor = torch.where(floor > 0, floor, 1.0)
        self.regression = LogisticRegression.fit(self._with_logs(statistics), sample)

    def __call__(self, statistics: Tensor) -> Tensor:
        """Decisions, ``[N, 3 C] -> [N]``, bool."""
        return self.regression(self._with_logs(statistics))

    def metadata(self) -> dict[str, Any]:
        """As ``LogisticRegression.metadata``."""
        return self.regression.metadata()

    def _with_logs(self, statistics: Tensor) -> Tensor:
        return torch.cat([statistics, (statistics.abs() + self._floor).log()], 1)


class RandomForest:
    """scikit-learn's random forest.

    Shape:
        - columns: ``[n, K]``, of the sampled bins

    Raises:
        ValueError: if a class is absent.
    """

    def __init__(self, columns: Tensor, sample: SampledBins) -> None:
        from sklearn.ensemble import RandomForestClassifier

        check_classes(sample.is_slip)
        made = RandomForestClassifier(
            NUM_TREES, class_weight="balanced", random_state=0, n_jobs=2, max_features="sqrt"
        )
        truth, weights = sample.is_slip.numpy(), sample.represents.numpy()
        made.fit(_single(columns), truth, sample_weight=weights)
        self._trees = [tree.tree_ for tree in made.estimators_]

    def __call__(self, columns: Tensor) -> Tensor:
        """Decisions by the mean of the trees' probabilities, ``[N, K] -> [N]``, bool."""
        x = _single(columns)
        slip = sum(tree.predict(x).reshape(len(x), 2)[:, 1] for tree in self._trees)
        return torch.from_numpy(np.asarray(slip) > len(self._trees) / 2)

    def metadata(self) -> dict[str, Any]:
        """Its size, JSON-able."""
        return {"trees": len(self._trees)}


def _has_both(is_slip: Tensor) -> bool:
    return bool(is_slip.any()) and not bool(is_slip.all())


def check_classes(is_slip: Tensor) -> None:
    """Refuse bins ``[N]`` of one class.

    Raises:
        ValueError: if they are.
    """
    if not _has_both(is_slip):
        raise ValueError("baselines need training bins of both classes; got only one")


def _single(columns: Tensor) -> NDArray[np.float32]:
    """As trees take them."""
    x: NDArray[np.float32] = columns.float().contiguous().numpy()
    return x

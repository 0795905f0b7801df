"""Simple baselines, fitted on training bins and evaluated beside a detector.

A result means little without what a simpler method reaches on the same bins. Four are fitted, with
both classes balanced and each sampled bin weighted by the number of bins it stands for:

- ``best_pooled_number``: the statistic over channels of one descriptor that separates the classes
  best, and its threshold;
- ``logistic_regression``: on the scaled columns of the detector;
- ``logistic_regression_simple``: on mean, standard deviation and rms of each channel, and their
  logarithms;
- ``random_forest_simple``: on mean, standard deviation and rms of each channel.

``logistic_regression`` has the features that the recipe lets the detector have, the others those
of the whole pool.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tactslip_torch.features.bin_sample import SampledBins
from tactslip_torch.features.names import FeatureName
from tactslip_torch.features.pool import FeaturePool, is_rounding
from tactslip_torch.features.pooling import ChannelPooling
from tactslip_torch.training.recipe import (
    FeatureThreshold,
    balanced_accuracy,
    best_threshold,
    check_classes,
    has_both_classes,
    sample_groups,
)

POOLED_NUMBER = "best_pooled_number"
KEY = "baselines"
"""Where a detector's ``info`` has the best pooled number."""
CONSTANT_BINS = 1200  # at most, of which compression learns its medians
NUM_TREES = 100  # as scikit-learn has it
MOST_FOLDS = 6  # with 3, C of simple statistics costs two points on held-out materials
PENALTIES = (1e-3, 1e-2, 1e-1, 1.0)
"""scikit-learn's ``C`` of logistic regression, chosen by leaving groups out, strongest first."""
WIDE, WIDE_PENALTY = 256, 1e-2
"""With more columns than this, choosing would take longer than the detector's own validation: ``C``
is fixed. On 672 pooled columns of the simulated hand 1e-3 to 1 differ by .3 points."""
LOG_FLOOR = 1e-2  # of the training median of a magnitude, below which its logarithm levels out


class SimpleStatistics:
    """Mean, standard deviation and rms of each channel's filtered bin, out of pool features.

    Of a fast channel the pool has wavelet branches alone. The first approximation and detail add up
    to the bin, ``x = A1 + D1``, so ``mean(x) = mean(A1) + mean(D1)``, and with the correlation
    ``r`` of each with ``x``, ``std(x) = r(A1) std(A1) + r(D1) std(D1)``.

    Args:
        pool: of the features.
    """

    def __init__(self, pool: FeaturePool) -> None:
        place = {name: index for index, name in enumerate(pool.names)}

        def of(channels: tuple[int, ...], component: str, descriptor: str) -> list[int]:
            names = (
                FeatureName(pool.hand.names[c], component, "time", descriptor) for c in channels
            )
            return [place[name] for name in names]

        self.num_samples = pool.bin_samples
        slow, fast = pool.hand.slow, pool.hand.fast
        self._slow = [of(slow, "raw", d) for d in ("mean", "std", "energy")]
        self._fast = {
            d: [of(fast, branch, d) for branch in ("A1", "D1")]
            for d in ("mean", "std", "correlation")
        }

    def __call__(self, features: Tensor) -> Tensor:
        """All means, then standard deviations, then rms, of slow channels and then of fast ones.

        Standard deviations have ``n - 1`` in the denominator, rms ``n``.

        Shape:
            - features: ``[N, F]``, of the whole pool; output: ``[N, 3 C]``, float64, in the unit of
              the samples
        """
        x, num = features.double(), self.num_samples
        mean, std, energy = (x[:, places] for places in self._slow)
        parts = {
            d: torch.stack([x[:, places] for places in of]) for d, of in self._fast.items()
        }  # [2, N, fast channels]
        fast_mean = parts["mean"].sum(0)
        fast_std = (parts["correlation"] * parts["std"]).sum(0).clamp(min=0.0)
        fast_rms = (fast_mean.square() + fast_std.square() * ((num - 1) / num)).sqrt()
        rms = (energy / num).sqrt()
        return torch.cat([mean, fast_mean, std, fast_std, rms, fast_rms], 1)


@dataclass(frozen=True)
class LogisticRegression:
    """A linear decision, ``weights @ x + constant >= 0``.

    Args:
        weights: of the columns or, with ``log_floor``, of them and of their logarithms.
        constant: added.
        penalty: scikit-learn's ``C``.
        log_floor: below which the logarithm of a magnitude levels out; ``None`` takes none.

    Shape:
        - weights: ``[K]``, float64, ``[2 K]`` with logarithms; log_floor: ``[K]``
    """

    weights: Tensor
    constant: float
    penalty: float
    log_floor: Tensor | None = None

    @classmethod
    def fit(
        cls, columns: Tensor, sample: SampledBins, *, with_logs: bool = False
    ) -> LogisticRegression:
        """Fit standardised columns, with ``C`` chosen by leaving groups out unless they are many.

        Args:
            columns: of the sampled bins.
            sample: their labels, weights and groups.
            with_logs: add the logarithm of each column's magnitude: amplitudes range over decades,
                so logarithms are worth seven points on the simulated hand.

        Shape:
            - columns: ``[n, K]``

        Raises:
            ValueError: if a class is absent.
        """
        check_classes(sample.is_slip)
        x, floor = columns.double(), None
        if with_logs:
            floor = LOG_FLOOR * columns.abs().median(0).values
            floor = torch.where(floor > 0, floor, 1.0)
            x = _with_logs(x, floor)
        sd, centre = torch.std_mean(x, 0, correction=0)
        scale = torch.where(sd > 0, sd, 1.0)
        z = (x - centre) / scale
        penalty = WIDE_PENALTY if z.shape[1] > WIDE else _chosen_penalty(z, sample)
        weights, constant = _fitted_regression(z, sample, slice(None), penalty)
        constant -= float(weights @ (centre / scale))
        return cls(weights / scale, constant, penalty, floor)

    def __call__(self, columns: Tensor) -> Tensor:
        """Decisions, ``[N, K] -> [N]``, bool."""
        x = columns.double()
        if self.log_floor is not None:
            x = _with_logs(x, self.log_floor)
        return x @ self.weights + self.constant >= 0

    def metadata(self) -> dict[str, Any]:
        """What was chosen, JSON-able."""
        return {"C": self.penalty}


def _with_logs(columns: Tensor, floor: Tensor) -> Tensor:
    return torch.cat([columns, (columns.abs() + floor).log()], 1)


def _chosen_penalty(z: Tensor, sample: SampledBins) -> float:
    """The ``C`` of the best balanced accuracy on groups left out; the strongest of equals."""
    groups, names = sample_groups(sample)
    num_folds = min(len(names), MOST_FOLDS)
    folds = [groups % num_folds == fold for fold in range(num_folds)]
    folds = [out for out in folds if has_both_classes(sample.is_slip[~out])]
    if num_folds < 2 or not folds:
        return WIDE_PENALTY
    means = {}
    for penalty in PENALTIES:
        found = []
        for out in folds:
            weights, constant = _fitted_regression(z, sample, ~out, penalty)
            says_slip = z[out] @ weights + constant >= 0
            found.append(balanced_accuracy(says_slip, sample.is_slip[out]))
        known = [value for value in found if value is not None]
        means[penalty] = sum(known) / max(len(known), 1)
    return max(means, key=means.__getitem__)


def _fitted_regression(
    z: Tensor, sample: SampledBins, rows: Tensor | slice, penalty: float
) -> tuple[Tensor, float]:
    """Weights and constant of some bins, both classes of one weight."""
    from sklearn.linear_model import LogisticRegression as Regression
    from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]  # sklearn's own

    solver = "lbfgs" if z.shape[1] > WIDE else "newton-cholesky"
    made = Regression(C=penalty, class_weight="balanced", max_iter=2000, solver=solver)
    weights = sample.sample_weight[rows].numpy()
    with warnings.catch_warnings(), threadpool_limits(1):  # small: threads would wait
        warnings.simplefilter("ignore")  # newton-cholesky falls back to lbfgs by itself
        made.fit(z[rows].numpy(), sample.is_slip[rows].numpy(), weights)
    return torch.from_numpy(made.coef_[0]), float(made.intercept_[0])


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
        truth, weights = sample.is_slip.numpy(), sample.sample_weight.numpy()
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


def _single(columns: Tensor) -> NDArray[np.float32]:
    """As trees take them."""
    x: NDArray[np.float32] = columns.float().contiguous().numpy()
    return x


@dataclass(frozen=True)
class PooledNumber:
    """One statistic over channels of one descriptor, and a threshold.

    Args:
        pooling: with one column.
        inputs: pool indices of the features that it takes.
        rule: of that column, which is compressed (``features.pooling``).
    """

    pooling: ChannelPooling
    inputs: tuple[int, ...]
    rule: FeatureThreshold

    @classmethod
    def fit(cls, pool: FeaturePool, sample: SampledBins) -> PooledNumber:
        """The mean or standard deviation over channels with the best balanced accuracy.

        Raises:
            ValueError: if a class is absent.
        """
        places = (~is_rounding(pool)).nonzero().flatten()
        names = [pool.names[place] for place in places.tolist()]
        features = sample.features[:: -(-len(sample.features) // CONSTANT_BINS)][:, places]
        layer = ChannelPooling.fit(pool.hand, names, features, ["mean", "std"])
        columns = layer(sample.features[:, _places(pool, layer)].double())
        rule = best_threshold(columns, sample.is_slip, sample.sample_weight)
        layer = layer.select([rule.index])
        return cls(layer, tuple(_places(pool, layer)), replace(rule, index=0))

    @property
    def name(self) -> FeatureName:
        """What the number is."""
        return self.pooling.names[0]

    def metadata(self) -> dict[str, Any]:
        """What it is, and its threshold, JSON-able."""
        rule = self.rule
        return {"feature": str(self.name), "threshold": rule.threshold, "sign": rule.sign}

    def __call__(self, features: Tensor) -> Tensor:
        """Decisions from features of the whole pool, ``[N, F] -> [N]``, bool."""
        return self.rule(self.pooling(features[:, list(self.inputs)].double()))

    def to_dict(self) -> dict[str, Any]:
        """JSON-able values; ``from_dict`` takes them."""
        constants = {name: x.tolist() for name, x in self.pooling.state_dict().items()}
        rule = {"threshold": self.rule.threshold, "sign": self.rule.sign}
        return self.pooling.to_dict() | {"constants": constants} | rule

    @classmethod
    def from_dict(cls, pool: FeaturePool, plain: Mapping[str, Any]) -> PooledNumber:
        """The number that ``to_dict`` described."""
        constants = {
            name: torch.tensor(x, dtype=torch.float64) for name, x in plain["constants"].items()
        }
        layer = ChannelPooling.from_dict(pool.hand, plain, constants)
        rule = FeatureThreshold(0, plain["threshold"], plain["sign"])
        return cls(layer, tuple(_places(pool, layer)), rule)


Method = LogisticRegression | RandomForest | PooledNumber


class Baselines:
    """Fitted baselines.

    Args:
        pool: of the features.
        pooled: the best pooled number.
        others: by name which columns each takes, ``"scaled"`` ones of the detector or those of
            ``"simple"`` statistics, and the baseline.
        num_bins: that all were fitted on.
    """

    def __init__(
        self,
        pool: FeaturePool,
        pooled: PooledNumber,
        others: Mapping[str, tuple[Literal["scaled", "simple"], Method]] | None = None,
        num_bins: int | None = None,
    ) -> None:
        self.pooled, self.num_bins = pooled, num_bins
        self._others = dict(others or {})
        self._statistics = SimpleStatistics(pool) if self._others else None

    @classmethod
    def fit(cls, pool: FeaturePool, scaled: Tensor, sample: SampledBins) -> Baselines:
        """Fit all of them to sampled training bins.

        Args:
            pool: of the features.
            scaled: columns of the detector of the sampled bins, ``[n, K]``.
            sample: as the first pass keeps it.

        Raises:
            ValueError: if a class is absent.
        """
        x = SimpleStatistics(pool)(sample.features)
        others: dict[str, tuple[Literal["scaled", "simple"], Method]] = {
            "logistic_regression": ("scaled", LogisticRegression.fit(scaled, sample)),
            "logistic_regression_simple": (
                "simple",
                LogisticRegression.fit(x, sample, with_logs=True),
            ),
            "random_forest_simple": ("simple", RandomForest(x, sample)),
        }
        return cls(pool, PooledNumber.fit(pool, sample), others, len(sample.is_slip))

    def __call__(self, features: Tensor, scaled: Tensor) -> dict[str, Tensor]:
        """Decisions by name.

        Shape:
            - features: ``[N, F]``, of the whole pool
            - scaled: ``[N, K]``, columns of the detector
            - output: each ``[N]``, bool
        """
        columns = {"scaled": scaled}
        if self._statistics is not None:
            columns["simple"] = self._statistics(features)
        found = {name: made(columns[kind]) for name, (kind, made) in self._others.items()}
        return {POOLED_NUMBER: self.pooled(features)} | found

    def metadata(self) -> dict[str, dict[str, Any]]:
        """What each is, by name, JSON-able."""
        bins = {} if self.num_bins is None else {"num_bins": self.num_bins}
        others = {name: made.metadata() | bins for name, (_, made) in self._others.items()}
        return {POOLED_NUMBER: self.pooled.metadata() | bins} | others

    def to_dict(self) -> dict[str, Any]:
        """What a detector keeps: the best pooled number, JSON-able; the others are too large."""
        return {POOLED_NUMBER: self.pooled.to_dict()}

    @classmethod
    def from_dict(cls, pool: FeaturePool, plain: Mapping[str, Any]) -> Baselines:
        """The baselines that ``to_dict`` kept."""
        return cls(pool, PooledNumber.from_dict(pool, plain[POOLED_NUMBER]))


def _places(pool: FeaturePool, layer: ChannelPooling) -> list[int]:
    place = {name: index for index, name in enumerate(pool.names)}
    return [place[name] for name in layer.inputs]

"""Simpler methods, fitted to the same sample of training bins and evaluated beside the detector.

- ``best_pooled_number``: the statistic over channels of one descriptor that separates the classes
  best, and its threshold;
- ``logistic_regression``: on the scaled columns of the detector;
- ``logistic_regression_simple``: on mean, standard deviation and rms of each channel, and their
  logarithms;
- ``random_forest_simple``: on mean, standard deviation and rms of each channel.

``best_pooled_number`` has the features that are made for the recipe.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tactslip_torch.features.names import FeatureName
from tactslip_torch.features.pool import FeaturePool, is_rounding
from tactslip_torch.features.pooling import ChannelPooling
from tactslip_torch.training.bins import SampledBins
from tactslip_torch.training.choice import has_both_classes

POOLED_NUMBER = "best_pooled_number"
BASELINES = "baselines"
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


_OF_SLOW, _OF_FAST = ("mean", "std", "energy"), ("mean", "std", "correlation")


def _names(
    pool: FeaturePool, channels: Sequence[int], component: str, descriptor: str
) -> list[FeatureName]:
    names = pool.hand.names
    return [FeatureName(names[c], component, "time", descriptor) for c in channels]


class SimpleStatistics:
    """Mean, standard deviation and rms of each channel's filtered bin, out of pool features.

    Of a fast channel the pool has wavelet branches alone. The first approximation and detail add up
    to the bin, ``x = A1 + D1``, so ``mean(x) = mean(A1) + mean(D1)``, and with the correlation
    ``r`` of each with ``x``, ``std(x) = r(A1) std(A1) + r(D1) std(D1)``.

    Args:
        pool: of the features.
    """

    def __init__(self, pool: FeaturePool) -> None:
        self.num_samples = pool.bin_samples
        slow, fast = pool.hand.slow, pool.hand.fast
        self._slow = [pool.places(_names(pool, slow, "raw", d)) for d in _OF_SLOW]
        self._fast = {
            d: [pool.places(_names(pool, fast, branch, d)) for branch in ("A1", "D1")]
            for d in _OF_FAST
        }

    @staticmethod
    def names(pool: FeaturePool) -> list[FeatureName]:
        """The features that are read."""
        slow, fast = pool.hand.slow, pool.hand.fast
        found = [name for d in _OF_SLOW for name in _names(pool, slow, "raw", d)]
        for branch in ("A1", "D1"):
            found += [name for d in _OF_FAST for name in _names(pool, fast, branch, d)]
        return found

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


def _fit_regression(columns: Tensor, sample: SampledBins, *, with_logs: bool = False) -> Any:
    """scikit-learn's logistic regression of standardised columns ``[n, K]`` of sampled bins.

    Its ``C`` is chosen by leaving groups out unless columns are many: the best mean balanced
    accuracy, the strongest penalty of equals. ``with_logs`` adds the logarithm of each column's
    magnitude: amplitudes range over decades, so logarithms are worth seven points on the simulated
    hand.
    """
    from sklearn.linear_model import LogisticRegression
    from sklearn.model_selection import GridSearchCV
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import FunctionTransformer, StandardScaler

    before = make_pipeline(StandardScaler())
    if with_logs:
        floor = LOG_FLOOR * columns.abs().median(0).values
        floor = torch.where(floor > 0, floor, 1.0)
        logs = FunctionTransformer(_with_logs, kw_args={"floor": floor.numpy()})
        before = make_pipeline(logs, StandardScaler())
    z = before.fit_transform(columns.double().numpy())
    num_folds, groups = min(len(sample.group_names), MOST_FOLDS), sample.group
    splits = [(groups % num_folds != fold, groups % num_folds == fold) for fold in range(num_folds)]
    folds = [
        [part.nonzero()[:, 0].numpy() for part in split]
        for split in splits
        if all(has_both_classes(sample.is_slip[part]) for part in split)
    ]
    is_wide = z.shape[1] > WIDE
    solver = "lbfgs" if is_wide else "newton-cholesky"
    made = LogisticRegression(C=WIDE_PENALTY, class_weight="balanced", max_iter=2000, solver=solver)
    if folds and not is_wide:
        made = GridSearchCV(made, {"C": PENALTIES}, scoring="balanced_accuracy", cv=folds)
    made.fit(z, sample.is_slip.numpy(), sample_weight=sample.weight.numpy())
    return make_pipeline(before, getattr(made, "best_estimator_", made))


def _with_logs(columns: NDArray[np.float64], floor: NDArray[np.float64]) -> NDArray[np.float64]:
    """Columns, and the logarithms of their magnitudes, which level out at the floor."""
    return np.concatenate([columns, np.log(np.abs(columns) + floor)], 1)


def _fit_forest(columns: Tensor, sample: SampledBins) -> Any:
    """scikit-learn's random forest of columns ``[n, K]`` of sampled bins."""
    from sklearn.ensemble import RandomForestClassifier

    made = RandomForestClassifier(NUM_TREES, class_weight="balanced", random_state=0, n_jobs=2)
    truth, weights = sample.is_slip.numpy(), sample.weight.numpy()
    return made.fit(columns.numpy(), truth, sample_weight=weights).set_params(n_jobs=None)


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
        columns = layer(sample.features[:, pool.places(layer.inputs)].double())
        rule = best_threshold(columns, sample.is_slip, sample.weight)
        layer = layer.select([rule.index])
        return cls(layer, tuple(pool.places(layer.inputs)), replace(rule, index=0))

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
        return cls(layer, tuple(pool.places(layer.inputs)), rule)


class Baselines:
    """Fitted baselines.

    Args:
        pool: of the features.
        pooled: the best pooled number.
        others: estimators of scikit-learn by name.
        metadata: of each, by name, JSON-able.
    """

    def __init__(
        self,
        pool: FeaturePool,
        pooled: PooledNumber,
        others: Mapping[str, Any] | None = None,
        metadata: Mapping[str, Mapping[str, Any]] | None = None,
    ) -> None:
        self.pooled, self._others = pooled, dict(others or {})
        self._metadata = {POOLED_NUMBER: pooled.metadata()} | dict(metadata or {})
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
        from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]  # sklearn's own

        pooled = PooledNumber.fit(pool, sample)  # refuses one class
        x = SimpleStatistics(pool)(sample.features)
        with warnings.catch_warnings(), threadpool_limits(1):  # small: threads would wait
            warnings.simplefilter("ignore")  # newton-cholesky falls back to lbfgs by itself
            on_scaled = _fit_regression(scaled, sample)
            on_simple = _fit_regression(x, sample, with_logs=True)
            others = {
                "logistic_regression": on_scaled,
                "logistic_regression_simple": on_simple,
                "random_forest_simple": _fit_forest(x, sample),
            }
        metadata = {
            POOLED_NUMBER: pooled.metadata(),
            "logistic_regression": {"C": on_scaled[-1].C},
            "logistic_regression_simple": {"C": on_simple[-1].C},
            "random_forest_simple": {"trees": NUM_TREES},
        }
        num_bins = len(sample.is_slip)
        metadata = {name: own | {"num_bins": num_bins} for name, own in metadata.items()}
        return cls(pool, pooled, others, metadata)

    def __call__(self, features: Tensor, scaled: Tensor) -> dict[str, Tensor]:
        """Decisions by name.

        Shape:
            - features: ``[N, F]``, of the whole pool
            - scaled: ``[N, K]``, columns of the detector
            - output: each ``[N]``, bool
        """
        found = {POOLED_NUMBER: self.pooled(features)}
        if self._statistics is not None:
            simple = self._statistics(features)
            for name, made in self._others.items():
                x = (simple if name.endswith("_simple") else scaled.double()).numpy()
                found[name] = torch.from_numpy(made.predict(x) if len(x) else np.zeros(0, bool))
        return found

    def metadata(self) -> dict[str, dict[str, Any]]:
        """What each is, by name, JSON-able."""
        return {name: dict(own) for name, own in self._metadata.items()}

    def to_dict(self) -> dict[str, Any]:
        """What a detector keeps: the best pooled number, JSON-able; the others are too large."""
        return {POOLED_NUMBER: self.pooled.to_dict()}

    @classmethod
    def from_dict(cls, pool: FeaturePool, plain: Mapping[str, Any]) -> Baselines:
        """The baselines that ``to_dict`` kept."""
        return cls(pool, PooledNumber.from_dict(pool, plain[POOLED_NUMBER]))


@dataclass(frozen=True)
class FeatureThreshold:
    """Says slip where ``sign * feature > sign * threshold``.

    Args:
        index: position of the feature.
        threshold: in the feature's unit.
        sign: +1 if slip has the larger values, -1 otherwise.
    """

    index: int
    threshold: float
    sign: int

    def __call__(self, features: Tensor) -> Tensor:
        """Decisions: ``[*, K] -> [*]``, bool."""
        decision: Tensor = self.sign * features[..., self.index] > self.sign * self.threshold
        return decision


def best_threshold(
    features: Tensor, is_slip: Tensor, weights: Tensor | None = None
) -> FeatureThreshold:
    """The single feature and threshold of the best balanced accuracy on training bins.

    Shape:
        - features: ``[N, K]``, finite; is_slip: ``[N]``, bool
        - weights: ``[N]``, of each bin; 1 by default

    Raises:
        ValueError: if a class is absent.
    """
    if not has_both_classes(is_slip):
        raise ValueError("baselines need training bins of both classes; got only one")
    weights = torch.ones(len(is_slip), dtype=torch.float64) if weights is None else weights
    slip, quiet = weights * is_slip, weights * ~is_slip
    step = slip / slip.sum() - quiet / quiet.sum()
    values, order = features.sort(dim=0)
    below = step[order].cumsum(0)[:-1]  # slip recall minus non-slip recall if cut above this value
    below = torch.where(values[1:] > values[:-1], below, 0.0)  # no cut between equal values
    best = below.abs().flatten().argmax()
    row, index = divmod(int(best), features.shape[1])
    sign = -1 if below[row, index] > 0 else 1
    lower, upper = float(values[row, index]), float(values[row + 1, index])
    threshold = lower + (upper - lower) / 2
    if threshold in (lower, upper):  # neighbouring floats: the side that is not slip
        threshold = lower if sign > 0 else upper
    return FeatureThreshold(index, threshold, sign)

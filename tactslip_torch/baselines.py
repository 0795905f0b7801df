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

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from tactslip_torch.features.bin_sample import SampledBins
from tactslip_torch.features.names import FeatureName
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.features.pooling import ChannelPooling
from tactslip_torch.features.rounding import is_rounding
from tactslip_torch.features.simple import SimpleStatistics
from tactslip_torch.model.classifiers import (
    LogisticRegression,
    RandomForest,
    SimpleLogisticRegression,
    check_classes,
)
from tactslip_torch.model.threshold import FeatureThreshold, best_threshold

POOLED_NUMBER = "best_pooled_number"
KEY = "baselines"
"""Where a detector's ``info`` has the best pooled number."""
CONSTANT_BINS = 1200  # at most, of which compression learns its medians

Classifier = SimpleLogisticRegression | RandomForest


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
        rule = best_threshold(columns, sample.is_slip, sample.represents)
        layer = layer.select([rule.index])
        return cls(layer, tuple(_places(pool, layer)), replace(rule, index=0))

    @property
    def name(self) -> FeatureName:
        """What the number is."""
        return self.pooling.names[0]

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


class Baselines:
    """Fitted baselines.

    Args:
        pooled: the best pooled number.
        regression: on the scaled columns of the detector.
        statistics: simple ones, of features of the pool.
        simple: classifiers of simple statistics, by name.
        num_bins: that all were fitted on.
    """

    def __init__(
        self,
        pooled: PooledNumber,
        regression: LogisticRegression | None = None,
        statistics: SimpleStatistics | None = None,
        simple: Mapping[str, Classifier] | None = None,
        num_bins: int | None = None,
    ) -> None:
        self.pooled, self.num_bins = pooled, num_bins
        self._regression = regression
        self._statistics, self._simple = statistics, dict(simple or {})

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
        check_classes(sample.is_slip)
        statistics = SimpleStatistics(pool)
        x = statistics(sample.features)
        return cls(
            PooledNumber.fit(pool, sample),
            LogisticRegression.fit(scaled, sample),
            statistics,
            {
                "logistic_regression_simple": SimpleLogisticRegression(x, sample),
                "random_forest_simple": RandomForest(x, sample),
            },
            len(sample.is_slip),
        )

    def __call__(self, features: Tensor, scaled: Tensor) -> dict[str, Tensor]:
        """Decisions by name.

        Shape:
            - features: ``[N, F]``, of the whole pool
            - scaled: ``[N, K]``, columns of the detector
            - output: each ``[N]``, bool
        """
        found = {POOLED_NUMBER: self.pooled(features)}
        if self._regression is not None:
            found["logistic_regression"] = self._regression(scaled)
        if self._statistics is not None:
            x = self._statistics(features)
            found |= {name: made(x) for name, made in self._simple.items()}
        return found

    def metadata(self) -> dict[str, dict[str, Any]]:
        """What each is, by name, JSON-able."""
        rule = self.pooled.rule
        found: dict[str, dict[str, Any]] = {
            POOLED_NUMBER: {
                "feature": str(self.pooled.name),
                "threshold": rule.threshold,
                "sign": rule.sign,
            }
        }
        if self._regression is not None:
            found["logistic_regression"] = self._regression.metadata()
        found |= {name: made.metadata() for name, made in self._simple.items()}
        bins = {} if self.num_bins is None else {"num_bins": self.num_bins}
        return {name: about | bins for name, about in found.items()}

    def to_dict(self) -> dict[str, Any]:
        """What a detector keeps: the best pooled number, JSON-able; the others are too large."""
        return {POOLED_NUMBER: self.pooled.to_dict()}

    @classmethod
    def from_dict(cls, pool: FeaturePool, plain: Mapping[str, Any]) -> Baselines:
        """The baselines that ``to_dict`` kept."""
        return cls(PooledNumber.from_dict(pool, plain[POOLED_NUMBER]))


def _places(pool: FeaturePool, layer: ChannelPooling) -> list[int]:
    place = {name: index for index, name in enumerate(pool.names)}
    return [place[name] for name in layer.inputs]

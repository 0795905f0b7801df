"""Machines of any features, all fitted on the same sampled bins in closed form.

C is chosen anew for each by the scores of held-out groups, which one factorisation gives exactly
(``model.held_out``). Scaling and bin weights stay what the first pass over all training bins says.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch import Tensor

from tactslip_torch.features.bin_sample import SampledBins
from tactslip_torch.features.pooling import ChannelPooling
from tactslip_torch.importance.accuracy import Tally, balanced_accuracy, tally
from tactslip_torch.model.fit import TrainingBins
from tactslip_torch.model.held_out import HeldOut
from tactslip_torch.model.kernels import Kernel
from tactslip_torch.model.scaling import FeatureScaler

HELD_OUT = "held_out"
"""Training bins, each judged by the machine that never met its group."""


class Verdict(NamedTuple):
    """How well a machine does.

    Attributes:
        num_features: that it has.
        penalty: its C.
        tallies: of ``HELD_OUT`` and of every judged role.
        error: weighted mean square of held-out residuals; breaks ties of accuracy.
    """

    num_features: int
    penalty: float
    tallies: dict[str, Tally]
    error: float

    def accuracy(self, role: str = HELD_OUT) -> float:
        """Balanced accuracy, the mean over groups."""
        return float(balanced_accuracy(self.tallies[role]))

    @property
    def merit(self) -> tuple[float, float]:
        """What machines are chosen by, larger is better: held-out bins of training alone."""
        return self.accuracy(), -self.error


@dataclass(frozen=True)
class Refit:
    """Fits and judges a machine of some features of the pool.

    Args:
        train: sampled training bins with the whole pool.
        weights: ``[n]`` of those, positive.
        judged: bins of other roles; they choose nothing.
        scaler: of the whole pool or, with ``pooling``, of its columns.
        kernel: of the machines.
        penalties: values of C to choose from.
        pooling: of a detector that pools over channels: machines are of its columns, made of the
            channels whose features they are given.
        inputs: pool indices of what it takes.
    """

    train: SampledBins
    weights: Tensor
    judged: Mapping[str, SampledBins]
    scaler: FeatureScaler
    kernel: Kernel
    penalties: Sequence[float]
    pooling: ChannelPooling | None = None
    inputs: Sequence[int] = ()
    _known: dict[Any, tuple[Verdict, Any]] = field(default_factory=dict, repr=False, compare=False)

    def __call__(self, features: Sequence[int]) -> Verdict:
        """The machine of these features, judged on every role.

        C is the one of largest merit. Without a feature it always says slip: balanced accuracy
        one half.

        Args:
            features: pool indices.

        Raises:
            ValueError: if held-out scores cannot be told (``HeldOut``).
        """
        verdict, head = self._best(features, self.penalties)
        tallies = dict(verdict.tallies)
        for role, bins in self.judged.items():
            if head is None:
                is_right = bins.is_slip
            else:
                is_right = (head(self._scaled(bins, features)) >= 0) == bins.is_slip
            tallies[role] = tally(is_right, bins)
        return verdict._replace(tallies=tallies)

    def held_out(self, features: Sequence[int], penalties: Sequence[float]) -> Verdict:
        """The same on held-out groups alone, with C from other choices: what sets compete by."""
        return self._best(features, penalties)[0]

    def _best(self, features: Sequence[int], penalties: Sequence[float]) -> tuple[Verdict, Any]:
        choice = tuple(features), tuple(penalties)
        if choice not in self._known:  # many a sensor has no feature in use: the same set again
            self._known[choice] = self._chosen(*choice)
        return self._known[choice]

    def _chosen(self, features: Sequence[int], penalties: Sequence[float]) -> tuple[Verdict, Any]:
        if not len(features):
            always = tally(self.train.is_slip, self.train)
            return Verdict(0, penalties[len(penalties) // 2], {HELD_OUT: always}, 1.0), None
        scaled = self._scaled(self.train, features)
        bins = TrainingBins(scaled, self.train.is_slip, self.weights)
        machine = HeldOut(bins, self.train.group, self.kernel)
        found = []
        for penalty in penalties:
            fitted = machine.at(penalty)
            verdict = self._held_out(fitted.scores, len(features), penalty)
            found.append((verdict, fitted.head))
        return max(found, key=lambda pair: pair[0].merit)  # of equal ones the smallest C

    def _scaled(self, bins: SampledBins, features: Sequence[int]) -> Tensor:
        if self.pooling is not None:
            return self._pooled(self.pooling, bins, set(features))
        index, knee = list(features), self.scaler.knee
        ranges = self.scaler.minimum[index], self.scaler.maximum[index]
        scaler = FeatureScaler(*ranges, None if knee is None else knee[index])
        scaled: Tensor = scaler(bins.features[:, index].double())
        return scaled

    def _pooled(self, layer: ChannelPooling, bins: SampledBins, features: set[int]) -> Tensor:
        """Columns of the channels of these features; of other channels, the middle of the range."""
        pairs = list(zip(layer.inputs, self.inputs, strict=True))
        heard = {name.channel for name, index in pairs if index in features}
        is_missing = torch.tensor([name not in heard for name in layer.hand.names])
        values = bins.features[:, list(self.inputs)].double()
        scaled: Tensor = self.scaler(layer(values, is_missing.expand(len(values), -1)))
        single = [not name.is_pooled and name.channel not in heard for name in layer.names]
        return scaled.masked_fill(torch.tensor(single), 0.0)

    def _held_out(self, scores: Tensor, num_features: int, penalty: float) -> Verdict:
        residuals = torch.where(self.train.is_slip, 1.0, -1.0) - scores
        error = float(self.weights @ residuals.square() / self.weights.sum())
        is_right = (scores >= 0) == self.train.is_slip
        return Verdict(num_features, penalty, {HELD_OUT: tally(is_right, self.train)}, error)

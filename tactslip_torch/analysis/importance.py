"""Which sensors matter: by gradient, by leaving them out, and by using only the best few.

Accuracies are balanced: of each group, a material as a rule, the mean of its two recalls; then the
mean over groups. So a material with many bins does not drown the others, and a sample of as many
bins of every group and class needs no weights. Machines are refitted in closed form on a sample of
training bins; held-out groups of these make every choice, bins of other roles none.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from tactslip_torch.analysis.old.bin_sample import SampledBins
from tactslip_torch.analysis.old.recipe import FeatureSelection
from tactslip_torch.features.pooling import ChannelPooling
from tactslip_torch.features.selection import rank_distinct
from tactslip_torch.hand import HandLayout
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.fit import HeldOut, TrainingBins
from tactslip_torch.model.kernels import Polynomial
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.runtime import bar, thread_map

_COVERAGE = 0.95


class RecordingCounts(NamedTuple):
    """Right decisions by recording: all that accuracy and its draws need to know.

    Shape:
        - right: ``[R, 2]``, float64, non-slip first
        - whole: ``[R, 2]``, how many bins there are
        - group: ``[R]``, whole numbers
    """

    right: Tensor
    whole: Tensor
    group: Tensor


def count_right(is_right: Tensor, bins: SampledBins) -> RecordingCounts:
    """Count right decisions by recording and class.

    Shape:
        - is_right: ``[n]``, bool
    """
    num = len(bins.recording_names)
    cell = 2 * bins.recording + bins.is_slip
    whole = torch.bincount(cell, minlength=2 * num).double().view(num, 2)
    right = torch.bincount(cell[is_right], minlength=2 * num).double().view(num, 2)
    group = torch.zeros(num, dtype=torch.int64)
    group[bins.recording] = bins.group  # a recording is of one group
    return RecordingCounts(right, whole, group)


def balanced_accuracy(counts: RecordingCounts, times: Tensor | None = None) -> Tensor:
    """The mean over groups of their balanced accuracy, in draws of recordings or in all of them.

    Groups without bins of both classes are passed over; NaN where none is left.

    Args:
        counts: of a machine.
        times: how often each recording is in each draw; default once each in one draw.

    Shape:
        - times: ``[D, R]``, float64
        - output: ``[D]``, float64
    """
    times = torch.ones_like(counts.whole[:, 0])[None] if times is None else times
    by_group = []
    for name in counts.group.unique():
        mine = counts.group == name
        recalls = (times[:, mine] @ counts.right[mine]) / (times[:, mine] @ counts.whole[mine])
        by_group.append(recalls.mean(-1))
    return torch.stack(by_group).nanmean(0)


def _draw_recordings(group: Tensor, num_draws: int, seed: int) -> Tensor:
    """How often each recording is in each draw: as many as there are of its group, replaced.

    Shape:
        - group: ``[R]``
        - output: ``[D, R]``, float64
    """
    generator = torch.Generator().manual_seed(seed)
    times = torch.zeros(num_draws, len(group), dtype=torch.float64)
    for name in group.unique():
        mine = (group == name).nonzero()[:, 0]
        drawn = torch.randint(len(mine), (num_draws, len(mine)), generator=generator)
        times.scatter_add_(1, mine[drawn], torch.ones(drawn.shape, dtype=torch.float64))
    return times


def difference(
    before: RecordingCounts, after: RecordingCounts, num_draws: int, seed: int
) -> dict[str, float]:
    """Balanced accuracy that ``after`` lacks, with a bootstrap interval over recordings.

    Paired: both machines are evaluated on the same draws, so what makes a recording hard for both
    cancels. The machines are held: another draw of training recordings would change more.

    Args:
        before: of the machine with all sensors.
        after: of the other, on the same bins.
        num_draws: how many.
        seed: of the draws.

    Returns:
        ``lost`` and the ends of its interval, ``low`` and ``high``: fractions, not percent.

    Raises:
        ValueError: if nothing is to be drawn.

    Reference:
        Efron and Tibshirani (1993), An Introduction to the Bootstrap, chapters 8 and 13.
    """
    if num_draws < 1:
        raise ValueError(f"an interval needs at least one draw, got {num_draws}; give draws=1000")
    times = _draw_recordings(before.group, num_draws, seed)
    gaps = balanced_accuracy(before, times) - balanced_accuracy(after, times)
    tail = (1 - _COVERAGE) / 2
    low, high = gaps.nanquantile(torch.tensor([tail, 1 - tail], dtype=torch.float64)).tolist()
    lost = float(balanced_accuracy(before) - balanced_accuracy(after))
    return {"lost": lost, "low": low, "high": high}


HELD_OUT = "held_out"
"""Training bins, each scored by the machine that was fitted without its group."""


class Result(NamedTuple):
    """How well a machine does.

    Attributes:
        num_features: that it has.
        penalty: its C.
        counts: of ``HELD_OUT`` and of every other role.
        error: weighted mean square of held-out residuals; breaks ties of accuracy.
    """

    num_features: int
    penalty: float
    counts: dict[str, RecordingCounts]
    error: float

    @property
    def accuracies(self) -> dict[str, float]:
        """Balanced accuracy by role, the mean over groups."""
        return {role: float(balanced_accuracy(counts)) for role, counts in self.counts.items()}

    @property
    def merit(self) -> tuple[float, float]:
        """What machines are chosen by, larger is better: held-out bins of training alone."""
        return float(balanced_accuracy(self.counts[HELD_OUT])), -self.error

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON values."""
        return {
            "num_features": self.num_features,
            "penalty": self.penalty,
            "balanced_accuracy": self.accuracies,
        }


@dataclass(frozen=True)
class Refit:
    """Fits and evaluates a machine of some features of the pool.

    Args:
        train: sampled training bins with the whole pool.
        weights: ``[n]`` of those, positive.
        scored: bins of other roles; they choose nothing.
        selection: scales the whole pool; or of a detector that pools over channels: machines are
            of its columns, made of the channels whose features they are given.
        kernel: of the machines.
        penalties: values of C to choose from.
    """

    train: SampledBins
    weights: Tensor
    scored: Mapping[str, SampledBins]
    selection: FeatureSelection
    kernel: Polynomial
    penalties: Sequence[float]
    _known: dict[Any, tuple[Result, Any]] = field(default_factory=dict, repr=False, compare=False)

    def __call__(self, features: Sequence[int]) -> Result:
        """The machine of these features, evaluated on every role.

        C is the one of largest merit. Without a feature it always says slip: balanced accuracy
        one half.

        Args:
            features: pool indices.

        Raises:
            ValueError: if held-out scores cannot be computed (``HeldOut``).
        """
        result, head = self._best(features, self.penalties)
        counts = dict(result.counts)
        for role, bins in self.scored.items():
            if head is None:
                is_right = bins.is_slip
            else:
                is_right = (head(self._scaled(bins, features)) >= 0) == bins.is_slip
            counts[role] = count_right(is_right, bins)
        return result._replace(counts=counts)

    def held_out(self, features: Sequence[int], penalties: Sequence[float]) -> Result:
        """The same on held-out groups alone, with C from other choices: what sets compete by."""
        return self._best(features, penalties)[0]

    def _best(self, features: Sequence[int], penalties: Sequence[float]) -> tuple[Result, Any]:
        """The best result over C with its head; a set that comes again is not fitted again."""
        choice = tuple(features), tuple(penalties)
        if choice not in self._known:
            self._known[choice] = self._fitted(*choice)
        return self._known[choice]

    def _fitted(self, features: Sequence[int], penalties: Sequence[float]) -> tuple[Result, Any]:
        is_slip = self.train.is_slip
        if not features:
            always = count_right(is_slip, self.train)
            return Result(0, penalties[len(penalties) // 2], {HELD_OUT: always}, 1.0), None
        bins = TrainingBins(self._scaled(self.train, features), is_slip, self.weights)
        machine = HeldOut(bins, self.train.group, self.kernel)
        results = []
        for penalty in penalties:
            fitted = machine.at(penalty)
            residuals = torch.where(is_slip, 1.0, -1.0) - fitted.scores
            error = float(self.weights @ residuals.square() / self.weights.sum())
            counts = count_right((fitted.scores >= 0) == is_slip, self.train)
            result = Result(len(features), penalty, {HELD_OUT: counts}, error)
            results.append((result, fitted.head))
        return max(results, key=lambda pair: pair[0].merit)  # of equal ones the smallest C

    def _scaled(self, bins: SampledBins, features: Sequence[int]) -> Tensor:
        if self.selection.pooling is not None:
            return self._pooled(self.selection.pooling, bins, set(features))
        index, whole = list(features), self.selection.scaler
        ranges, compression = (whole.minimum[index], whole.maximum[index]), whole.compression
        scaler = FeatureScaler(*ranges, None if compression is None else compression[index])
        scaled: Tensor = scaler(bins.features[:, index].double())
        return scaled

    def _pooled(self, layer: ChannelPooling, bins: SampledBins, features: set[int]) -> Tensor:
        """Columns of the channels of these features; of other channels, the middle of the range."""
        inputs = zip(layer.inputs, self.selection.selected, strict=True)
        used = {name.channel for name, index in inputs if index in features}
        is_missing = torch.tensor([name not in used for name in layer.hand.names])
        scaled = self.selection(bins.features, is_missing.expand(len(bins.features), -1))
        single = [not name.is_pooled and name.channel not in used for name in layer.names]
        return scaled.masked_fill(torch.tensor(single), 0.0)


def _units_of(hand: HandLayout) -> dict[str, dict[str, frozenset[str]]]:
    """What is taken or left out together: the channels of a hand one by one, by finger, by kind.

    Example:
        >>> units = _units_of(HandLayout.paper24())
        >>> sorted(units["finger"]["thumb"]), len(units["kind"]["SG"])
        (['PVDF10', 'PVDF9', 'SG13', 'SG14'], 14)
    """
    units: dict[str, dict[str, frozenset[str]]] = {"channel": {}, "finger": {}, "kind": {}}
    for channel in hand.channels:
        for unit, name in zip(units, (channel.name, channel.finger, channel.kind), strict=True):
            units[unit][name] = units[unit].get(name, frozenset()) | {channel.name}
    return units


@dataclass(frozen=True)
class Ranking:
    """Selects features again among some channels.

    Args:
        scores: ``[F]``, of the t-test on all training bins, made once.
        channels: the channel of each feature.
        allowed: ``[F]``, bool, what may be selected at all; ``None``: everything.
        sample: of training bins, for correlations.
        num_features: how many are selected, where there are so many.
        most_correlation: as in ``Recipe``.
        is_shared: every channel gives as many features (one at least), however large the
            scores of others are; else the recipe's way, the best of all.
    """

    scores: Tensor
    channels: Sequence[str]
    allowed: Tensor | None
    sample: SampledBins
    num_features: int
    most_correlation: float
    is_shared: bool = False

    def __call__(self, channels: Collection[str]) -> list[int]:
        """Pool indices of the best features of these channels, best first; none if none may be."""
        if not self.is_shared:
            return self._best(channels, self.num_features)
        each = max(1, self.num_features // max(1, len(channels)))
        best = [index for name in sorted(channels) for index in self._best({name}, each)]
        return sorted(best, key=lambda index: (-float(self.scores[index]), index))

    def _best(self, channels: Collection[str], most: int) -> list[int]:
        wanted = torch.tensor([name in channels for name in self.channels])
        places = (wanted if self.allowed is None else wanted & self.allowed).nonzero()[:, 0]
        num = min(most, len(places))
        if not num:
            return []
        scores, features = self.scores[places], self.sample.features[:, places]
        order = rank_distinct(scores, features, self.sample.is_slip, num, self.most_correlation)
        return [int(place) for place in places[order]]


def without(features: Iterable[int], channels: Collection[str], names: Sequence[str]) -> list[int]:
    """Those features that are of none of the channels.

    Args:
        features: pool indices.
        channels: to leave out.
        names: the channel of each feature of the pool.
    """
    return [index for index in features if names[index] not in channels]


def best_first(
    refit: Refit,
    select: Callable[[Collection[str]], Sequence[int]],
    units: Mapping[str, frozenset[str]],
    most: int,
    what: str,
) -> list[tuple[str, Result]]:
    """Greedy forward selection: at each step the unit joins that serves held-out groups best.

    Features are selected again among the channels taken. Candidates are compared at the C of the
    step before (the first at every C), and C is chosen again for the one that joins. Units that
    tie go by the smaller held-out error, then in order. That a set was chosen by its held-out
    accuracy makes this one optimistic; other roles choose nothing.

    Args:
        refit: fits and evaluates.
        select: features of channels, such as a ``Ranking``.
        units: to choose from; those none of whose features may be selected never join.
        most: steps at most.
        what: is done, for the progress bar.

    Returns:
        For each step the name of the unit that joined, and the result with it.
    """
    left = [name for name, channels in units.items() if len(select(channels))]
    taken: frozenset[str] = frozenset()
    steps: list[tuple[str, Result]] = []
    for number in bar(range(min(most, len(left))), what):
        near = [steps[-1][1].penalty] if number else refit.penalties
        selections = [select(taken | units[name]) for name in left]
        results = thread_map(partial(refit.held_out, penalties=near), selections)
        best = max(range(len(left)), key=lambda place: (*results[place].merit, -place))
        taken |= units[left[best]]
        steps.append((left.pop(best), refit(selections[best])))
    return steps


_CHUNK = 32  # bins whose graphs are held at once


def score_gradients(detector: SlipDetector, samples: Tensor) -> tuple[Tensor, Tensor]:
    """Scores of raw bins and their derivatives with respect to every volt, in float64.

    Through filter, branches, spectra, descriptors, scaling and the quadratic form. What is clipped
    by the scaling, and what steps (entropy, mode), has derivative 0.

    Args:
        detector: as loaded.
        samples: in volts, with the context that ``score_raw`` needs.

    Shape:
        - samples: ``[N, C, T]``
        - output: ``[N]`` and ``[N, C, T]``, float64
    """
    scores, gradients = [], []
    for part in bar(samples.double().split(_CHUNK), "gradients"):
        volts = part.clone().requires_grad_()
        score = detector.score_raw(volts)
        (gradient,) = torch.autograd.grad(score.sum(), volts)
        scores.append(score.detach())
        gradients.append(gradient)
    return torch.cat(scores), torch.cat(gradients)


def first_order(scores: Tensor, gradients: Tensor, samples: Tensor, is_slip: Tensor) -> Tensor:
    """Root mean square over bins of the gradient times the channel's own spread.

    The spread is the covariance ``S_c`` of the channel's samples over all bins given, so level and
    vibration count as they occur: a bin's part is ``sqrt(g_c' S_c g_c)``, by which the score would
    vary if this channel alone went through what it goes through in these bins, linearised at the
    bin. In units of the standard deviation of the scores.

    Args:
        scores: of the bins.
        gradients: of those with respect to ``samples``.
        samples: raw bins, in volts.
        is_slip: their classes.

    Shape:
        - scores, is_slip: ``[N]``
        - gradients, samples: ``[N, C, T]``
        - output: ``[2, C]``, at non-slip bins and at slip bins

    Raises:
        ValueError: if shapes disagree, a class is absent, or the scores are all the same.
    """
    if gradients.shape != samples.shape or not len(samples) == len(scores) == len(is_slip):
        raise ValueError(
            f"expected scores and is_slip [N], gradients and samples [N, C, T], got "
            f"{tuple(scores.shape)}, {tuple(is_slip.shape)}, {tuple(gradients.shape)} and "
            f"{tuple(samples.shape)}"
        )
    if not bool(is_slip.any()) or bool(is_slip.all()):
        raise ValueError("gradients are reported by class: give bins of slip and of non-slip")
    spread = scores.std()
    if not bool(spread > 0):
        raise ValueError(f"all {len(scores)} scores are {float(scores[0]):g}; nothing moves them")
    deviations = (samples.double() - samples.double().mean(0)) / (len(samples) - 1) ** 0.5
    moved = torch.einsum("nct,mct->cnm", gradients, deviations).square().sum(-1)  # [C, N]
    by_class = [moved[:, is_slip == value].mean(-1).sqrt() / spread for value in (False, True)]
    return torch.stack(by_class)


def measure(
    refit: Refit,
    ranking: Ranking,
    selected: Sequence[int],
    hand: HandLayout,
    gradient: Mapping[str, Mapping[str, float]],
    *,
    most: int,
    draws: int,
    seed: int,
) -> dict[str, Any]:
    """What absence costs, how well each unit does alone, and the best few.

    Args:
        refit: fits and evaluates.
        ranking: selects features again.
        selected: pool indices of the features that the detector has.
        hand: whose channels, fingers and kinds are gone through.
        gradient: by channel, to be put into its row.
        most: of the best few, at most.
        draws: of recordings, for intervals.
        seed: of the draws.

    Returns:
        ``with_all``: machines with every sensor. ``units``: a row for every channel, finger and
        kind. ``best``: by these, the steps in which they join. Accuracies are fractions.
    """
    everything = frozenset(hand.names)
    as_selected, reselected = refit(selected), refit(ranking(everything))
    in_use = Counter(ranking.channels[index] for index in selected)

    def lost(whole: Result, part: Result) -> dict[str, dict[str, float]]:
        return {
            role: difference(counts, part.counts[role], draws, seed)
            for role, counts in whole.counts.items()
        }

    rows: list[dict[str, Any]] = []
    best: dict[str, list[dict[str, Any]]] = {}
    for unit, members in _units_of(hand).items():
        for name, channels in bar(list(members.items()), f"without each {unit}"):
            choices = [
                without(selected, channels, ranking.channels),
                ranking(everything - channels),
                ranking(channels),
            ]
            fewer, again, alone = thread_map(refit, choices)
            rows.append(
                {
                    "unit": unit,
                    "name": name,
                    "num_channels": len(channels),
                    "features_in_use": sum(in_use[channel] for channel in channels),
                    "gradient": dict(gradient[name]) if unit == "channel" else None,
                    "lost": lost(as_selected, fewer),
                    "lost_reselected": lost(reselected, again),
                    "alone": alone.accuracies,
                }
            )
        best[unit] = [
            {"joins": name, "lost": lost(reselected, result)} | result.to_dict()
            for name, result in best_first(refit, ranking, members, most, f"best {unit}s")
        ]
    return {
        "with_all": {"as_selected": as_selected.to_dict(), "reselected": reselected.to_dict()},
        "units": rows,
        "best": best,
    }

"""Recipes: from labelled bins to a machine, ``General`` (the default) and ``Paper``.

Each reads the training bins twice: once for statistics and a bounded sample, by which features,
scaling and penalty are chosen, and once to solve for the machine. In a run of several processes
each reads its own recordings; the first one chooses and solves for all.
"""

from __future__ import annotations

import itertools
import logging
import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from numbers import Real
from typing import Any

import torch
from torch import Tensor

from tactslip_torch.data.recording import PAPER_SCENE
from tactslip_torch.features.descriptors import SPECTRUM_DESCRIPTORS, TIME_DESCRIPTORS
from tactslip_torch.features.pool import FeaturePool, is_rounding
from tactslip_torch.features.selection import (
    ClassMoments,
    checked_attributes,
    matching,
    rank_features,
    t_scores,
)
from tactslip_torch.features.sensing import (
    Sensing,
    SpanFeatures,
    least_alive,
    most_stuck_samples,
)
from tactslip_torch.model.detector import SlipDetector, counted_channels
from tactslip_torch.model.fit import HeldOut, TrainingBins, fit_machine
from tactslip_torch.model.kernels import PAPER_KERNEL, Polynomial, QuadraticForm
from tactslip_torch.model.moments import SufficientStats
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.runtime import (
    add_over_processes,
    bar,
    check_choice,
    check_number,
    from_first_process,
    gathered,
    one_thread,
)
from tactslip_torch.signals.filtering import ChannelFilter
from tactslip_torch.training.bins import BinSample, RecordingBins, SampledBins, bin_keys
from tactslip_torch.training.choice import (
    CandidateBins,
    Choice,
    FeatureSelection,
    Structure,
    balanced_accuracy,
    choose_model,
    platt_or_none,
)

log = logging.getLogger(__name__)

FREE_CONSTANT = 1.0e6
"""``c`` of degree 1, where it weighs the constant alone: so large, the penalty does not reach it.
A penalised constant moves the threshold of a machine with few bins or a strong penalty."""
POOLING = ("mean", "std", "min", "max")
"""Statistics over channels of the default."""
MOST_DUAL_BINS = 2500
"""Up to so many training bins a machine of degree 2 on all features is a candidate: it does not
fold, so its cost grows with the bins."""
MOST_SQUARE_BINS = 60_000
"""Up to so many training bins degree 2 is a candidate beside degree 1: the 7,381 products of 120
columns take some minutes of a processor for as many bins."""


@dataclass(frozen=True)
class _Plan:
    """All that is decided before the solve."""

    selection: FeatureSelection
    kernel: Polynomial
    penalty: float
    imputation: Tensor
    sensing: Sensing
    num_bins: int
    sample: SampledBins
    weights: dict[str, tuple[float, float]]
    validation: list[dict[str, Any]]
    nested: dict[str, Any] | None = None


@dataclass(frozen=True)
class Fit(_Plan):
    """A machine, and how it was made.

    Attributes:
        selection: which features, how scaled; indices are those of the bins' features.
        kernel: of the machine.
        penalty: the paper's ``C``.
        imputation: mean of the scaled columns, both classes counting alike; for lost channels.
        sensing: spans of channels that work, of the training bins.
        num_bins: how many bins are trained on; about, where classes are undersampled.
        sample: of the training bins.
        weights: of each bin by scene, non-slip and slip; of ``Paper`` the part that is trained on.
        validation: one row per candidate, with the balanced accuracy of each held-out group; the
            one that was taken has ``chosen`` and the ``calibration`` of its held-out scores.
        nested: balanced accuracy of the whole choice on groups that it did not see, if measured.
        head: the machine.
    """

    head: QuadraticForm = field(kw_only=True)

    @property
    def calibration(self) -> dict[str, Any] | None:
        """By held-out scores of the choice that was taken; None if there was nothing to choose."""
        chosen = (row.get("calibration") for row in self.validation if row.get("chosen"))
        return next(chosen, None)

    @property
    def metadata(self) -> dict[str, Any]:
        """How the machine was made, for files, JSON-able."""
        return {
            "kernel": self.kernel.to_dict(),
            "penalty": self.penalty if math.isfinite(self.penalty) else "inf",  # JSON has none
            "num_bins": self.num_bins,
            "validation": self.validation,
            "nested_validation": self.nested,
            "head": self.head.cost._asdict(),
            "solve": {} if self.head.solved is None else self.head.solved.metadata(),
        }

    def detector(
        self,
        pool: FeaturePool,
        channel_filter: ChannelFilter,
        metadata: Mapping[str, Any],
    ) -> SlipDetector:
        """The detector with this machine.

        Args:
            pool: of the features of the bins, whole or a selection of one.
            channel_filter: of the bins.
            metadata: to be kept with it, JSON-able.
        """
        whole = FeaturePool(pool.hand, **pool.config(), backend=pool.backend)
        selection = self.selection
        return SlipDetector(
            whole,
            channel_filter,
            tuple(pool.selected[index] for index in selection.selected),
            selection.scaler,
            self.head,
            metadata,
            self.imputation,
            selection.pooling,
            sensing=self.sensing,
            backend=whole.backend,
        )


@dataclass(frozen=True)
class _Recipe(ABC):
    """What both recipes have."""

    name: str
    penalties: float | Sequence[float]
    sample_bins: int = 400
    feature_filter: Mapping[str, str | Sequence[str]] | None = None
    descriptors: Sequence[str] | None = None
    min_alive: int | None = None

    def __post_init__(self) -> None:
        for name, value in vars(self).items():  # lists of a configuration
            if isinstance(value, list):
                object.__setattr__(self, name, tuple(value))
        check_number("recipe.sample_bins", self.sample_bins, least=2, whole=True)
        if self.min_alive is not None:
            check_number("recipe.min_alive", self.min_alive, whole=True)
        penalties = self.penalties_ascending
        if not penalties or not all(penalty > 0 for penalty in penalties):
            raise ValueError(f"recipe.penalties must be positive, got {list(penalties)!r}")
        if len(penalties) > 1 and not math.isfinite(penalties[-1]):
            raise ValueError(
                "recipe.penalties: validation needs finite values; give inf alone, or leave it out"
            )
        if self.feature_filter is not None:
            checked_attributes("recipe.feature_filter", self.feature_filter)

    @property
    def penalties_ascending(self) -> tuple[float, ...]:
        """Values of C to choose from, as numbers."""
        return tuple(sorted(_numbers("recipe.penalties", self.penalties)))

    def allowed(self, pool: FeaturePool) -> Tensor:
        """Which features of a pool may be selected, ``[F]``, bool.

        Those that rounding decides, as some wavelets have them, never may, and neither may those
        that the paper does not have.

        Raises:
            ValueError: if ``descriptors`` or ``feature_filter`` names what no feature has, or
                nothing matches.
        """
        mask = ~is_rounding(pool) & pool.is_paper
        if self.descriptors is not None:
            known = {*TIME_DESCRIPTORS, *SPECTRUM_DESCRIPTORS, "band_energy_ratio"}
            if unknown := [name for name in self.descriptors if name not in known]:
                raise ValueError(
                    f"recipe.descriptors: unknown {unknown[0]!r}, expected some of "
                    f"{', '.join(sorted(known))}"
                )
            mask &= torch.tensor([name.descriptor in self.descriptors for name in pool.names])
        if self.feature_filter is not None:
            try:
                mask &= matching(pool.hand, pool.names, self.feature_filter)
            except ValueError as error:
                raise ValueError(f"recipe.feature_filter: {error}") from None
        if not bool(mask.any()):
            raise ValueError(
                "recipe.feature_filter: no feature of recipe.descriptors matches that is more than "
                "rounding; ask for others"
            )
        return mask

    def fit(
        self,
        bins: Iterable[RecordingBins],
        pool: FeaturePool,
        *,
        is_nested: bool = True,
        show: bool = False,
    ) -> Fit:
        """Choose a machine and fit it.

        Args:
            bins: training bins; they are gone through twice.
            pool: of their features, whole or a selection.
            is_nested: whether a nested validation also evaluates the choice itself.
            show: progress bars.

        Raises:
            ValueError: if a class is absent, or a solve fails.
        """
        statistics = self._statistics(pool)
        with one_thread():  # a recording is small: threads would mostly wait
            for some in bins:
                statistics.update(some)
        statistics = _merged(statistics)
        plan: _Plan = from_first_process(lambda: self._plan(statistics, pool, is_nested, show))
        size, degree, kept = plan.selection.size, plan.kernel.degree, {}
        sums = None  # where bins are fewer than products, which may have no place in memory
        if plan.num_bins > plan.kernel.num_monomials(size):
            sums = SufficientStats(size, degree=degree)
        with one_thread():
            for some in bins:
                part = self._weighted(plan, some)
                if sums is None:
                    kept[some.name] = part
                else:
                    sums.update(some.name, *part)
        if sums is None:
            kept = dict(itertools.chain(*(own.items() for own in gathered(kept))))
        else:
            add_over_processes(sums.sums, sums.count)

        def solve() -> QuadraticForm:
            if sums is not None:
                return sums.solve(plan.penalty, plan.kernel.offset, balance="none")
            columns = zip(*(kept[name] for name in sorted(kept)), strict=True)
            return fit_machine(TrainingBins(*map(torch.cat, columns)), plan.penalty, plan.kernel)

        return Fit(**vars(plan), head=from_first_process(solve))

    @abstractmethod
    def _statistics(self, pool: FeaturePool) -> BinSample | _Statistics:
        """What the first look at training bins gathers."""

    @abstractmethod
    def _plan(self, statistics: Any, pool: FeaturePool, is_nested: bool, show: bool) -> _Plan:
        """Choose by what was gathered."""

    @abstractmethod
    def _weighted(self, plan: _Plan, bins: RecordingBins) -> tuple[Tensor, Tensor, Tensor]:
        """Scaled bins ``[N, K]``, classes and weights ``[N]`` that the machine is fitted to."""

    def _planned(
        self,
        pool: FeaturePool,
        sample: SampledBins,
        selection: FeatureSelection,
        weight: Tensor,
        alive_fraction: float,
        **chosen: Any,
    ) -> _Plan:
        """A plan of what was chosen, and of what a selection learns of the sample besides."""
        channels = pool.hand.names
        used = sorted({channels.index(pool.names[i].channel) for i in selection.selected})
        num_counted = len(counted_channels(pool.hand, used, selection.pooling is not None))
        sensing = Sensing.fit(
            SpanFeatures(pool.hand, pool.names, pool.bin_samples)(sample.features),
            self.min_alive or least_alive(num_counted, alive_fraction),
            most_stuck_samples(pool.sample_rate_hz, sample.longest_run),
        )
        imputation = _class_mean(selection(sample.features), sample.is_slip, weight)
        return _Plan(selection, imputation=imputation, sensing=sensing, sample=sample, **chosen)


@dataclass(frozen=True)
class General(_Recipe):
    """Features of each channel, pooled over channels, or both, chosen by nested validation.

    Features are compressed by a signed logarithm and scaled by quantiles; classes weigh alike.

    Args:
        name: for tables.
        penalties: the paper's ``C``. Of several values of this, ``use``, ``num_features`` and
            ``degree`` validation chooses one; a grid that ends at its edge is extended.
        sample_bins: bins of each group and class that choices are made by.
        feature_filter: only features that match are used, such as ``{"kind": "SG", "descriptor":
            "mean"}``: of each attribute a value, or one of several.
        descriptors: those that may be used; by default none that jumps with the last digit or needs
            sorting; ``None``: all.
        min_alive: channels that must be alive for a valid decision, of the fast ones in use (of all
            in use, where nothing is pooled). ``None``: as many as the second copies have at least;
            half where nothing is pooled.
        use: ``"channel"`` features, ``"pooled"`` ones or ``"both"``.
        num_features: how many are selected, best first; ``None`` takes all.
        degree: of the polynomial kernel, 1 or 2; of both, only 1 is a candidate for more than
            60,000 training bins.
        pooling: statistics over the channels of a kind, as ``features.pooling`` has them.
        tolerance: choices within so much of the best balanced accuracy are as good: of them, the
            simplest machine with the strongest penalty is taken.
        scene_weights: weight of a kind of scene beside the paper's: of all its bins of a class
            together, as a part of the protocol's bins of that class. Scenes that are not named
            count bin by bin.
        drop_channels: of every recording a second copy is trained on, from which up to this part
            of the channels is left out at random. For pooled features.

    Raises:
        ValueError: for an unknown name or a number out of range.
    """

    name: str = "general"
    penalties: float | Sequence[float] = (1e-4, 1e-3, 1e-2, 1e-1, 1.0)
    use: str | Sequence[str] = ("channel", "pooled", "both")
    num_features: int | Sequence[int | None] | None = (None, 120)
    degree: int | Sequence[int] = (1, 2)
    descriptors: Sequence[str] | None = (
        "mean",
        "range",
        "mean_deviation",
        "std",
        "skewness",
        "kurtosis",
        "energy",
        "peak_factor",
        "correlation",
        "spectral_centroid",
        "spectral_spread",
        "band_energy_ratio",
    )
    pooling: str | Sequence[str] | None = POOLING
    tolerance: float = 0.005
    scene_weights: Mapping[str, float] = field(default_factory=dict)
    drop_channels: float = 0.5

    def __post_init__(self) -> None:
        super().__post_init__()
        for use in _several(self.use):
            check_choice("recipe.use", use, ("channel", "pooled", "both"))
        for num in _several(self.num_features):
            if num is not None:
                check_number("recipe.num_features", num, whole=True)
        for name in ("tolerance", "drop_channels"):
            if not 0 <= _numbers(f"recipe.{name}", getattr(self, name))[0] < 1:
                raise ValueError(f"recipe.{name} must lie in [0, 1), got {getattr(self, name)!r}")
        for weight in self.scene_weights.values():
            check_number("recipe.scene_weights", weight)
        if set(_several(self.use)) != {"channel"} and self.pooling is None:
            raise ValueError(
                "recipe.use=pooled needs statistics over channels; set features.pooling=[mean, std]"
            )
        _ = self.kernels  # their own checks

    @property
    def kernels(self) -> tuple[Polynomial, ...]:
        """Kernels to choose from, the lower degree first."""
        offset = PAPER_KERNEL.offset
        return tuple(
            Polynomial(degree, FREE_CONSTANT if degree == 1 else offset)
            for degree in sorted(_several(self.degree))
        )

    def _statistics(self, pool: FeaturePool) -> BinSample:
        return BinSample(self.sample_bins)

    def _weighted(self, plan: _Plan, bins: RecordingBins) -> tuple[Tensor, Tensor, Tensor]:
        selection, is_slip = plan.selection, bins.is_slip
        z, of_class = selection(bins.features), torch.tensor(plan.weights[bins.scene]).double()
        if self.drop_channels == 0 or selection.pooling is None:
            return z, is_slip, of_class[is_slip.long()]
        is_lost = _dropped(bins.name, len(selection.pooling.hand), self.drop_channels)
        fewer = selection(bins.features, is_lost.expand(len(z), -1))
        return torch.cat([z, fewer]), is_slip.repeat(2), of_class[is_slip.long()].repeat(2) / 2

    def _plan(self, statistics: BinSample, pool: FeaturePool, is_nested: bool, show: bool) -> _Plan:
        sample = statistics.bins()
        allowed = self.allowed(pool)
        weights = self.weights(sample)
        table = torch.tensor([weights[scene] for scene in sample.scene_names])
        weight = sample.weight * table.double()[sample.scene, sample.is_slip.long()]
        candidates = CandidateBins(sample, weight, pool, allowed, self.pooling)
        num_bins = round(float(sample.weight.sum()))
        structures, penalties = self._structures(num_bins), self.penalties_ascending
        if (num_whole := len(candidates.whole_groups())) > 1:
            how = {"is_nested": is_nested, "show": show}
            choice = choose_model(candidates, structures, penalties, self.tolerance, **how)
        else:
            choice = Choice(structures[0], penalties[len(penalties) // 2])
            log.warning(
                "no recordings are left out to choose by: that needs two groups with slip and "
                "non-slip, got %d of %s; C=%g is taken",
                num_whole,
                ", ".join(candidates.group_names),
                choice.penalty,
            )
        selection = candidates.select(choice.structure)
        is_pooled = selection.pooling is not None and self.drop_channels > 0
        fraction = 1 - self.drop_channels if is_pooled else 0.5
        return self._planned(
            pool,
            sample,
            selection,
            weight,
            fraction,
            kernel=choice.structure.kernel,
            penalty=choice.penalty,
            num_bins=num_bins,
            weights=weights,
            validation=choice.rows,
            nested=choice.nested,
        )

    def _structures(self, num_bins: int) -> list[Structure]:
        """All structures for a machine of so many training bins, the simplest first.

        Raises:
            ValueError: if there is none.
        """
        sizes = sorted(_several(self.num_features), key=lambda size: (size is not None, size or 0))
        may_grow = num_bins <= MOST_DUAL_BINS
        may_square = num_bins <= MOST_SQUARE_BINS or len(self.kernels) == 1
        found = [
            Structure(use, size, kernel)
            for size, kernel, use in itertools.product(sizes, self.kernels, _several(self.use))
            if kernel.degree == 1
            or may_grow
            or (may_square and size is not None and not self.scene_weights)
        ]
        if not found:
            raise ValueError(
                "no candidate is left: degree 2 needs recipe.num_features and no scene_weights; "
                "add degree 1"
            )
        return found

    def weights(self, sample: SampledBins) -> dict[str, tuple[float, float]]:
        """The weight of each bin of a scene, non-slip and slip, with both classes balanced.

        Raises:
            ValueError: if a class is absent, or a scene is weighed that no recording is of.
        """
        _class_counts(sample)  # refuses one that is absent
        scenes = sample.scene_names
        if strangers := sorted(set(self.scene_weights) - set(scenes) - {PAPER_SCENE}):
            raise ValueError(
                f"recipe.scene_weights names {strangers[0]!r}, of which there is no training "
                f"recording; there is {', '.join(scenes)}"
            )
        totals = torch.zeros(len(scenes), 2, dtype=torch.float64)
        totals.index_put_((sample.scene, sample.is_slip.long()), sample.weight, True)
        weights = torch.ones_like(totals)
        protocol = totals[scenes.index(PAPER_SCENE)] if PAPER_SCENE in scenes else 0 * totals[0]
        for row, scene in enumerate(scenes):
            wanted = self.scene_weights.get(scene, 0.0) * protocol / totals[row]
            weights[row] = torch.where((wanted > 0) & wanted.isfinite(), wanted, 1.0)
        counts = (totals * weights).sum(0)
        weights *= counts.sum() / (2 * counts)
        return {scene: (a, b) for scene, (a, b) in zip(scenes, weights.tolist(), strict=True)}


@dataclass(frozen=True)
class Paper(_Recipe):
    """The paper's: features the t-test ranks highest, min-max scaling, a polynomial kernel ELM.

    Ranking and scaling take every training bin; the classes are undersampled to one size. ``C`` is
    chosen by leaving out groups of the sample; ranking and scaling have seen them, so these scores
    are for model selection only.

    Args:
        name: for tables.
        penalties: the paper's ``C``; of several values validation chooses one.
        sample_bins: bins of each group and class that ``C`` is chosen by.
        feature_filter: as in ``General``; ``num_features`` is cut to what matches.
        descriptors: as in ``General``.
        min_alive: as in ``General``.
        num_features: how many are selected.
        degree: of the polynomial kernel, 1 or 2.
        offset: of the polynomial kernel, its ``c``.

    Raises:
        ValueError: for an unknown name or a number out of range.
    """

    name: str = "paper"
    penalties: float | Sequence[float] = (0.05, 0.08, 0.1, 0.13, 0.17, 0.2, 0.25, 0.3, 1.0, 3.0)
    num_features: int = 120
    degree: int = PAPER_KERNEL.degree
    offset: float = PAPER_KERNEL.offset

    def __post_init__(self) -> None:
        super().__post_init__()
        check_number("recipe.num_features", self.num_features, whole=True)
        _ = self.kernel  # its own checks

    @property
    def kernel(self) -> Polynomial:
        """The kernel."""
        return Polynomial(self.degree, self.offset)

    def allowed(self, pool: FeaturePool) -> Tensor:
        """As ``General.allowed``; refuses a pool with fewer features than are to be selected."""
        mask = super().allowed(pool)
        num = int(mask.sum())
        if self.num_features > num and self.feature_filter is None:
            raise ValueError(
                f"recipe.num_features={self.num_features} exceeds the pool's {num}; give at most "
                f"{num}"
            )
        return mask

    def _statistics(self, pool: FeaturePool) -> _Statistics:
        return _Statistics(len(pool.names), self.sample_bins)

    def _weighted(self, plan: _Plan, bins: RecordingBins) -> tuple[Tensor, Tensor, Tensor]:
        is_slip, fractions = bins.is_slip, torch.tensor(plan.weights[PAPER_SCENE]).double()
        kept = bin_keys(bins.name, len(is_slip)) < fractions[is_slip.long()]
        z = plan.selection(bins.features[kept])
        return z, is_slip[kept], torch.ones(len(z), dtype=torch.float64)

    def _plan(
        self, statistics: _Statistics, pool: FeaturePool, is_nested: bool, show: bool
    ) -> _Plan:
        sample = statistics.sample.bins()
        counts = _class_counts(sample)
        fractions = min(counts) / counts[0], min(counts) / counts[1]
        weight = sample.weight * torch.tensor(fractions).double()[sample.is_slip.long()]
        places = self.allowed(pool).nonzero()[:, 0]
        size = min(self.num_features, len(places))
        if size < self.num_features:
            log.warning(
                "recipe.num_features=%d is cut to %d: no more match", self.num_features, size
            )
        best = places[rank_features(t_scores(statistics.moments)[places], size)].tolist()
        scaler = FeatureScaler(statistics.minimum[best].double(), statistics.maximum[best].double())
        selection = FeatureSelection(tuple(best), scaler)
        trained = TrainingBins(selection(sample.features), sample.is_slip, weight)
        penalty, rows = self._penalty(trained, sample, show)
        return self._planned(
            pool,
            sample,
            selection,
            weight,
            0.5,
            kernel=self.kernel,
            penalty=penalty,
            num_bins=2 * min(counts),
            weights={PAPER_SCENE: fractions},
            validation=rows,
        )

    def _penalty(
        self, bins: TrainingBins, sample: SampledBins, show: bool
    ) -> tuple[float, list[dict[str, Any]]]:
        """The penalty of the best mean balanced accuracy on left-out groups; a row for each."""
        penalties = self.penalties_ascending
        if len(penalties) == 1:
            return penalties[0], []
        if len(sample.group_names) < 2:
            middle = penalties[len(penalties) // 2]
            log.warning("C=%g is taken unvalidated: one group", middle)
            return middle, []
        rows, scored = list[dict[str, Any]](), list[Tensor]()
        sample = sample.joined()
        machine = HeldOut(bins, sample.group, self.kernel)
        for penalty in bar(penalties, "choose C on held-out groups", show=show):
            scores = machine.at(penalty).scores
            by_group = {
                name: balanced_accuracy(scores[mine] >= 0, bins.is_slip[mine])
                for index, name in enumerate(sample.group_names)
                for mine in [sample.group == index]
            }
            known = [value for value in by_group.values() if value is not None]
            if not known:
                raise ValueError(
                    "no validation group has bins of both classes; add recordings, or give one "
                    "value of recipe.penalties"
                )
            scored.append(scores)
            rows.append(
                {
                    "num_features": bins.features.shape[1],
                    "kernel": self.kernel.to_dict(),
                    "penalty": penalty,
                    "mean": sum(known) / len(known),
                    "balanced_accuracy": by_group,
                }
            )
        best, scores = max(zip(rows, scored, strict=True), key=lambda of: float(of[0]["mean"]))
        calibration = platt_or_none(scores, bins.is_slip, bins.weights)
        best |= {"chosen": True, "calibration": calibration}
        return best["penalty"], rows


Recipe = General | Paper
"""How a detector is made."""


def _class_counts(sample: SampledBins) -> list[int]:
    """How many training bins of non-slip and of slip a sample was drawn from.

    Raises:
        ValueError: if there is none of a class.
    """
    counts = [round(float(sample.weight[mine].sum())) for mine in (~sample.is_slip, sample.is_slip)]
    for name, count in zip(("non-slip", "slip"), counts, strict=True):
        if not count:
            raise ValueError(f"training needs bins of both classes, got no {name} bin")
    return counts


class _Statistics:
    """Moments, ranges and a sample of training bins."""

    def __init__(self, num_features: int, sample_bins: int) -> None:
        self.moments = ClassMoments(num_features)
        self.minimum = torch.full((num_features,), torch.inf)
        self.maximum = -self.minimum
        self.sample = BinSample(sample_bins)

    def update(self, bins: RecordingBins) -> None:
        """Add a recording."""
        try:
            self.moments.update(bins.features, bins.is_slip)
        except ValueError as error:
            raise ValueError(f"recording {bins.name!r}: {error}") from None
        self.sample.update(bins)
        if len(bins.features):
            self._widen(bins.features.amin(0), bins.features.amax(0))

    def merge(self, other: _Statistics) -> None:
        """Add the recordings of another process."""
        self.moments.merge(other.moments)
        self.sample.merge(other.sample)
        self._widen(other.minimum, other.maximum)

    def _widen(self, minimum: Tensor, maximum: Tensor) -> None:
        # which of 0 and -0 is taken depends on their order; adding 0 leaves 0 alone
        self.minimum = torch.minimum(self.minimum, minimum) + 0.0
        self.maximum = torch.maximum(self.maximum, maximum) + 0.0


def _dropped(recording: str, num: int, largest: float) -> Tensor:
    """Channels that the second copy of a recording is without, ``[num]``, bool."""
    keys = bin_keys(f"{recording}, channels", num + 1)
    order = keys[1:].argsort()[: math.floor(float(keys[0]) * (math.floor(largest * num) + 1))]
    return torch.zeros(num, dtype=torch.bool).index_fill(0, order, True)


def _class_mean(z: Tensor, is_slip: Tensor, weight: Tensor) -> Tensor:
    """Mean of columns, both classes counting alike, ``[N, K] -> [K]``."""
    means = [weight[mine] @ z[mine] / weight[mine].sum() for mine in (is_slip, ~is_slip)]
    return (means[0] + means[1]) / 2


def _several(value: Any) -> tuple[Any, ...]:
    is_several = isinstance(value, Sequence) and not isinstance(value, str)
    return tuple(value) if is_several else (value,)


def _numbers(name: str, value: Any) -> list[float]:
    """A number or several.

    Raises:
        ValueError: for what is none.
    """
    for each in _several(value):
        if not isinstance(each, Real) or isinstance(each, bool):
            raise ValueError(f"{name} must be a number, got {each!r}")
    return [float(each) for each in _several(value)]


def _merged(own: Any) -> Any:
    """What every process holds, put together in the order of their ranks."""
    values = gathered(own)
    for other in values[1:]:
        values[0].merge(other)
    return values[0]

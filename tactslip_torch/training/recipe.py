"""Recipes: from labelled bins to a machine, ``General`` (the default) and ``Paper``.

Each reads the training bins twice: once for statistics and a bounded sample, by which features,
scaling and penalty are chosen, and once to solve for the machine. In a run of several processes
each reads its own recordings; the first one chooses and solves for all.
"""

from __future__ import annotations

import hashlib
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
from tactslip_torch.features.cost import MACHINES, WorkCosts
from tactslip_torch.features.descriptors import SPECTRUM_DESCRIPTORS, TIME_DESCRIPTORS
from tactslip_torch.features.pool import FeaturePool, is_rounding, is_simple_of
from tactslip_torch.features.selection import (
    ClassMoments,
    checked_attributes,
    matching,
    rank_features,
    t_scores,
)
from tactslip_torch.features.sensing import Sensing, SpanFeatures, least_alive, most_stuck_samples
from tactslip_torch.model.calibration import platt_or_none
from tactslip_torch.model.detector import SlipDetector, counted_channels
from tactslip_torch.model.fit import HeldOut, TrainingBins, fit_machine
from tactslip_torch.model.kernels import PAPER_KERNEL, Polynomial, QuadraticForm
from tactslip_torch.model.moments import SufficientStats
from tactslip_torch.model.ridge import ClassSums
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.report.metrics import balanced_accuracy
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
from tactslip_torch.training.columns import VIEWS, FeatureSelection
from tactslip_torch.training.views import (
    THRESHOLDS,
    Choice,
    View,
    ViewBins,
    ViewSettings,
    base_views,
    choose_views,
    merged,
    sums_by_group,
)

log = logging.getLogger(__name__)

POOLING = ("mean", "std", "min", "max")
"""Statistics over channels of the default."""


class _Fitted(ABC):
    """What the fits of two classes and of several share."""

    selection: FeatureSelection
    imputation: Tensor
    sensing: Sensing

    @property
    @abstractmethod
    def first_head(self) -> QuadraticForm:
        """The machine that a detector gets."""

    def detector(
        self,
        pool: FeaturePool,
        channel_filter: ChannelFilter,
        metadata: Mapping[str, Any],
    ) -> SlipDetector:
        """The detector with this machine; of several classes with the first.

        Args:
            pool: of the features of the bins, whole or a selection of one.
            channel_filter: of the bins.
            metadata: to be kept with it, JSON-able.
        """
        whole = FeaturePool(pool.hand, **pool.config(), backend=pool.backend)
        return SlipDetector(
            whole,
            channel_filter,
            tuple(pool.selected[index] for index in self.selection.selected),
            self.selection.scaler,
            self.first_head,
            metadata,
            self.imputation,
            self.selection.pooling,
            sensing=self.sensing,
            backend=whole.backend,
        )


@dataclass(frozen=True)
class Fit(_Fitted):
    """A machine, and how it was made.

    Attributes:
        selection: which features, how scaled; indices are those of the bins' features.
        head: the machine.
        imputation: scaled columns of lost channels.
        sensing: spans of channels that work, of the training bins.
        num_bins: how many bins are trained on; about, where classes are undersampled.
        sample: of the training bins.
        weights: of each bin by scene, non-slip and slip; of ``Paper`` the part that is trained on.
        penalty: C; of several views that of the one that weighs most.
        made: how it was made, for files, JSON-able.
        validation: one row per candidate, with the balanced accuracy of each held-out group; those
            that were taken have ``chosen``.
        nested: balanced accuracy of the choice on groups that it did not see, if measured.
        calibration: of held-out scores; ``None`` if there was nothing to choose.
    """

    selection: FeatureSelection
    head: QuadraticForm
    imputation: Tensor
    sensing: Sensing
    num_bins: int
    sample: SampledBins
    weights: dict[str, tuple[float, float]]
    penalty: float
    made: dict[str, Any]
    validation: list[dict[str, Any]]
    nested: dict[str, Any] | None = None
    calibration: dict[str, Any] | None = None

    @property
    def metadata(self) -> dict[str, Any]:
        """How the machine was made, for files, JSON-able."""
        return {
            **self.made,
            "penalty": self.penalty if math.isfinite(self.penalty) else "inf",  # JSON has none
            "num_bins": self.num_bins,
            "validation": self.validation,
            "nested_validation": self.nested,
            "head": self.head.cost._asdict(),
            "solve": {} if self.head.solved is None else self.head.solved.metadata(),
        }

    @property
    def first_head(self) -> QuadraticForm:
        """The machine."""
        return self.head


@dataclass(frozen=True)
class ClassFit(_Fitted):
    """Machines of several classes, one for each, on the same columns.

    Attributes:
        selection: as ``Fit`` has it.
        heads: one for each class, above 0 for it; of two classes one, for the second.
        imputation: as ``Fit`` has it.
        sensing: as ``Fit`` has it.
        choice: of views, with what validation says and the calibration of each head.
    """

    selection: FeatureSelection
    heads: tuple[QuadraticForm, ...]
    imputation: Tensor
    sensing: Sensing
    choice: Choice

    @property
    def first_head(self) -> QuadraticForm:
        """That of the first class."""
        return self.heads[0]


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

        Those that rounding decides, as some wavelets have them, never may.

        Raises:
            ValueError: if ``descriptors`` or ``feature_filter`` names what no feature has, or
                nothing matches.
        """
        mask = ~is_rounding(pool) & self._offered(pool)
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

    def _offered(self, pool: FeaturePool) -> Tensor:
        """Features that the recipe may take at all, ``[F]``, bool."""
        return pool.is_paper

    def wanted(self, pool: FeaturePool, with_baselines: bool = True) -> Tensor:
        """The features of a whole pool that training reads, ``[F]``, bool."""
        mask, is_simple = pool.is_paper, is_simple_of(pool)
        if self.descriptors is not None:
            wanted = {*self.descriptors, "range"}  # ranges tell which channels are silent
            mask &= torch.tensor([name.descriptor in wanted for name in pool.names])
        return mask | is_simple if with_baselines else mask

    @abstractmethod
    def fit(self, bins: Iterable[RecordingBins], pool: FeaturePool, *, show: bool = False) -> Fit:
        """Choose a machine and fit it.

        Args:
            bins: training bins; they are gone through twice.
            pool: of their features, whole or a selection.
            show: progress bars.

        Raises:
            ValueError: if a class is absent, or a solve fails.
        """

    def _sensing(
        self,
        pool: FeaturePool,
        features: Tensor,
        longest_run: int | None,
        selection: FeatureSelection,
        alive_fraction: float,
    ) -> Sensing:
        """Of the channels that a selection reads, by features of training bins ``[N, F]``."""
        channels = pool.hand.names
        used = sorted({channels.index(pool.names[i].channel) for i in selection.selected})
        num_counted = len(counted_channels(pool.hand, used, selection.pooling is not None))
        return Sensing.fit(
            SpanFeatures(pool.hand, pool.names, pool.bin_samples)(features),
            self.min_alive or least_alive(num_counted, alive_fraction),
            most_stuck_samples(pool.sample_rate_hz, longest_run, has_fast=bool(pool.hand.fast)),
        )


@dataclass(frozen=True)
class General(_Recipe):
    """Views of the same bins, a machine for each, and the mean of their scores (``views.py``).

    Classes weigh alike. Penalties, weights of views and threshold are chosen by leaving out groups
    of a sample; the machines of degree 1 are then fitted to all training bins.

    Args:
        name: for tables.
        penalties: values of C, with kernels whose mean diagonal is 1: small ones are the strong
            penalties. Of several validation chooses one for each view.
        sample_bins: bins of each group and class that choices are made by.
        feature_filter: only features that match are used, such as ``{"kind": "SG", "descriptor":
            "mean"}``: of each attribute a value, or one of several.
        descriptors: those that the views ``channel`` and ``pooled`` may use; by default none that
            jumps with the last digit or needs sorting; ``None``: all.
        min_alive: channels that must be alive for a valid decision, of the fast ones in use (of all
            in use, where nothing is pooled). ``None``: as many as the second copies have at least;
            half where nothing is pooled.
        views: some of ``simple`` (statistics of the bin of each channel), ``channel`` (descriptors
            of its branches and spectra) and ``pooled`` (statistics of those over channels).
            Validation drops those that do no good.
        num_features: columns of each view, the best together; ``None`` takes all.
        per_cost: ``m7`` or ``x86``: of columns with ``num_features`` those with the largest gain
            for their cost there (``features.cost``); ``None``: by gain alone.
        threshold: part of the validated shift of the threshold that is applied, ``zero``, ``half``
            or ``full``.
        pooling: statistics over the channels of a kind, as ``features.pooling`` has them.
        tolerance: a stronger penalty is as good where it makes at most this part more errors.
        scene_weights: weight of a kind of scene beside the paper's: of all its bins of a class
            together, as a part of the protocol's bins of that class. Scenes that are not named
            count bin by bin.
        drop_channels: of every bin the view ``pooled`` is trained on a second copy, from which up
            to this part of the channels is left out at random.

    Raises:
        ValueError: for an unknown name or a number out of range.
    """

    name: str = "general"
    penalties: float | Sequence[float] = (0.1, 0.3, 1.0, 3.0, 10.0, 100.0)
    views: str | Sequence[str] = VIEWS
    num_features: int | None = None
    per_cost: str | None = None
    threshold: str = "half"
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
    tolerance: float = 0.03
    scene_weights: Mapping[str, float] = field(default_factory=dict)
    drop_channels: float = 0.5

    def __post_init__(self) -> None:
        super().__post_init__()
        for view in _several(self.views):
            check_choice("recipe.views", view, VIEWS)
        if not self.views_in_order:
            raise ValueError(f"recipe.views must be some of {', '.join(VIEWS)}, got none")
        check_choice("recipe.threshold", self.threshold, tuple(THRESHOLDS))
        if self.num_features is not None:
            check_number("recipe.num_features", self.num_features, whole=True)
        if self.per_cost is not None:
            check_choice("recipe.per_cost", self.per_cost, MACHINES)
            if self.num_features is None:
                raise ValueError("recipe.per_cost chooses columns: give recipe.num_features too")
        for name in ("tolerance", "drop_channels"):
            if not 0 <= _numbers(f"recipe.{name}", getattr(self, name))[0] < 1:
                raise ValueError(f"recipe.{name} must lie in [0, 1), got {getattr(self, name)!r}")
        if not math.isfinite(self.penalties_ascending[-1]):
            raise ValueError("recipe.penalties must be finite with recipe=general")
        for weight in self.scene_weights.values():
            check_number("recipe.scene_weights", weight)
        if "pooled" in self.views_in_order and self.pooling is None:
            raise ValueError(
                "recipe.views=[pooled] needs statistics over channels; set features.pooling=[mean, "
                "std]"
            )

    @property
    def views_in_order(self) -> tuple[str, ...]:
        """The views, each once, in the order of ``VIEWS``."""
        return tuple(view for view in VIEWS if view in _several(self.views))

    def wanted(self, pool: FeaturePool, with_baselines: bool = True) -> Tensor:
        """As ``_Recipe`` has it."""
        return super().wanted(pool, with_baselines or "simple" in self.views_in_order)

    def allowed_by_view(self, pool: FeaturePool) -> dict[str, Tensor]:
        """Which features each view may use, ``[F]``, bool.

        Raises:
            ValueError: as ``allowed``, or if a view has none.
        """
        described, simple = self.allowed(pool), is_simple_of(pool)
        if self.feature_filter is not None:
            simple &= matching(pool.hand, pool.names, self.feature_filter)
        masks = {view: simple if view == "simple" else described for view in self.views_in_order}
        if none := [view for view, mask in masks.items() if not bool(mask.any())]:
            raise ValueError(
                f"the view {none[0]!r} of recipe.views has no feature that matches "
                "recipe.feature_filter; leave it out, or ask for others"
            )
        return masks

    def settings(self) -> ViewSettings:
        """How views are chosen."""
        return ViewSettings(
            self.views_in_order,
            self.penalties_ascending,
            self.tolerance,
            self.threshold,
            self.num_features,
            self.pooling,
        )

    def _base_views(self, bins: ViewBins, pool: FeaturePool) -> list[View]:
        """Views with all of their columns and, where cost counts, what each column costs."""
        costs = None if self.per_cost is None else WorkCosts.measured(pool, self.per_cost).table
        return base_views(bins, pool, self.allowed_by_view(pool), self.settings(), costs)

    def fit(self, bins: Iterable[RecordingBins], pool: FeaturePool, *, show: bool = False) -> Fit:
        """As ``_Recipe`` has it."""
        found = BinSample(self.sample_bins)
        with one_thread():  # a recording is small: threads would mostly wait
            for some in bins:
                found.update(some)
        sample = _merged(found).bins()
        weights = self.weights(sample)
        drawn, group_of = self._drawn(sample, weights, pool)
        views: list[View] = from_first_process(lambda: self._base_views(drawn, pool))
        sums = {view.name: sums_by_group(view, drawn) for view in views if view.degree == 1}
        with one_thread():
            for some in bins:
                for view in views:
                    if view.name in sums:
                        of_view = sums[view.name]
                        own = of_view[group_of.get(some.group, 0) if len(of_view) > 1 else 0]
                        self._add(own, view, some, weights, pool)
        for own in itertools.chain(*sums.values()):
            add_over_processes(*own.tensors)

        def solve() -> tuple[Choice, FeatureSelection, QuadraticForm]:
            choice = choose_views(drawn, views, self.settings(), sums, show)
            selection, (head,) = merged(choice, choice.parts(drawn))
            return choice.told(), selection, head

        choice, selection, head = from_first_process(solve)
        assert selection.fill is not None  # of views
        fraction = self._alive_fraction(selection)
        shares = choice.shares
        return Fit(
            selection=selection,
            head=head,
            imputation=selection.fill,
            sensing=self._sensing(pool, sample.features, sample.longest_run, selection, fraction),
            num_bins=round(float(sample.weight.sum())),
            sample=sample,
            weights=weights,
            penalty=choice.penalty,
            made={
                "views": shares,
                "penalties": dict(zip(shares, choice.penalties, strict=True)),
                "threshold_shift": choice.shift,
                "validated": None if math.isnan(choice.accuracy) else choice.accuracy,
            },
            validation=list(choice.rows),
            nested=choice.nested,
            calibration=next(iter(choice.calibration), None),
        )

    def fit_classes(self, bins: ViewBins, pool: FeaturePool) -> ClassFit:
        """Choose and fit a machine for each of several classes, by bins in memory.

        Views, penalties and weights are those of the best mean recall of the class of the highest
        score; features and factorisations are shared by all machines.
        """
        settings = self.settings()
        views = self._base_views(bins, pool)
        choice = choose_views(bins, views, settings)
        selection, heads = merged(choice, choice.parts(bins))
        assert selection.fill is not None  # of views
        fraction = self._alive_fraction(selection)
        sensing = self._sensing(pool, bins.features, None, selection, fraction)
        return ClassFit(selection, tuple(heads), selection.fill, sensing, choice.told())

    def _alive_fraction(self, selection: FeatureSelection) -> float:
        """Part of the channels that must be alive for a valid decision."""
        return 1 - self.drop_channels if selection.pooling and self.drop_channels else 0.5

    def second_copies(self, name: str, num_bins: int, pool: FeaturePool) -> Tensor | None:
        """Channels that second copies of bins are without, ``[N, C]``, bool; ``None``: no copies.

        Args:
            name: of their recording; that of a name is always the same.
            num_bins: how many.
            pool: of the hand.
        """
        if self.drop_channels == 0:
            return None
        return _dropped(name, num_bins, len(pool.hand), self.drop_channels)

    def _drawn(
        self, sample: SampledBins, weights: Mapping[str, tuple[float, float]], pool: FeaturePool
    ) -> tuple[ViewBins, dict[str, int]]:
        """The sample that choices are made by, and the number of each group's joined one."""
        table = torch.tensor([weights[scene] for scene in sample.scene_names]).double()
        weight = sample.weight * table[sample.scene, sample.is_slip.long()]
        joined = sample.joined()
        pairs = zip(sample.group.tolist(), joined.group.tolist(), strict=True)
        drawn = ViewBins(
            joined.features,
            joined.is_slip.long(),
            joined.group,
            joined.group_names,
            weight / weight.mean(),
            joined.stratum,
            self.second_copies("sample", len(joined.is_slip), pool),
        )
        return drawn, {sample.group_names[group]: number for group, number in pairs}

    def _add(
        self,
        sums: ClassSums,
        view: View,
        bins: RecordingBins,
        weights: Mapping[str, tuple[float, float]],
        pool: FeaturePool,
    ) -> None:
        """Add the bins of a recording to the sums of a view."""
        labels = bins.is_slip.long()
        if not len(labels):
            return
        weight = torch.tensor(weights[bins.scene]).double()[labels]
        if bins.weight is not None:
            weight = weight * bins.weight
        u, is_lost = view.units(bins.features), self.second_copies(bins.name, len(labels), pool)
        if is_lost is not None and view.name == "pooled":
            u = torch.cat([u, view.units(bins.features, is_lost)])
            labels, weight = labels.repeat(2), weight.repeat(2) / 2
        sums.update(u, labels, weight)

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

    def fit(self, bins: Iterable[RecordingBins], pool: FeaturePool, *, show: bool = False) -> Fit:
        """As ``_Recipe`` has it."""
        statistics = _Statistics(len(pool.names), self.sample_bins)
        with one_thread():  # a recording is small: threads would mostly wait
            for some in bins:
                statistics.update(some)
        statistics = _merged(statistics)
        sample = statistics.sample.bins()
        counts = _class_counts(sample)
        fractions = min(counts) / counts[0], min(counts) / counts[1]
        weight = sample.weight * torch.tensor(fractions).double()[sample.is_slip.long()]
        selection = self._selected(statistics, pool)
        trained = TrainingBins(selection(sample.features), sample.is_slip, weight)
        penalty, rows = from_first_process(lambda: self._penalty(trained, sample, show))
        head = self._solved(bins, selection, fractions, penalty, 2 * min(counts))
        chosen = (row.get("calibration") for row in rows if row.get("chosen"))
        return Fit(
            selection=selection,
            head=head,
            imputation=_class_mean(trained.features, sample.is_slip, weight),
            sensing=self._sensing(pool, sample.features, sample.longest_run, selection, 0.5),
            num_bins=2 * min(counts),
            sample=sample,
            weights={PAPER_SCENE: fractions},
            penalty=penalty,
            made={
                "kernel": self.kernel.to_dict(),
                "validated": max((float(row["mean"]) for row in rows), default=None),
            },
            validation=rows,
            calibration=next(chosen, None),
        )

    def _selected(self, statistics: _Statistics, pool: FeaturePool) -> FeatureSelection:
        """The features that the t-test ranks highest, scaled by their range."""
        places = self.allowed(pool).nonzero()[:, 0]
        size = min(self.num_features, len(places))
        if size < self.num_features:
            log.warning(
                "recipe.num_features=%d is cut to %d: no more match", self.num_features, size
            )
        best = places[rank_features(t_scores(statistics.moments)[places], size)].tolist()
        scaler = FeatureScaler(statistics.minimum[best].double(), statistics.maximum[best].double())
        return FeatureSelection(tuple(best), scaler)

    def _solved(
        self,
        bins: Iterable[RecordingBins],
        selection: FeatureSelection,
        fractions: tuple[float, float],
        penalty: float,
        num_bins: int,
    ) -> QuadraticForm:
        """The machine of an undersampled set of bins, drawn by their keys."""
        size, kept = selection.size, dict[str, tuple[Tensor, ...]]()
        sums = None  # where bins are fewer than products, which may have no place in memory
        if num_bins > self.kernel.num_monomials(size):
            sums = SufficientStats(size, degree=self.kernel.degree)
        with one_thread():
            for some in bins:
                share = torch.tensor(fractions).double()[some.is_slip.long()]
                mine = bin_keys(some.name, len(some.is_slip)) < share
                z, is_slip = selection(some.features[mine]), some.is_slip[mine]
                if sums is None:
                    kept[some.name] = z, is_slip
                else:
                    sums.update(some.name, z, is_slip, torch.ones(len(z), dtype=torch.float64))
        if sums is None:
            kept = dict(itertools.chain(*(own.items() for own in gathered(kept))))
        else:
            add_over_processes(sums.sums, sums.count)

        def solve() -> QuadraticForm:
            if sums is not None:
                return sums.solve(penalty, self.kernel.offset, balance="none")
            columns = zip(*(kept[name] for name in sorted(kept)), strict=True)
            return fit_machine(TrainingBins(*map(torch.cat, columns)), penalty, self.kernel)

        head: QuadraticForm = from_first_process(solve)
        return head

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
            scores = machine.at(penalty)
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


def _dropped(name: str, num_bins: int, num_channels: int, largest: float) -> Tensor:
    """Channels that the second copies of bins are without, up to a part, ``[N, C]``, bool."""
    seed = int.from_bytes(hashlib.blake2b(f"{name}, channels".encode(), digest_size=7).digest())
    generator = torch.Generator().manual_seed(seed)
    most = math.floor(largest * num_channels) + 1
    num = (torch.rand(num_bins, 1, generator=generator) * most).floor()
    return torch.rand(num_bins, num_channels, generator=generator).argsort(1).argsort(1) < num


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

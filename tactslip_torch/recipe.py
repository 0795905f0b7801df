"""How a detector is made: rank, scale, choose K, c and C on held-out groups, balance.

A ``Recipe`` is the choice of methods; ``plan_detector`` applies it to what the first pass over the
training recordings learned. Pure of any engine: ``learning`` runs it under Lightning, ``stats``
and ``crossval`` without.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from tactslip_torch.data.recording import RecordingId
from tactslip_torch.features.bin_sample import SampledBins
from tactslip_torch.features.groups import checked_attributes, matching
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.features.rounding import is_rounding
from tactslip_torch.features.selection import ScoreVariance, rank_distinct, rank_features, t_scores
from tactslip_torch.features.survey import Survey
from tactslip_torch.model.kernels import Kernel, Polynomial, RadialBasis
from tactslip_torch.model.scaling import FeatureScaler

Balance = Literal["undersample", "weights"]
GroupBy = Literal["material", "cycle"]
CYCLE_GROUPS = 5


@dataclass(frozen=True)
class Recipe:
    """How the machine is made; defaults are the paper's where it states one.

    Args:
        name: for folders and tables.
        num_features: how many features are selected; of several, validation chooses.
        score_variance: of the t-test, ``"pooled"`` or ``"welch"``.
        most_correlation: features that correlate more than this within the classes with one
            already taken are passed over (ours); 1 takes them all.
        compress: scale the signed log of the features (ours).
        tail: share of sampled bins beyond the scaled range on either side; they are clipped.
        kernel: ``"polynomial"`` or ``"rbf"``.
        degree: of the polynomial; 1 and 2 fold into a form of fixed size, others do not.
        offsets: values of the polynomial's ``c`` to choose from.
        gamma: of the radial basis function.
        penalties: values of ``C`` to choose from.
        balance: ``"undersample"`` (authors) or ``"weights"`` (ours).
        group_by: what a validation fold leaves out: a ``"material"`` or a fifth of the
            ``"cycle"`` numbers (ours; the authors' search is not described).
        sample_bins: bins of each group and class that the first pass keeps for quantiles,
            correlations, the single-feature rival and validation. Exact ranges and the t-test take
            every bin.
        among: ranks only features that match (ours), such as ``{"kind": "SG", "descriptor":
            "mean"}``: of each attribute a value, or one of several. ``num_features`` is cut to
            what matches.

    Raises:
        ValueError: for an unknown name or a number that is not positive.
    """

    name: str = "paper"
    num_features: int | Sequence[int] = 120
    score_variance: ScoreVariance = "pooled"
    most_correlation: float = 1.0
    compress: bool = False
    tail: float = 0.0
    kernel: Literal["polynomial", "rbf"] = "polynomial"
    degree: int = 2
    offsets: float | Sequence[float] = 0.5
    gamma: float | None = None
    penalties: float | Sequence[float] = (0.05, 0.08, 0.1, 0.13, 0.17, 0.2, 0.25, 0.3, 1.0, 3.0)
    balance: Balance = "undersample"
    group_by: GroupBy = "material"
    sample_bins: int = 400
    among: Mapping[str, str | Sequence[str]] | None = None

    def __post_init__(self) -> None:
        for name in ("num_features", "offsets", "penalties"):
            object.__setattr__(self, name, _several(getattr(self, name)))
        if self.among is not None:
            object.__setattr__(self, "among", checked_attributes("recipe.among", self.among))
        choices = {
            "score_variance": ("pooled", "welch"),
            "kernel": ("polynomial", "rbf"),
            "balance": ("undersample", "weights"),
            "group_by": ("material", "cycle"),
        }
        for name, known in choices.items():
            if getattr(self, name) not in known:
                raise ValueError(
                    f"recipe.{name} must be one of {', '.join(known)}, got {getattr(self, name)!r}"
                )
        if not self.sizes or any(size < 1 for size in self.sizes):
            raise ValueError(f"recipe.num_features must be at least 1, got {list(self.sizes)}")
        if self.sample_bins < 2:
            raise ValueError(f"recipe.sample_bins must be at least 2, got {self.sample_bins}")
        if any(size != int(size) for size in self.sizes):
            raise ValueError(f"recipe.num_features must be whole numbers, got {list(self.sizes)}")
        penalties, offsets = self.penalties_ascending, _several(self.offsets)
        if not penalties or any(not value > 0 for value in penalties):
            raise ValueError(f"recipe.penalties must be positive, got {list(penalties)}")
        if len(penalties) > 1 and not math.isfinite(penalties[-1]):
            raise ValueError(
                "recipe.penalties: validation needs finite values; give inf alone, or leave it out"
            )
        if not offsets or any(not value >= 0 for value in offsets):
            raise ValueError(f"recipe.offsets must not be negative, got {list(offsets)}")
        if not 0 <= self.tail < 0.5:
            raise ValueError(f"recipe.tail must lie in [0, 0.5), got {self.tail}")
        if not 0 < self.most_correlation <= 1:
            raise ValueError(
                f"recipe.most_correlation must lie in (0, 1], got {self.most_correlation}"
            )
        if self.kernel == "rbf" and self.gamma is None:
            raise ValueError("recipe.kernel=rbf needs recipe.gamma, such as 0.01")
        _ = self.kernels  # their own checks

    @property
    def sizes(self) -> tuple[int, ...]:
        """Numbers of features to choose from, ascending."""
        return tuple(sorted(_several(self.num_features)))

    @property
    def penalties_ascending(self) -> tuple[float, ...]:
        """Values of C to choose from, as numbers."""
        return tuple(sorted(float(penalty) for penalty in _several(self.penalties)))

    def check_pool(self, num_features: int) -> None:
        """Refuse a pool that has fewer features than are to be selected.

        Raises:
            ValueError: if it has.
        """
        if self.sizes[-1] > num_features:
            raise ValueError(
                f"recipe.num_features={self.sizes[-1]} exceeds the pool's {num_features}; give at "
                f"most {num_features}"
            )

    def allowed(self, pool: FeaturePool) -> Tensor | None:
        """Which features of a pool may be selected, ``[F]``, bool; ``None`` if all.

        Those that rounding decides, as some wavelets have them, never may.

        Raises:
            ValueError: if ``among`` names a value that no feature has, or nothing matches.
        """
        is_firm = ~is_rounding(pool)
        if self.among is None:
            return None if bool(is_firm.all()) else is_firm
        try:
            mask = matching(pool.hand, pool.names, self.among) & is_firm
        except ValueError as error:
            raise ValueError(f"recipe.among: {error}") from None
        if not bool(mask.any()):
            raise ValueError(f"recipe.among: of {pool.wavelet}, rounding decides all that match")
        return mask

    @property
    def kernels(self) -> tuple[Kernel, ...]:
        """Kernels to choose from."""
        if self.kernel == "rbf":
            return (RadialBasis(float(self.gamma or 0.0)),)
        return tuple(Polynomial(self.degree, float(c)) for c in _several(self.offsets))

    def facts(self) -> dict[str, Any]:
        """All arguments as JSON-able values; ``Recipe(**facts)`` is the same again."""
        facts = {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(self).items()}
        if self.among is not None:
            facts["among"] = {k: list(_several(v)) for k, v in self.among.items()}
        inf = not math.isfinite(self.penalties_ascending[-1])
        return facts | ({"penalties": ["inf"]} if inf else {})  # JSON has no infinity

    def group(self, recording: RecordingId) -> str:
        """The validation group of a recording."""
        if self.group_by == "material":
            return recording.material
        return str(recording.cycle % CYCLE_GROUPS)


@dataclass(frozen=True)
class Frame:
    """Which features, and how they are scaled.

    Args:
        selected: pool indices, best first.
        scaler: of those features.
    """

    selected: tuple[int, ...]
    scaler: FeatureScaler

    def __call__(self, features: Tensor) -> Tensor:
        """Scaled selected features in float64: ``[N, F] -> [N, K]``."""
        scaled: Tensor = self.scaler(features[:, list(self.selected)].double())
        return scaled

    def first(self, num: int) -> Frame:
        """The frame of the best ``num`` features."""
        scaler = self.scaler
        knee = None if scaler.knee is None else scaler.knee[:num]
        return Frame(
            self.selected[:num], FeatureScaler(scaler.minimum[:num], scaler.maximum[:num], knee)
        )


def choose_frame(recipe: Recipe, survey: Survey, allowed: Tensor | None = None) -> Frame:
    """Rank and scale on what the first pass learned of the training bins.

    Args:
        recipe: how.
        survey: what was learned.
        allowed: what ``recipe.allowed`` says; no more features are taken than it lets pass.

    Raises:
        ValueError: if a class is absent, the pool is smaller than the selection, or a recipe with
            ``among`` comes without ``allowed``.
    """
    if recipe.among is not None and allowed is None:
        raise ValueError("recipe.among needs the names of features; hand over recipe.allowed(pool)")
    sample, most = survey.sample.bins(), recipe.sizes[-1]
    scores, features = t_scores(survey.moments, recipe.score_variance), sample.features
    places = torch.arange(len(scores))
    if allowed is not None:
        places = allowed.nonzero().flatten()
        scores, features, most = scores[places], features[:, places], min(most, len(places))
    if recipe.most_correlation < 1:
        order = rank_distinct(scores, features, sample.is_slip, most, recipe.most_correlation)
    else:
        order = rank_features(scores, most)
    return fit_frame(recipe, survey, places[order].tolist())


def fit_frame(recipe: Recipe, survey: Survey, selected: Sequence[int]) -> Frame:
    """Scale these features on what the first pass learned of the training bins."""
    sample = survey.sample.bins()
    if recipe.compress or recipe.tail > 0:
        chosen = sample.features[:, list(selected)].double()
        scaler = FeatureScaler.fit(chosen, compress=recipe.compress, tail=recipe.tail)
    else:  # the exact range of every training bin
        index = list(selected)
        scaler = FeatureScaler(survey.minimum[index].double(), survey.maximum[index].double())
    return Frame(tuple(selected), scaler)


def bin_weights(recipe: Recipe, counts: Sequence[float], is_slip: Tensor) -> Tensor:
    """The weight of every bin under the recipe's balance, ``[N]`` float64.

    Args:
        recipe: says how classes are balanced.
        counts: training bins of non-slip and of slip.
        is_slip: ``[N]``, bool.

    Under ``undersample`` it is the share of its class that is kept, so that a sample stands for
    the bins that will be trained on.

    Raises:
        ValueError: if a class is absent.
    """
    for name, count in zip(("non-slip", "slip"), counts, strict=True):
        if not count:
            raise ValueError(f"training needs bins of both classes, got no {name} bin")
    if recipe.balance == "undersample":
        share = kept_shares(recipe, counts)
    else:
        share = [sum(counts) / (2 * count) for count in counts]
    return torch.tensor(share, dtype=torch.float64)[is_slip.long()]


def kept_shares(recipe: Recipe, counts: Sequence[float]) -> list[float]:
    """Which share of non-slip and of slip bins is trained on."""
    if recipe.balance != "undersample":
        return [1.0, 1.0]
    return [min(counts) / count for count in counts]


def recalls_mean(says_slip: Tensor, is_slip: Tensor, weights: Tensor | None = None) -> float | None:
    """Balanced accuracy of decisions ``[N]``; ``None`` if a class is absent."""
    weights = torch.ones(len(is_slip), dtype=torch.float64) if weights is None else weights
    recalls = []
    for value in (False, True):
        mask = is_slip == value
        if not bool(mask.any()):
            return None
        recalls.append(float(weights[mask & (says_slip == value)].sum() / weights[mask].sum()))
    return sum(recalls) / 2


def stand_for(sample: SampledBins, recipe: Recipe, counts: Sequence[float]) -> Tensor:
    """Weights with which sampled bins stand for all bins that are trained on, ``[n]``."""
    return bin_weights(recipe, counts, sample.is_slip) * sample.represents


def _several(value: Any) -> tuple[Any, ...]:
    is_several = isinstance(value, Sequence) and not isinstance(value, str)
    return tuple(value) if is_several else (value,)

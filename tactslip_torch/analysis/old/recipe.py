"""How a detector is made: how features are ranked and scaled, and what is chosen from.

A ``Recipe`` is the choice of methods; ``training.plan`` applies it to the statistics that the
first pass over the training recordings gathered.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from numbers import Real
from typing import Any, Literal

import torch
from torch import Tensor

from tactslip_torch.analysis.old.bin_sample import SampledBins
from tactslip_torch.analysis.old.statistics import TrainingStatistics
from tactslip_torch.data.recording import RecordingId
from tactslip_torch.data.splits import PAPER_SCENE
from tactslip_torch.features.descriptors import SPECTRUM_DESCRIPTORS, TIME_DESCRIPTORS
from tactslip_torch.features.groups import checked_attributes, matching
from tactslip_torch.features.pool import FeaturePool, is_rounding
from tactslip_torch.features.pooling import ChannelPooling
from tactslip_torch.features.selection import ScoreVariance, rank_distinct, t_scores
from tactslip_torch.features.sensing import Sensing, SpanFeatures
from tactslip_torch.model.kernels import Polynomial
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.runtime import check_number
from tactslip_torch.training.recipe import General, Paper

Balance = Literal["undersample", "weights"]
GroupBy = Literal["material", "cycle"]
CYCLE_GROUPS = 5
FREE_CONSTANT = 1.0e6
"""``c`` of degree 1, where it weighs the constant alone: so large, the penalty does not reach it.
A penalised constant moves the threshold of a machine with few bins or a strong penalty."""
_SCENE = "|"  # between group and scene in the name of a stratum
_NUMBERS: Mapping[str, tuple[str, Callable[[float], bool]]] = {
    "num_features": ("be whole numbers of at least 1", lambda k: k >= 1 and k.is_integer()),
    "sample_bins": ("be at least 2", lambda num: num >= 2),
    "penalties": ("be positive", lambda penalty: penalty > 0),
    "offsets": ("not be negative", lambda offset: offset >= 0),
    "tail": ("lie in [0, 0.5)", lambda part: 0 <= part < 0.5),
    "most_correlation": ("lie in (0, 1]", lambda r: 0 < r <= 1),
    "tolerance": ("lie in [0, 1)", lambda part: 0 <= part < 1),
    "drop_channels": ("lie in [0, 1)", lambda part: 0 <= part < 1),
    "scene_weights": ("be positive", lambda weight: 0 < weight < math.inf),
}
_LISTS = ("num_features", "offsets", "penalties", "use", "degree")
"""Of these there may be several values."""
_CHOICES = {
    "use": ("channel", "pooled", "both"),
    "score_variance": ("pooled", "welch"),
    "balance": ("undersample", "weights"),
    "group_by": ("material", "cycle"),
    "ranking": ("t", "gd"),
    "validation": ("held", "nested"),
}


@dataclass(frozen=True)
class Recipe:
    """How the machine is made; defaults are the paper's where it states one.

    Args:
        name: for folders and tables.
        num_features: how many features are selected; ``None`` takes all. Of several values of this,
            ``degree``, ``offsets``, ``penalties`` or ``use`` validation chooses one.
        score_variance: of the t-test, ``"pooled"`` or ``"welch"``.
        most_correlation: features that correlate more than this within the classes with one
            already taken are passed over (ours); 1 takes them all.
        compress: scale the signed log of the features (ours).
        tail: share of sampled bins beyond the scaled range on either side; they are clipped.
        degree: of the polynomial kernel, 1 or 2.
        offsets: of the polynomial kernel, its ``c``.
        penalties: the paper's ``C``.
        balance: ``"undersample"`` (authors) or ``"weights"`` (ours).
        group_by: what a validation fold leaves out: a ``"material"`` or a fifth of the
            ``"cycle"`` numbers (ours; the authors' search is not described).
        sample_bins: bins of each group and class that the first pass keeps for quantiles,
            correlations, baselines and validation. Exact ranges and the t-test take
            every bin.
        feature_filter: ranks only features that match (ours), such as ``{"kind": "SG",
            "descriptor": "mean"}``: of each attribute a value, or one of several. ``num_features``
            is cut to what matches.
        pooling: statistics over the channels of a kind, as ``features.pooling`` has them (ours).
        use: ``"channel"`` features, ``"pooled"`` ones or ``"both"``.
        descriptors: those that may be used; ``None``: all.
        ranking: ``"t"``, the paper's t-test, or ``"gd"``, which knows of groups (ours:
            ``group_scores``).
        validation: ``"held"``: features are ranked and scaled once for all validation folds;
            ``"nested"``: anew in each fold, and the choice is evaluated by leaving out two groups
            (``training.plan``).
        tolerance: choices within so much of the best balanced accuracy are as good: of them, the
            simplest machine with the strongest penalty is taken. For ``"nested"``.
        scene_weights: weight of a kind of scene beside the paper's: of all its bins of a class
            together, as a part of the protocol's bins of that class. Scenes that are not named
            count bin by bin. For ``"nested"``.
        drop_channels: of every recording a second copy is trained on, from which up to this part
            of the channels is left out at random. For pooled features.
        min_alive: channels that must be alive for a valid decision, of the fast ones in use (of all
            in use, where nothing is pooled). ``None``: as many as the second copies have at least;
            half where nothing is pooled.

    Raises:
        ValueError: for an unknown name or a number that is not positive.
    """

    name: str = "paper"
    num_features: int | Sequence[int | None] | None = 120
    score_variance: ScoreVariance = "pooled"
    most_correlation: float = 1.0
    compress: bool = False
    tail: float = 0.0
    degree: int | Sequence[int] = 2
    offsets: float | Sequence[float] = 0.5
    penalties: float | Sequence[float] = (0.05, 0.08, 0.1, 0.13, 0.17, 0.2, 0.25, 0.3, 1.0, 3.0)
    balance: Balance = "undersample"
    group_by: GroupBy = "material"
    sample_bins: int = 400
    feature_filter: Mapping[str, str | Sequence[str]] | None = None
    pooling: str | Sequence[str] | None = None
    use: str | Sequence[str] = "channel"
    descriptors: Sequence[str] | None = None
    ranking: Literal["t", "gd"] = "t"
    validation: Literal["held", "nested"] = "held"
    tolerance: float = 0.0
    scene_weights: Mapping[str, float] = field(default_factory=dict)
    drop_channels: float = 0.0
    min_alive: int | None = None

    def __post_init__(self) -> None:
        for name in _LISTS:
            object.__setattr__(self, name, _several(getattr(self, name)))
        for name in ("pooling", "descriptors"):  # lists of a configuration
            value = getattr(self, name)
            if value is not None and not isinstance(value, str):
                object.__setattr__(self, name, tuple(value))
        object.__setattr__(self, "scene_weights", dict(self.scene_weights))
        if self.feature_filter is not None:
            object.__setattr__(
                self,
                "feature_filter",
                checked_attributes("recipe.feature_filter", self.feature_filter),
            )
        if self.min_alive is not None:
            check_number("recipe.min_alive", self.min_alive, whole=True)
        if problem := next(self._problems(), None):
            raise ValueError(f"recipe{problem}")
        _ = self.kernels  # their own checks

    def _problems(self) -> Iterator[str]:
        """What is wrong with the arguments, most basic first."""
        for name, known in _CHOICES.items():
            for value in _several(getattr(self, name)):
                if value not in known:
                    yield f".{name} must be one of {', '.join(known)}, got {value!r}"
        for name, (wanted, is_right) in _NUMBERS.items():
            value = getattr(self, name)
            values = value if name in _LISTS or isinstance(value, Mapping) else (value,)
            if not _all_pass(values, is_right, may_be_none=name == "num_features"):
                shown = list(value) if isinstance(value, tuple) else value
                yield f".{name} must {wanted}, got {shown!r}"
        if len(self.penalties_ascending) > 1 and not math.isfinite(self.penalties_ascending[-1]):
            yield ".penalties: validation needs finite values; give inf alone, or leave it out"
        if set(self.uses) != {"channel"} and self.pooling is None:
            yield ".use=pooled needs statistics over channels; set features.pooling=[mean, std]"
        degrees = _several(self.degree)
        if self.validation == "nested":
            return
        for name, is_wanted in {
            "use": set(self.uses) != {"channel"},
            "num_features=null": self.takes_all,
            "several degrees": len(degrees) > 1,
            "ranking=gd": self.ranking == "gd",
            "scene_weights": bool(self.scene_weights),
        }.items():
            if is_wanted:
                yield f": {name} needs recipe.validation=nested, as general has"

    @property
    def uses(self) -> tuple[str, ...]:
        """Kinds of features to choose from."""
        return _several(self.use)

    @property
    def takes_all(self) -> bool:
        """Whether all features, without selection, are among what is chosen from."""
        return None in _several(self.num_features)

    @property
    def sizes(self) -> tuple[int, ...]:
        """Numbers of features to choose from, ascending, without ``None``."""
        return tuple(sorted(size for size in _several(self.num_features) if size is not None))

    @property
    def penalties_ascending(self) -> tuple[float, ...]:
        """Values of C to choose from, as numbers."""
        return tuple(sorted(float(penalty) for penalty in _several(self.penalties)))

    def check_pool(self, num_features: int) -> None:
        """Refuse a pool that has fewer features than are to be selected.

        Raises:
            ValueError: if it has.
        """
        if self.validation == "held" and self.sizes[-1] > num_features:
            raise ValueError(
                f"recipe.num_features={self.sizes[-1]} exceeds the pool's {num_features}; give at "
                f"most {num_features}"
            )

    def allowed(self, pool: FeaturePool) -> Tensor | None:
        """Which features of a pool may be selected, ``[F]``, bool; ``None`` if all may.

        Those that rounding decides, as some wavelets have them, never may.

        Raises:
            ValueError: if ``feature_filter`` names a value that no feature has, or nothing matches.
        """
        is_firm = ~is_rounding(pool)
        if self.descriptors is not None:
            known = {*TIME_DESCRIPTORS, *SPECTRUM_DESCRIPTORS, "band_energy_ratio"}
            if unknown := [name for name in self.descriptors if name not in known]:
                raise ValueError(
                    f"recipe.descriptors: unknown {unknown[0]!r}, expected some of "
                    f"{', '.join(sorted(known))}"
                )
            is_firm &= torch.tensor([name.descriptor in self.descriptors for name in pool.names])
        if self.feature_filter is None:
            return None if bool(is_firm.all()) else is_firm
        try:
            mask = matching(pool.hand, pool.names, self.feature_filter) & is_firm
        except ValueError as error:
            raise ValueError(f"recipe.feature_filter: {error}") from None
        if not bool(mask.any()):
            raise ValueError(
                f"recipe.feature_filter: of {pool.wavelet}, rounding decides all that match"
            )
        return mask

    @property
    def kernels(self) -> tuple[Polynomial, ...]:
        """Kernels to choose from."""
        offsets = [float(c) for c in _several(self.offsets)]
        return tuple(
            Polynomial(degree, c)
            for degree in sorted(_several(self.degree))
            for c in ([FREE_CONSTANT] if degree == 1 else offsets)
        )

    def group(self, recording: RecordingId) -> str:
        """The validation group of a recording."""
        if self.group_by == "material":
            return recording.material
        return str(recording.cycle % CYCLE_GROUPS)

    def stratum(self, recording: RecordingId) -> str:
        """What a recording is sampled with: its group and, if scenes are weighed, its scene."""
        group = self.group(recording)
        return f"{group}{_SCENE}{recording.scene}" if self.scene_weights else group


def of_recipe(recipe: General | Paper) -> Recipe:
    """The same recipe in these terms."""
    both: tuple[str, ...] = (
        "name",
        "penalties",
        "group_by",
        "sample_bins",
        "feature_filter",
        "descriptors",
    )
    both += ("min_alive", "num_features", "degree")
    same: dict[str, Any] = {name: getattr(recipe, name) for name in both}
    if isinstance(recipe, Paper):
        return Recipe(**same, offsets=recipe.offset)
    names = ("use", "pooling", "tolerance", "scene_weights", "drop_channels")
    same |= {name: getattr(recipe, name) for name in names}
    same |= {"compress": True, "tail": 0.01, "balance": "weights", "ranking": "gd"}
    return Recipe(**same, validation="nested")


@dataclass(frozen=True)
class FeatureSelection:
    """Which features, and how they are scaled.

    Args:
        selected: pool indices of the features that are read, best first.
        scaler: of the columns.
        pooling: from those features to the columns; ``None``: they are the columns.
        silence: what tells which channels are silent, and what is known of them; they are left out
            of their pools. ``None``: none is.
    """

    selected: tuple[int, ...]
    scaler: FeatureScaler
    pooling: ChannelPooling | None = None
    silence: tuple[SpanFeatures, Sensing] | None = None

    @property
    def size(self) -> int:
        """Number of columns, K."""
        return len(self.scaler.minimum)

    def __call__(self, features: Tensor, is_lost: Tensor | None = None) -> Tensor:
        """Scaled columns in float64, ``[N, F] -> [N, K]``, without channels ``[N, C]`` or with."""
        columns = features[:, list(self.selected)].double()
        if self.pooling is not None:
            if self.silence is not None:
                spans, sensing = self.silence
                silent = spans.is_silent(spans(features), sensing)
                is_lost = silent if is_lost is None else silent | is_lost
            columns = self.pooling(columns, is_lost)
        scaled: Tensor = self.scaler(columns)
        return scaled

    def first(self, num: int) -> FeatureSelection:
        """The best ``num`` columns alone."""
        scaler = self.scaler
        compression = None if scaler.compression is None else scaler.compression[:num]
        scaler = FeatureScaler(scaler.minimum[:num], scaler.maximum[:num], compression)
        if self.pooling is None:
            return FeatureSelection(self.selected[:num], scaler)
        place = dict(zip(self.pooling.inputs, self.selected, strict=True))
        layer = self.pooling.select(range(min(num, self.size)))
        selected = tuple(place[name] for name in layer.inputs)
        return FeatureSelection(selected, scaler, layer, self.silence)


def select_features(
    recipe: Recipe, statistics: TrainingStatistics, allowed: Tensor | None = None
) -> FeatureSelection:
    """Rank and scale by the statistics of the training bins.

    Args:
        recipe: how.
        statistics: the statistics.
        allowed: what ``recipe.allowed`` gives; no more features are taken than it lets pass.

    Raises:
        ValueError: if a class is absent, the pool is smaller than the selection, or a recipe with
            ``feature_filter`` comes without ``allowed``.
    """
    if recipe.feature_filter is not None and allowed is None:
        raise ValueError("recipe.feature_filter needs the names of features; hand over the pool")
    sample, most = statistics.sample.bins(), recipe.sizes[-1]
    scores, features = t_scores(statistics.moments, recipe.score_variance), sample.features
    places = torch.arange(len(scores))
    if allowed is not None:
        places = allowed.nonzero().flatten()
        scores, features, most = scores[places], features[:, places], min(most, len(places))
    order = rank_distinct(scores, features, sample.is_slip, most, recipe.most_correlation)
    return scaled_selection(recipe, statistics, places[order].tolist())


def scaled_selection(
    recipe: Recipe, statistics: TrainingStatistics, selected: Sequence[int]
) -> FeatureSelection:
    """Scale these features by the statistics of the training bins."""
    index = list(selected)
    if recipe.compress or recipe.tail > 0:
        chosen = statistics.sample.bins().features[:, index].double()
        scaler = FeatureScaler.fit(chosen, compress=recipe.compress, tail=recipe.tail)
    else:  # the exact range of every training bin
        scaler = FeatureScaler(
            statistics.minimum[index].double(), statistics.maximum[index].double()
        )
    return FeatureSelection(tuple(selected), scaler)


def recalls(says_slip: Tensor, is_slip: Tensor, weights: Tensor | None = None) -> list[float]:
    """Recall of non-slip and of slip, of decisions and truths ``[N]``; absent classes left out."""
    is_right = says_slip == is_slip
    weights = torch.ones(len(is_slip), dtype=torch.float64) if weights is None else weights
    return [
        float(weights[mine & is_right].sum() / weights[mine].sum())
        for mine in (~is_slip, is_slip)
        if bool(mine.any())
    ]


def balanced_accuracy(
    says_slip: Tensor, is_slip: Tensor, weights: Tensor | None = None
) -> float | None:
    """Mean recall of both classes, of decisions and truths ``[N]``; ``None`` if one is absent."""
    found = recalls(says_slip, is_slip, weights)
    return sum(found) / 2 if len(found) == 2 else None


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
    check_classes(is_slip)
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


def has_both_classes(is_slip: Tensor) -> bool:
    """Whether bins ``[N]`` are of slip and of non-slip."""
    return bool(is_slip.any()) and not bool(is_slip.all())


def check_classes(is_slip: Tensor) -> None:
    """Refuse bins ``[N]`` of one class.

    Raises:
        ValueError: if they are.
    """
    if not has_both_classes(is_slip):
        raise ValueError("baselines need training bins of both classes; got only one")


def _class_counts(sample: SampledBins) -> list[int]:
    """How many training bins of non-slip and of slip a sample was drawn from.

    Raises:
        ValueError: if there is none of a class.
    """
    counts = [
        round(float(sample.sample_weight[mine].sum())) for mine in (~sample.is_slip, sample.is_slip)
    ]
    for name, count in zip(("non-slip", "slip"), counts, strict=True):
        if not count:
            raise ValueError(f"training needs bins of both classes, got no {name} bin")
    return counts


def number_of_bins(recipe: Recipe, sample: SampledBins) -> int:
    """How many training bins there are, classes balanced."""
    counts, fractions = _class_counts(sample), class_fractions(recipe, sample)
    return round(counts[0] * fractions[0] + counts[1] * fractions[1])


def class_fractions(recipe: Recipe, sample: SampledBins) -> tuple[float, float]:
    """The part of non-slip and of slip bins that is trained on."""
    counts = _class_counts(sample)
    if recipe.balance != "undersample":
        return 1.0, 1.0
    return min(counts) / counts[0], min(counts) / counts[1]


def sample_weight(recipe: Recipe, sample: SampledBins) -> Tensor:
    """The weight of each sampled bin, for all bins that it was drawn from, ``[n]`` float64.

    Classes are balanced: under ``undersample`` by the fraction of the class that is trained on,
    under ``weights`` by a factor, and where scenes are weighed as ``scene_weights`` says.

    Raises:
        ValueError: if a class is absent, or a scene is weighed that no recording is of.
    """
    by_scene = scene_weights(recipe, sample)
    of_stratum = sample.sample_weight.new_tensor(
        [by_scene[_scene(name)] for name in sample.group_names]
    )
    return sample.sample_weight * of_stratum[sample.group, sample.is_slip.long()]


def scene_weights(recipe: Recipe, sample: SampledBins) -> dict[str, tuple[float, float]]:
    """The weight of each bin of a scene, non-slip and slip, with both classes balanced.

    Raises:
        ValueError: if a class is absent, or a scene is weighed that no recording is of.
    """
    scenes = list(dict.fromkeys(map(_scene, sample.group_names)))
    if strangers := sorted(set(recipe.scene_weights) - set(scenes) - {PAPER_SCENE}):
        raise ValueError(
            f"recipe.scene_weights names {strangers[0]!r}, of which there is no training recording;"
            f" there is {', '.join(scenes)}"
        )
    place = torch.tensor([scenes.index(_scene(name)) for name in sample.group_names])
    totals = torch.zeros(len(scenes), 2, dtype=torch.float64)
    totals.index_put_((place[sample.group], sample.is_slip.long()), sample.sample_weight, True)
    weights = torch.ones_like(totals)
    protocol = totals[scenes.index(PAPER_SCENE)] if PAPER_SCENE in scenes else 0 * totals[0]
    for row, scene in enumerate(scenes):
        wanted = recipe.scene_weights.get(scene, 0.0) * protocol / totals[row]
        weights[row] = torch.where((wanted > 0) & wanted.isfinite(), wanted, 1.0)
    counts = (totals * weights).sum(0)
    _class_counts(sample)  # refuses one that is absent
    weights *= weights.new_tensor(_balance(recipe, counts.tolist()))
    return {scene: (own[0], own[1]) for scene, own in zip(scenes, weights.tolist(), strict=True)}


def _balance(recipe: Recipe, counts: Sequence[float]) -> list[float]:
    """The factor of the weights of non-slip and of slip bins."""
    if recipe.balance == "undersample":
        return [min(counts) / count for count in counts]
    return [sum(counts) / (2 * count) for count in counts]


def _scene(stratum: str) -> str:
    return stratum.split(_SCENE)[-1]


def sample_groups(sample: SampledBins) -> tuple[Tensor, tuple[str, ...]]:
    """The validation group of sampled bins, ``[n]``, all scenes together, and names of groups."""
    of_stratum = [name.split(_SCENE)[0] for name in sample.group_names]
    names = tuple(dict.fromkeys(of_stratum))
    index = torch.tensor([names.index(name) for name in of_stratum], dtype=torch.int64)
    return index[sample.group], names


def _all_pass(values: Any, is_right: Callable[[float], bool], *, may_be_none: bool) -> bool:
    """Whether the numbers of a setting, at least one but of a mapping, are such."""
    passed = [
        (may_be_none and x is None) or (isinstance(x, Real) and is_right(float(x)))
        for x in (values.values() if isinstance(values, Mapping) else values)
    ]
    return all(passed) and (bool(passed) or isinstance(values, Mapping))


def _several(value: Any) -> tuple[Any, ...]:
    is_several = isinstance(value, Sequence) and not isinstance(value, str)
    return tuple(value) if is_several else (value,)

"""How a detector is made: rank, scale, choose K, c and C on held-out groups, balance.

A ``Recipe`` is the choice of methods; ``plan_detector`` applies it to what the first pass over the
training recordings learned. Pure of any engine: ``learning`` runs it under Lightning, ``stats``
and ``crossval`` without.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import torch
from torch import Tensor

from tactslip_torch.data.recording import RecordingId
from tactslip_torch.data.splits import PAPER_SCENE
from tactslip_torch.features.bin_sample import SampledBins
from tactslip_torch.features.descriptors import SPECTRUM_DESCRIPTORS, TIME_DESCRIPTORS
from tactslip_torch.features.groups import checked_attributes, matching
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.features.pooling import ChannelPooling
from tactslip_torch.features.rounding import is_rounding
from tactslip_torch.features.selection import ScoreVariance, rank_distinct, rank_features, t_scores
from tactslip_torch.features.survey import Survey
from tactslip_torch.model.kernels import Kernel, Polynomial, RadialBasis
from tactslip_torch.model.scaling import FeatureScaler

Balance = Literal["undersample", "weights"]
GroupBy = Literal["material", "cycle"]
CYCLE_GROUPS = 5
FREE_CONSTANT = 1.0e6
"""``c`` of degree 1, where it weighs the constant alone: so large, the penalty does not reach it.
A penalised constant moves the threshold of a machine with few bins or a strong penalty."""
_SCENE = "|"  # between group and scene in the name of a stratum


@dataclass(frozen=True)
class Recipe:
    """How the machine is made; defaults are the paper's where it states one.

    Args:
        name: for folders and tables.
        num_features: how many features are selected; ``None`` takes all; of several, validation
            chooses.
        score_variance: of the t-test, ``"pooled"`` or ``"welch"``.
        most_correlation: features that correlate more than this within the classes with one
            already taken are passed over (ours); 1 takes them all.
        compress: scale the signed log of the features (ours).
        tail: share of sampled bins beyond the scaled range on either side; they are clipped.
        kernel: ``"polynomial"`` or ``"rbf"``.
        degree: of the polynomial; 1 and 2 fold into a form of fixed size, others do not. Of
            several, validation chooses.
        offsets: values of the polynomial's ``c`` to choose from.
        gamma: of the radial basis function.
        penalties: values of ``C`` to choose from.
        balance: ``"undersample"`` (authors) or ``"weights"`` (ours).
        group_by: what a validation fold leaves out: a ``"material"`` or a fifth of the
            ``"cycle"`` numbers (ours; the authors' search is not described).
        sample_bins: bins of each group and class that the first pass keeps for quantiles,
            correlations, baselines and validation. Exact ranges and the t-test take
            every bin.
        among: ranks only features that match (ours), such as ``{"kind": "SG", "descriptor":
            "mean"}``: of each attribute a value, or one of several. ``num_features`` is cut to
            what matches.
        pooling: statistics over the channels of a kind, as ``features.pooling`` has them (ours).
        use: ``"channel"`` features, ``"pooled"`` ones or ``"both"``; of several, validation
            chooses.
        descriptors: those that may be used; ``None``: all.
        ranking: ``"t"``, the paper's t-test, or ``"gd"``, which knows of groups (ours:
            ``group_scores``).
        validation: ``"held"``: features are ranked and scaled once for all validation folds;
            ``"nested"``: anew in each fold, and the choice is evaluated by leaving out two groups
            (``training.selection``).
        tolerance: choices within so much of the best balanced accuracy are as good: of them, the
            simplest machine with the strongest penalty is taken. For ``"nested"``.
        scene_weights: weight of a kind of scene beside the paper's: of all its bins of a class
            together, as a part of the protocol's bins of that class. Scenes that are not named
            count bin by bin. For ``"nested"``.
        drop_channels: of every recording a second copy is trained on, from which up to this part
            of the channels is left out at random. For pooled features.

    Raises:
        ValueError: for an unknown name or a number that is not positive.
    """

    name: str = "paper"
    num_features: int | Sequence[int | None] | None = 120
    score_variance: ScoreVariance = "pooled"
    most_correlation: float = 1.0
    compress: bool = False
    tail: float = 0.0
    kernel: Literal["polynomial", "rbf"] = "polynomial"
    degree: int | Sequence[int] = 2
    offsets: float | Sequence[float] = 0.5
    gamma: float | None = None
    penalties: float | Sequence[float] = (0.05, 0.08, 0.1, 0.13, 0.17, 0.2, 0.25, 0.3, 1.0, 3.0)
    balance: Balance = "undersample"
    group_by: GroupBy = "material"
    sample_bins: int = 400
    among: Mapping[str, str | Sequence[str]] | None = None
    pooling: str | Sequence[str] | None = None
    use: str | Sequence[str] = "channel"
    descriptors: Sequence[str] | None = None
    ranking: Literal["t", "gd"] = "t"
    validation: Literal["held", "nested"] = "held"
    tolerance: float = 0.0
    scene_weights: Mapping[str, float] = field(default_factory=dict)
    drop_channels: float = 0.0

    def __post_init__(self) -> None:
        for name in ("num_features", "offsets", "penalties", "use", "degree"):
            object.__setattr__(self, name, _several(getattr(self, name)))
        for name in ("pooling", "descriptors"):  # lists of a configuration
            value = getattr(self, name)
            if value is not None and not isinstance(value, str):
                object.__setattr__(self, name, tuple(value))
        object.__setattr__(self, "scene_weights", dict(self.scene_weights))
        self._check_nested()
        if self.among is not None:
            object.__setattr__(self, "among", checked_attributes("recipe.among", self.among))
        choices = {
            "score_variance": ("pooled", "welch"),
            "kernel": ("polynomial", "rbf"),
            "balance": ("undersample", "weights"),
            "group_by": ("material", "cycle"),
            "ranking": ("t", "gd"),
            "validation": ("held", "nested"),
        }
        for name, known in choices.items():
            if getattr(self, name) not in known:
                raise ValueError(
                    f"recipe.{name} must be one of {', '.join(known)}, got {getattr(self, name)!r}"
                )
        if not _several(self.num_features) or any(size < 1 for size in self.sizes):
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

    def _check_nested(self) -> None:
        """Refuse what only a nested validation can do, without one."""
        known = ("channel", "pooled", "both")
        if unknown := [name for name in self.uses if name not in known]:
            raise ValueError(f"recipe.use must be some of {', '.join(known)}, got {unknown[0]!r}")
        if not 0 <= self.tolerance < 1:
            raise ValueError(f"recipe.tolerance must lie in [0, 1), got {self.tolerance}")
        if not 0 <= self.drop_channels < 1:
            raise ValueError(f"recipe.drop_channels must lie in [0, 1), got {self.drop_channels}")
        for scene, weight in self.scene_weights.items():
            if not 0 < weight < math.inf:
                raise ValueError(f"recipe.scene_weights.{scene} must be positive, got {weight}")
        if set(self.uses) != {"channel"} and self.pooling is None:
            raise ValueError(
                "recipe.use=pooled needs statistics over channels; set features.pooling=[mean, std]"
            )
        if self.validation == "nested":
            if self.kernel != "polynomial" or not set(_several(self.degree)) <= {1, 2}:
                raise ValueError(
                    "recipe.validation=nested needs recipe.kernel=polynomial of degree 1 or 2, got "
                    f"{self.kernel} of degree {list(_several(self.degree))}"
                )
            return
        wants = {
            "use": set(self.uses) != {"channel"},
            "num_features=null": self.takes_all,
            "several degrees": len(_several(self.degree)) > 1,
            "ranking=gd": self.ranking == "gd",
            "scene_weights": bool(self.scene_weights),
        }
        if wanted := [name for name, is_wanted in wants.items() if is_wanted]:
            raise ValueError(f"recipe: {wanted[0]} needs recipe.validation=nested, as general has")

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
        """Which features of a pool may be selected, ``[F]``, bool; ``None`` if all.

        Those that rounding decides, as some wavelets have them, never may.

        Raises:
            ValueError: if ``among`` names a value that no feature has, or nothing matches.
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
        offsets = [float(c) for c in _several(self.offsets)]
        return tuple(
            Polynomial(degree, c)
            for degree in sorted(_several(self.degree))
            for c in ([FREE_CONSTANT] if degree == 1 else offsets)
        )

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

    def stratum(self, recording: RecordingId) -> str:
        """What a recording is sampled with: its group and, if scenes are weighed, its scene."""
        group = self.group(recording)
        return f"{group}{_SCENE}{recording.scene}" if self.scene_weights else group


@dataclass(frozen=True)
class Frame:
    """Which features, and how they are scaled.

    Args:
        selected: pool indices of the features that are read, best first.
        scaler: of the columns.
        pooling: from those features to the columns; ``None``: they are the columns.
    """

    selected: tuple[int, ...]
    scaler: FeatureScaler
    pooling: ChannelPooling | None = None

    @property
    def size(self) -> int:
        """Number of columns, K."""
        return len(self.scaler.minimum)

    def columns(self, features: Tensor, is_missing: Tensor | None = None) -> Tensor:
        """What is scaled, in float64: ``[N, F] -> [N, K]``."""
        chosen = features[:, list(self.selected)].double()
        return chosen if self.pooling is None else self.pooling(chosen, is_missing)

    def __call__(self, features: Tensor, is_missing: Tensor | None = None) -> Tensor:
        """Scaled columns in float64: ``[N, F] -> [N, K]``."""
        scaled: Tensor = self.scaler(self.columns(features, is_missing))
        return scaled

    def first(self, num: int) -> Frame:
        """The frame of the best ``num`` columns."""
        scaler = self.scaler
        knee = None if scaler.knee is None else scaler.knee[:num]
        scaler = FeatureScaler(scaler.minimum[:num], scaler.maximum[:num], knee)
        if self.pooling is None:
            return Frame(self.selected[:num], scaler)
        place = dict(zip(self.pooling.inputs, self.selected, strict=True))
        layer = self.pooling.select(range(min(num, self.size)))
        return Frame(tuple(place[name] for name in layer.inputs), scaler, layer)


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
    if not recipe.scene_weights:
        return bin_weights(recipe, counts, sample.is_slip) * sample.represents
    weights = sample.represents.clone()
    scenes = [name.split(_SCENE)[-1] for name in sample.group_names]
    by_scene = scene_weights(recipe, sample)
    for index, scene in enumerate(scenes):
        for is_slip in (False, True):
            mine = (sample.group == index) & (sample.is_slip == is_slip)
            weights[mine] *= by_scene.get(scene, (1.0, 1.0))[is_slip]
    return weights


def scene_weights(recipe: Recipe, sample: SampledBins) -> dict[str, tuple[float, float]]:
    """Weight of each bin of a scene, non-slip and slip, with both classes balanced.

    Raises:
        ValueError: if a class is absent, or a scene is weighed that no recording is of.
    """
    scenes = [name.split(_SCENE)[-1] for name in sample.group_names]
    totals = {scene: [0.0, 0.0] for scene in scenes}
    for index, scene in enumerate(scenes):
        for is_slip in (False, True):
            mine = (sample.group == index) & (sample.is_slip == is_slip)
            totals[scene][is_slip] += float(sample.represents[mine].sum())
    if strangers := sorted(set(recipe.scene_weights) - set(totals) - {PAPER_SCENE}):
        raise ValueError(
            f"recipe.scene_weights names {strangers[0]!r}, of which there is no training recording;"
            f" there is {', '.join(totals)}"
        )
    protocol = totals.get(PAPER_SCENE, [0.0, 0.0])
    found = {}
    for scene, counts in totals.items():
        share = recipe.scene_weights.get(scene)
        found[scene] = [
            share * protocol[i] / counts[i] if share and counts[i] and protocol[i] else 1.0
            for i in (0, 1)
        ]
    whole = [sum(totals[scene][i] * found[scene][i] for scene in totals) for i in (0, 1)]
    balance = bin_weights(recipe, whole, torch.tensor([False, True])).tolist()
    return {scene: (own[0] * balance[0], own[1] * balance[1]) for scene, own in found.items()}


def sample_groups(sample: SampledBins) -> tuple[Tensor, tuple[str, ...]]:
    """The validation group of sampled bins, ``[n]``, all scenes together, and names of groups."""
    of_stratum = [name.split(_SCENE)[0] for name in sample.group_names]
    names = tuple(dict.fromkeys(of_stratum))
    index = torch.tensor([names.index(name) for name in of_stratum], dtype=torch.int64)
    return index[sample.group], names


def _several(value: Any) -> tuple[Any, ...]:
    is_several = isinstance(value, Sequence) and not isinstance(value, str)
    return tuple(value) if is_several else (value,)

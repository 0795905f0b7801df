"""The scikit-learn face: ``TactileFeatures`` describes windows, ``SlipClassifier`` tells slip.

Both take and return NumPy arrays (torch tensors are taken too) and work in ``Pipeline``,
``cross_val_score``, ``GridSearchCV``, ``clone`` and ``pickle``. The fit is that of the training
(``training.plan``): compression, ranking and scaling, C by leaving out groups, a solve.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator, ClassifierMixin, TransformerMixin
from sklearn.utils.multiclass import check_classification_targets
from sklearn.utils.validation import check_is_fitted, validate_data
from torch import Tensor

from tactslip_torch.deploy.export import export_detector, wanted_graphs
from tactslip_torch.features.bin_sample import SampledBins
from tactslip_torch.features.pool import MOST_BIN_SAMPLES, FeaturePool
from tactslip_torch.features.pooling import ChannelPooling
from tactslip_torch.features.sensing import Sensing, least_alive, longest_runs, most_stuck_samples
from tactslip_torch.hand import Channel, HandLayout
from tactslip_torch.model.calibration import Calibration, Platt, calibration_from_dict, probability
from tactslip_torch.model.detector import SlipDetector, counted_channels
from tactslip_torch.model.kernels import Head, KernelSum, QuadraticForm, kernel_from_dict
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.native import BackendName
from tactslip_torch.onset.decisions import calibration_of
from tactslip_torch.package_files import DAMAGE_ERRORS, load_table, save_table
from tactslip_torch.signals.filtering import Align, ChannelFilter
from tactslip_torch.signals.wavelet import SpectrumMethod
from tactslip_torch.training.plan import Plan, TrainingPass, plan_detector, solve_metadata
from tactslip_torch.training.recipe import FeatureSelection, Recipe

FORMAT = "tactslip_torch classifier 1"
FRAMES: Mapping[str, int] = {"SG": 51, "PVDF": 11}
"""Savitzky-Golay frames of the paper's kinds of channels, samples at 2 kHz; others are as given."""
DESCRIPTORS = (
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
"""Those of ``recipe=general``: none jumps with the last digit, none needs sorting."""
POOLING = ("mean", "std", "min", "max")
PENALTIES = (1e-4, 1e-3, 1e-2, 1e-1, 1.0)
_FOLDS = 5  # of validation without groups
_BLOCK = 50  # windows that lose the same channels in a second copy (``recipe.drop_channels``)
_UNCALIBRATED = Platt(2.0, 0.0)  # (1 + score) / 2 in the middle, for targets of -1 and 1

Array = NDArray[Any]


class _OfWindows(BaseEstimator):  # type: ignore[misc]  # scikit-learn has no annotations
    """What both estimators do with windows ``[N, C, T]``: read, filter, describe."""

    _pool: FeaturePool
    _filter: ChannelFilter

    def __init__(
        self,
        sample_rate_hz: float | None,
        hand: HandLayout | None = None,
        *,
        use: str | Sequence[str] = "both",
        pooling: str | Sequence[str] = POOLING,
        descriptors: Sequence[str] | None = DESCRIPTORS,
        frames: Mapping[str, int] | None = None,
        filtered: bool = False,
        align: Align = "centred",
        wavelet: str = "rbio2.2",
        level: int | None = None,
        spectrum: SpectrumMethod = "reference",
        backend: BackendName = "auto",
    ) -> None:
        self.sample_rate_hz = sample_rate_hz
        self.hand = hand
        self.use = use
        self.pooling = pooling
        self.descriptors = descriptors
        self.frames = frames
        self.filtered = filtered
        self.align = align
        self.wavelet = wavelet
        self.level = level
        self.spectrum = spectrum
        self.backend = backend

    def _lay_out(self, shape: tuple[int, ...]) -> tuple[FeaturePool, ChannelFilter]:
        """The features and the filter for training windows of this shape."""
        if self.sample_rate_hz is None:
            raise ValueError(
                f"X is windows {list(shape)}, whose sample rate is not known; give "
                "sample_rate_hz=2000, or features [N, F]"
            )
        hand = self.hand
        if hand is None:
            alike = [
                Channel(f"C{i}", "taxel", "any", "any", "fast") for i in range(1, shape[1] + 1)
            ]
            hand = HandLayout(tuple(alike))
        elif not isinstance(hand, HandLayout):
            raise ValueError(
                f"hand must be a HandLayout or None, got {type(hand).__name__}; make one, such as "
                "HandLayout.paper24()"
            )
        frames = FRAMES if self.frames is None else self.frames
        if self.frames and (unknown := sorted(set(frames) - set(hand.kinds))):
            raise ValueError(
                f"frames names the kind {unknown[0]!r}, which no channel is of; take some of "
                f"{', '.join(hand.kinds)}"
            )
        channel_filter = ChannelFilter(
            [frames.get(channel.kind) or 1 for channel in hand.channels], align=self.align
        )
        num = shape[2] - (0 if self.filtered else 2 * channel_filter.context)
        if num < 1:
            before, after = channel_filter.context_before, channel_filter.context_after
            raise ValueError(
                f"windows of {shape[2]} samples leave nothing, as the filter takes {before} before "
                f"and {after} behind; give longer ones, filtered ones with filtered=True, or "
                "frames={} for no filter"
            )
        if num > MOST_BIN_SAMPLES:
            raise ValueError(
                f"windows leave {num} samples behind the filter, at most {MOST_BIN_SAMPLES} can be "
                "described; cut shorter windows [N, C, T], or resample them to a lower "
                "sample_rate_hz"
            )
        pool = FeaturePool(
            hand,
            float(self.sample_rate_hz),
            bin_samples=num,
            wavelet=self.wavelet,
            level=self.level,
            spectrum=self.spectrum,
            backend=self.backend,
        )
        return pool, channel_filter

    def _read(
        self,
        X: Any,
        y: Any = None,
        *,
        windows: bool | None = None,
        reset: bool = False,
        may_miss: bool = False,
    ) -> tuple[Array, Any]:
        """Features ``[N, F]`` or windows ``[N, C, T]`` in float64 or float32, and checked labels.

        Args:
            X: as it came.
            y: labels; without any those of scikit-learn are not asked for.
            windows: whether it must be windows; ``None``: either may come.
            reset: whether to learn the number of features.
            may_miss: whether windows may hold NaN and Inf.
        """
        X, shape = _with_shape(X)
        wanted = {True: (3,), False: (2,), None: (2, 3)}[windows]
        if len(shape) not in wanted:
            named = {2: "features [N, F]", 3: "windows [N, C, T]"}
            raise ValueError(
                f"expected {' or '.join(named[num] for num in wanted)}, got an array of shape "
                f"{shape}. Reshape your data: one sample is X[None]"
            )
        hand = self.hand if reset else self._pool.hand if len(shape) == 3 else None
        if len(shape) == 3 and isinstance(hand, HandLayout) and shape[1] != len(hand):
            swapped = "; transpose them: X.transpose(0, 2, 1)" * (shape[2] == len(hand))
            raise ValueError(
                f"X is windows [{shape[0]} windows, {shape[1]} channels, {shape[2]} samples], "
                f"expected {len(hand)} channels, {hand.names[0]} to {hand.names[-1]}"
                f"{swapped or '; give windows [N, C, T] of this hand, or another hand='}"
            )
        x: Any = validate_data(
            self, X, "no_validation" if y is None else y, reset=reset, allow_nd=True,
            dtype=(np.float64, np.float32), ensure_all_finite=False,
        )  # fmt: skip
        if y is not None:
            x, y = x
        if not (may_miss and x.ndim == 3) and not np.isfinite(x).all():
            first = tuple(int(i) for i in np.argwhere(~np.isfinite(x))[0])
            kinds = ("window", "channel", "sample") if x.ndim == 3 else ("row", "column")
            where = ", ".join(f"{what} {i}" for what, i in zip(kinds, first, strict=True))
            value = "NaN" if np.isnan(x[first]) else "inf"
            raise ValueError(
                f"X holds {value}: {where} (counted from 0); repair or leave out such samples"
            )
        return x, y

    def _bins(self, x: Array) -> Tensor:
        """Filtered bins of windows."""
        windows = _tensor(x)
        num = self._pool.bin_samples + (0 if self.filtered else 2 * self._filter.context)
        if windows.shape[-1] != num:
            raise ValueError(
                f"X is windows of {windows.shape[-1]} samples, expected {num} as in the fit; cut "
                "all windows to one length"
            )
        bins = self._pool.widen(windows)
        return bins if self.filtered else self._filter.valid(bins)


class TactileFeatures(TransformerMixin, _OfWindows):  # type: ignore[misc]
    """Features of windows of tactile samples: statistics, wavelet branches and their spectra.

    Args:
        sample_rate_hz: of the windows.
        hand: the channels, in the order of the windows. ``None``: as many as come, all alike,
            described by wavelet branches and spectra.
        use: ``"channel"`` features, ``"pooled"`` ones (statistics of a feature over all channels of
            a kind, which do not depend on where the contact is), or ``"both"``.
        pooling: statistics over channels, of ``mean``, ``std``, ``min``, ``max``, ``median``, or
            ``"sorted"``: the values in ascending order.
        descriptors: names of those to compute; ``None`` for all 18.
        frames: of the Savitzky-Golay filter, an odd number of samples by kind of channel. ``None``:
            51 for ``SG`` and 11 for ``PVDF``, as in the paper. Other kinds are not filtered.
        filtered: whether windows are filtered already. If not, the filter takes ``context`` samples
            at both ends, half of the longest frame, and what lies between is described.
        align: of the filter: ``"centred"``, ``"causal"`` or ``"trailing"``.
        wavelet: its name.
        level: number of wavelet levels; ``None``: as many as the windows allow, at most 4.
        spectrum: ``"reference"`` (the authors') or ``"clean"``.
        backend: ``"auto"``, ``"native"`` (C++) or ``"torch"``.

    Attributes:
        hand_: the channels.
        context_: samples that the filter takes at either end of a window, before and behind.

    Shape:
        - X: ``[N, C, T]`` in volts, NumPy or torch
        - output: ``[N, F]``, float64

    Raises:
        ValueError: for another number of channels or samples, NaN, or windows that are too short.

    Example:
        >>> windows = np.random.default_rng(0).standard_normal((8, 3, 100))
        >>> TactileFeatures(2000.0).fit_transform(windows).shape
        (8, 1120)
    """

    def fit(self, X: ArrayLike | Tensor, y: Any = None) -> TactileFeatures:
        """Learn what pooling compresses by, and what a working channel moves by at least.

        Args:
            X: windows.
            y: not used.
        """
        recipe = Recipe(use=self.use, pooling=self.pooling, descriptors=self.descriptors,
                        validation="nested", num_features=None, degree=1)  # fmt: skip
        x, _ = self._read(X, windows=True, reset=True)
        self._pool, self._filter = self._lay_out(x.shape)
        self.hand_ = self._pool.hand
        self.context_ = (0, 0)
        if not self.filtered:
            self.context_ = (self._filter.context_before, self._filter.context_after)
        allowed = recipe.allowed(self._pool)
        places = (
            range(len(self._pool.names)) if allowed is None else allowed.nonzero()[:, 0].tolist()
        )
        described = self._pool.select(places)
        self._layer: ChannelPooling | None = None
        self._columns = described
        if self.use != "channel":
            bins = self._bins(x)
            features = described(bins, torch.float64)
            num_counted = len(counted_channels(self.hand_, range(len(self.hand_)), is_pooled=True))
            run = most_stuck_samples(self._pool.sample_rate_hz, int(longest_runs(_tensor(x)).max()))
            self._sensing = Sensing.fit(_spans(bins), least_alive(num_counted), run)
            layer = ChannelPooling.fit(
                self.hand_, described.names, features, self.pooling, self._is_silent(bins)
            )
            if self.use == "both":
                layer = layer.with_channels(described.names)
            self._layer = layer
            self._columns = self._pool.select(self._pool.places(layer.inputs))
        return self

    def transform(self, X: ArrayLike | Tensor) -> Array:
        """The features of windows, ``[N, C, T] -> [N, F]``."""
        check_is_fitted(self)
        x, _ = self._read(X, windows=True)
        with torch.no_grad():
            bins = self._bins(x)
            features: Tensor = self._columns(bins, torch.float64)
            if self._layer is not None:
                features = self._layer(features, self._is_silent(bins))
        return features.numpy()

    def _is_silent(self, bins: Tensor) -> Tensor:
        """Channels that pools leave out, ``[N, C]``, bool."""
        spans = _spans(bins)
        return self._sensing.is_silent(spans, bins.shape[-1])

    def get_feature_names_out(self, input_features: Any = None) -> Array:
        """Names of the features, such as ``"PVDF3 D1 time std"`` or ``"std of PVDF D1 time std"``.

        Args:
            input_features: not used.
        """
        check_is_fitted(self)
        names = self._columns.names if self._layer is None else self._layer.names
        return np.array([str(name) for name in names], dtype=object)

    def __sklearn_is_fitted__(self) -> bool:
        return hasattr(self, "_columns")

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.input_tags.two_d_array, tags.input_tags.three_d_array = False, True
        return tags


class SlipClassifier(ClassifierMixin, _OfWindows):  # type: ignore[misc]
    """Slip or not, of features ``[N, F]`` or of windows ``[N, C, T]``, which it describes itself.

    A kernel ridge machine (extreme learning machine) on compressed and scaled columns. Both classes
    weigh the same, however many windows they have. What is not set is chosen by leaving out groups:
    which columns, how many, the degree, and C; of the choices within ``tolerance`` of the best
    balanced accuracy the simplest with the strongest penalty is taken. Without ``groups`` five
    blocks of consecutive rows of each class are left out in turn; with fewer than two rows of a
    class nothing is, and the first choice with the middle C is taken.

    Args:
        sample_rate_hz: of windows; features need none.
        hand: as for ``TactileFeatures``, as are ``pooling``, ``descriptors``, ``frames``,
            ``filtered``, ``align``, ``wavelet``, ``level``, ``spectrum`` and ``backend``.
        use: of windows, columns to choose from: ``"channel"``, ``"pooled"``, ``"both"`` or several.
        num_features: how many columns; ``None``: all; or several to choose from.
        degree: of the polynomial kernel, 1, 2 or both.
        penalties: values of the paper's C to choose from; small ones are the strong penalties. Of
            several, a grid whose end is best is extended.
        tolerance: as above.
        drop_channels: of windows, with pooled columns: a second copy of every window is trained on,
            without up to this part of its channels, so that a broken one does little harm.
        slip_label: the label of ``y`` that is slip. ``None``: ``True``, 1 of 0 and 1 or of -1 and
            1, or the one whose name says slip (``"Slip"``, of ``"slip"`` and ``"non-slip"`` the
            first); of other labels it must be said.

    Attributes:
        classes_: the two labels, ascending.
        slip_label_: the one that is slip.
        penalty_: C.
        validation_: one row for each choice: its balanced accuracy by group.
        feature_names_: of the columns in use, the best first where they were ranked.
        detector_: of windows, the ``SlipDetector``.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> X, y = rng.standard_normal((60, 3, 100)), np.repeat(["grip", "slip"], 30)
        >>> X[y == "slip"] *= 2
        >>> classifier = SlipClassifier(sample_rate_hz=2000.0).fit(X, y)
        >>> classifier.predict(X[:1]), classifier.predict_proba(X).shape
        (array(['grip'], dtype='<U4'), (60, 2))
    """

    def __init__(
        self,
        sample_rate_hz: float | None = None,
        hand: HandLayout | None = None,
        *,
        use: str | Sequence[str] = ("channel", "pooled", "both"),
        num_features: int | Sequence[int | None] | None = (None, 120),
        degree: int | Sequence[int] = (1, 2),
        penalties: float | Sequence[float] = PENALTIES,
        tolerance: float = 0.005,
        drop_channels: float = 0.5,
        slip_label: Any = None,
        pooling: str | Sequence[str] = POOLING,
        descriptors: Sequence[str] | None = DESCRIPTORS,
        frames: Mapping[str, int] | None = None,
        filtered: bool = False,
        align: Align = "centred",
        wavelet: str = "rbio2.2",
        level: int | None = None,
        spectrum: SpectrumMethod = "reference",
        backend: BackendName = "auto",
    ) -> None:
        super().__init__(
            sample_rate_hz, hand, use=use, pooling=pooling, descriptors=descriptors, frames=frames,
            filtered=filtered, align=align, wavelet=wavelet, level=level, spectrum=spectrum,
            backend=backend,
        )  # fmt: skip
        self.num_features = num_features
        self.degree = degree
        self.penalties = penalties
        self.tolerance = tolerance
        self.drop_channels = drop_channels
        self.slip_label = slip_label

    def fit(self, X: ArrayLike | Tensor, y: Any, groups: Any = None) -> SlipClassifier:
        """Choose and fit.

        Args:
            X: features or windows.
            y: any two labels.
            groups: of each row, such as its material, recording or day: a choice is evaluated on
                groups that it was not fitted to. ``None`` and NaN are a group too. Groups of one
                label are put together, so that each part that is left out has both. In
                ``cross_val_score`` they come by ``params={"groups": groups}``; with metadata
                routing after ``set_fit_request(groups=True)``.

        Shape:
            - X: ``[N, F]`` or ``[N, C, T]``; y, groups: ``[N]``

        Raises:
            ValueError: for other shapes, NaN, another number of classes than two, labels that do
                not say which is slip, or groups of which no two parts with both labels can be made.
        """
        if y is None:
            raise ValueError("requires y to be passed, but the target y is None; give labels [N]")
        x, y = self._read(X, _with_shape(y)[0], reset=True)
        check_classification_targets(y)
        self.classes_ = np.unique(y)
        if len(self.classes_) != 2:
            raise ValueError(
                f"Only binary classification is supported: y must have two classes, got "
                f"{len(self.classes_)} class{'es' * (len(self.classes_) != 1)}; relabel it"
            )
        self.slip_label_ = self.classes_[_place_of_slip(self.classes_.tolist(), self.slip_label)]
        is_slip = torch.from_numpy(np.asarray(y == self.slip_label_))
        pool, recipe, features = None, self._recipe(x.ndim == 3), _tensor(x).double()
        if x.ndim == 3:
            self._pool, self._filter = pool, _ = self._lay_out(x.shape)
            with torch.no_grad():
                features = pool(self._bins(x), torch.float64)
        plan, head = _solved(recipe, pool, features, is_slip, *_groups(y, groups))
        self.penalty_: Any = plan.penalty
        self.validation_: list[dict[str, Any]] = plan.validation
        self._slope: Calibration = _UNCALIBRATED
        if plan.calibration is not None:
            self._slope = Platt(plan.calibration["slope"], 0.0)  # a score of 0 tells nothing
        info = plan.metadata | {
            "validation": plan.validation,
            "head": head.cost._asdict(),
            "solve": solve_metadata(head),
            "calibration": self._slope.to_dict(),
            "classes": self._ordered(self.classes_.tolist()),
        }
        self._selection, self._head, self._info = plan.selection, head, info
        self.__dict__.pop("detector_", None)
        if pool is not None:
            self.detector_ = plan.detector(pool, self._filter, head, info, self.backend)
            run = most_stuck_samples(pool.sample_rate_hz, int(longest_runs(_tensor(x)).max()))
            self.detector_.sensing = replace(self.detector_.sensing, stuck_samples=run)
            self.feature_names_ = [str(name) for name in self.detector_.selected_names]
        else:
            known = getattr(self, "feature_names_in_", None)
            names = [f"x{i}" for i in range(x.shape[1])] if known is None else list(known)
            self.feature_names_ = [names[i] for i in plan.selection.selected]
        return self

    def decision_function(self, X: ArrayLike | Tensor) -> Array:
        """Scores ``[N]``; above 0 means ``classes_[1]``, 0 where the decision is not valid."""
        score = self._score(X)[0]
        return score if self.slip_label_ == self.classes_[1] else -score

    def predict(self, X: ArrayLike | Tensor) -> Array:
        """Labels ``[N]``: slip where the score is at least 0, and the decision is valid."""
        score, is_valid = self._score(X)
        is_slip = (score >= 0) & is_valid
        other = self.classes_[self.classes_ != self.slip_label_][0]
        found: Array = np.where(is_slip, self.slip_label_, other).astype(self.classes_.dtype)
        return found

    def predict_proba(self, X: ArrayLike | Tensor) -> Array:
        """Probabilities of ``classes_``, ``[N, 2]``.

        Calibrated on the scores of groups that were left out (Platt's slope); one half is where the
        decision changes, and where it is not valid.
        """
        score = torch.from_numpy(self._score(X)[0])
        slip = probability(self._slope.llr(score), 0.5).numpy()
        return np.stack(self._ordered([1 - slip, slip]), axis=1)

    def predict_valid(self, X: ArrayLike | Tensor) -> Array:
        """Which decisions are valid, ``[N]``, bool: enough channels of the window are alive.

        A channel is not alive that hardly moves, less than a tenth of what it did at rest in
        training, or holds a NaN or Inf (``features.sensing``). Of features all are valid.
        """
        return self._score(X)[1]

    def to_detector(self, features: TactileFeatures | None = None) -> SlipDetector:
        """A ``SlipDetector``, for streams, ONNX and the commands.

        Args:
            features: the transformer whose output this was fitted to; not of windows.

        Raises:
            ValueError: if it was fitted to features and they do not come, or are others.
        """
        check_is_fitted(self)
        if hasattr(self, "detector_"):
            detector: SlipDetector = self.detector_
            return detector
        if not isinstance(features, TactileFeatures):
            raise ValueError(
                "this classifier was fitted to features; give the TactileFeatures that made them, "
                "to_detector(features), or fit it to windows [N, C, T]"
            )
        if (num := len(features.get_feature_names_out())) != self.n_features_in_:
            raise ValueError(
                f"expected the TactileFeatures of {self.n_features_in_} features, got {num}; give "
                "the ones that this classifier was fitted to"
            )
        pool, layer, chosen = features._pool, features._layer, self._selection.selected
        if layer is None:
            selected = [features._columns.selected[i] for i in chosen]
        else:
            layer = layer.select(chosen)
            selected = pool.places(layer.inputs)
            if not any(name.is_pooled for name in layer.names):
                layer = None
        scaler, head = self._selection.scaler, self._head
        return SlipDetector(
            pool, features._filter, selected, scaler, head, self._info, None, layer,
            sensing=None if layer is None else features._sensing, backend=features.backend,
        )  # fmt: skip

    @classmethod
    def from_detector(
        cls, detector: SlipDetector, classes: Sequence[Any] | None = None, *, filtered: bool = False
    ) -> SlipClassifier:
        """A fitted classifier of windows that scores as a detector does.

        Args:
            detector: trained in any way.
            classes: labels for non-slip and slip; by default those it was fitted with, or 0 and 1.
            filtered: whether windows will come filtered; raw ones with their context otherwise.
        """
        pool, info = detector.pool, detector.info
        made = cls(
            pool.sample_rate_hz,
            pool.hand,
            filtered=filtered,
            align=detector.channel_filter.align,
            wavelet=pool.wavelet if isinstance(pool.wavelet, str) else "rbio2.2",
            level=pool.level,
            spectrum=pool.spectrum,
        )
        labels = list(classes or info.get("classes") or (0, 1))
        if len(labels) != 2 or labels[0] == labels[1]:
            raise ValueError(f"classes must be two labels, non-slip and slip, got {labels}")
        made.slip_label = labels[1]
        made.detector_, made._pool, made._filter = detector, pool, detector.channel_filter
        made._selection = FeatureSelection(detector.selected, detector.scaler, detector.pooling)
        made._head, made._slope = detector.head, _UNCALIBRATED
        if (found := calibration_of(detector)) is not None:
            made._slope = found[0]
        made._take(info, labels, len(pool.hand), detector.selected_names)
        return made

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write one file; of windows it is a detector's, which every command takes.

        Parameters that only another fit would need are not kept.
        """
        check_is_fitted(self)
        if hasattr(self, "detector_"):
            self.detector_.save(path)
            return
        head, scaler = self._head, self._selection.scaler
        metadata = {
            "kernel": head.kernel.to_dict() if isinstance(head, KernelSum) else None,
            "selected": list(self._selection.selected),
            "num_features": self.n_features_in_,
            "names": [str(name) for name in getattr(self, "feature_names_in_", ())],
            "columns": self.feature_names_,
            "info": self._info,
        }
        tensors = {f"head.{name}": value for name, value in head.state_dict().items()}
        tensors |= {f"scaler.{name}": value for name, value in scaler.state_dict().items()}
        save_table(path, FORMAT, metadata, tensors)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> SlipClassifier:
        """Read what ``save`` wrote, or any detector; nothing in the file is executed.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if it is neither, or a damaged one.
        """
        try:
            metadata, tensors = load_table(path, FORMAT)
        except ValueError:
            return cls.from_detector(SlipDetector.load(path))

        def part(name: str) -> dict[str, Tensor]:
            start = f"{name}."
            return {k.removeprefix(start): v for k, v in tensors.items() if k.startswith(start)}

        try:
            info, kernel = metadata["info"], metadata["kernel"]
            made: SlipClassifier = cls(slip_label=info["classes"][1])
            scaler, head = FeatureScaler(**part("scaler")), part("head")
            made._selection = FeatureSelection(tuple(metadata["selected"]), scaler)
            made._head = (
                QuadraticForm(**head)
                if kernel is None
                else KernelSum(**head, kernel=kernel_from_dict(kernel))
            )
            made._slope = calibration_from_dict(info["calibration"])
            made._take(info, info["classes"], metadata["num_features"], metadata["columns"])
            if metadata["names"]:
                made.feature_names_in_ = np.array(metadata["names"], dtype=object)
            return made
        except DAMAGE_ERRORS as error:
            raise ValueError(f"{os.fspath(path)} is a damaged classifier: {error}") from error

    def _take(self, info: dict[str, Any], labels: Any, num: int, columns: Sequence[Any]) -> None:
        """What is known of a fit elsewhere: labels (non-slip, slip), columns of X and in use."""
        self.classes_, self.slip_label_ = np.unique(np.array(labels)), np.array(labels)[1]
        self.penalty_, self.validation_ = info.get("penalty"), info.get("validation", [])
        self.n_features_in_, self.feature_names_ = num, [str(name) for name in columns]
        self._info = info

    def export_onnx(self, folder: str | os.PathLike[str]) -> tuple[Any, ...]:
        """Write ``model.onnx`` of a classifier of windows, and ``stream.onnx`` if it has an alarm.

        Returns:
            The paths; each has its metadata beside it, ``<file>.json``.
        """
        detector = self.to_detector()
        return export_detector(detector, folder, wanted_graphs(None, detector))

    def _score(self, X: Any) -> tuple[Array, Array]:
        """Scores, positive for slip, in float64, 0 where not valid; and which are."""
        check_is_fitted(self)
        is_of_windows = hasattr(self, "detector_")
        x, _ = self._read(X, windows=is_of_windows, may_miss=True)
        with torch.no_grad():
            if is_of_windows:
                found = self.detector_.predict(self._bins(x))
                score, is_valid = found.score.double(), found.is_valid
            else:
                score = self._head(self._selection(_tensor(x)))
                is_valid = torch.ones(len(score), dtype=torch.bool)
        return torch.where(is_valid, score, 0.0).numpy(), is_valid.numpy()

    def _ordered(self, pair: list[Any]) -> list[Any]:
        """Non-slip and slip of what is in the order of ``classes_``, or the other way round."""
        return pair if self.slip_label_ == self.classes_[1] else pair[::-1]

    def _recipe(self, is_of_windows: bool) -> Recipe:
        return Recipe(
            name="estimator",
            num_features=self.num_features,
            compress=True,
            tail=0.01,
            degree=self.degree,
            penalties=self.penalties,
            balance="weights",
            pooling=self.pooling if is_of_windows else None,
            use=self.use if is_of_windows else "channel",
            descriptors=self.descriptors if is_of_windows else None,
            ranking="gd",
            validation="nested",
            tolerance=self.tolerance,
            drop_channels=self.drop_channels if is_of_windows else 0.0,
        )

    def __sklearn_is_fitted__(self) -> bool:
        return hasattr(self, "_head")

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.classifier_tags.multi_class = False
        tags.input_tags.three_d_array = True
        return tags


def _spans(bins: Tensor) -> Tensor:
    """Largest less smallest sample of each channel, ``[N, C, n] -> [N, C]``, float64."""
    return (bins.amax(-1) - bins.amin(-1)).double()


def _with_shape(X: Any) -> tuple[Any, tuple[int, ...]]:
    """Arrays, tables and sparse matrices as they are, others as arrays; and their shape.

    Raises:
        ValueError: for lists of different lengths.
    """
    if isinstance(X, Tensor):
        X = X.detach().cpu().numpy()
    try:
        X = X if hasattr(X, "shape") else np.asarray(X)
        return X, tuple(X.shape)
    except ValueError:
        raise ValueError(
            "X is a list of windows or rows of different shapes; cut them to one shape, [N, C, T] "
            "or [N, F]"
        ) from None


def _tensor(x: Array) -> Tensor:
    """The same values; a copy where torch could write to what nobody may."""
    return torch.from_numpy(np.require(x, requirements=("C", "W")))


_MISSING = ("None", "nan", "<NA>", "NaT")
_SLIP = re.compile(r"(?<![a-z])slip(s|ped|ping|page)?(?![a-z])")
_NO_SLIP = re.compile(r"(?<![a-z])(no|non|not|without|un)[^a-z]*slip")


def _place_of_slip(labels: list[Any], said: Any) -> int:
    """Which of two labels, ascending, is slip.

    Raises:
        ValueError: if ``said`` is neither, or is ``None`` and the labels do not tell.
    """
    if said is not None:
        if said not in labels:
            raise ValueError(
                f"slip_label={said!r} is none of the labels in y, {labels}; give one of them"
            )
        return labels.index(said)
    if labels in ([0, 1], [-1, 1]):  # also False and True
        return 1
    words = [str(label).lower() for label in labels]
    say = [bool(_SLIP.search(word)) and not _NO_SLIP.search(word) for word in words]
    if sum(say) != 1:
        raise ValueError(
            f"y has the labels {labels[0]!r} and {labels[1]!r}, which do not say which one is "
            f"slip; give it, such as slip_label={labels[1]!r}"
        )
    return say.index(True)


def _groups(y: Array, groups: Any) -> tuple[Tensor, tuple[str, ...]]:
    """Which validation group each row is of, ``[N]``, from 0, and names of the groups.

    Raises:
        ValueError: if there are other numbers of rows, or no two groups with both labels.
    """
    of_class = np.unique(y, return_inverse=True)[1]
    if groups is None:
        index = np.zeros(len(y), dtype=np.int64)
        counts = np.bincount(of_class)
        for label, count in enumerate(counts):
            index[of_class == label] = np.arange(count) * min(_FOLDS, *counts) // count
        return torch.from_numpy(index), tuple(f"rows {i}" for i in range(int(index.max()) + 1))
    groups = np.asarray(groups)
    if groups.shape != y.shape:
        raise ValueError(
            f"groups must be one for each of the {len(y)} rows, got shape {groups.shape}"
        )
    if groups.dtype == object:  # None, NaN and words have no order
        groups = np.array(["none" if str(each) in _MISSING else str(each) for each in groups])
    values, index = np.unique(groups, return_inverse=True)
    names = [str(value).replace("|", "/") for value in values]
    has = np.zeros((len(values), 2), bool)
    has[index, of_class] = True
    of_one = [np.flatnonzero(has[:, label] & ~has[:, 1 - label]) for label in (0, 1)]
    num_joined = min(_FOLDS, *map(len, of_one))
    num_whole = int(has.all(1).sum())
    if len(values) > 1 and num_whole + num_joined < 2:
        raise ValueError(
            "validation leaves out groups and needs two parts that have both labels; of the "
            f"{len(values)} groups {num_whole} have both, {len(of_one[0])} only the smaller label, "
            f"{len(of_one[1])} only the larger; give groups that have both, or groups=None for "
            "blocks of rows"
        )
    if num_joined:
        parts: list[list[int]] = [[] for _ in range(num_joined)]
        for some in of_one:
            for part, block in zip(parts, np.array_split(some, num_joined), strict=True):
                part += block.tolist()
        for part in parts:
            index[np.isin(index, part)] = part[0]
            names[part[0]] += f" and {len(part) - 1} more"
        kept, index = np.unique(index, return_inverse=True)
        names = [names[place] for place in kept]
    return torch.from_numpy(index), tuple(names)


def _solved(
    recipe: Recipe,
    pool: FeaturePool | None,
    features: Tensor,
    is_slip: Tensor,
    group: Tensor,
    names: tuple[str, ...],
) -> tuple[Plan, Head]:
    """The plan of the training and its machine, of features ``[N, F]`` that all serve for both."""
    sample = SampledBins(
        features=features,
        is_slip=is_slip,
        group=group,
        group_names=names,
        recording=group,
        recording_names=names,
        bin_index=torch.arange(len(features)),
        sample_weight=torch.ones(len(features), dtype=torch.float64),
    )
    with torch.no_grad():
        plan = plan_detector(recipe, sample, pool, is_nested=False)
        gathered = TrainingPass(plan)
        for index, name in enumerate(names):
            rows = (group == index).nonzero()[:, 0]
            for part, some in enumerate(rows.split(_BLOCK)):
                gathered.update(f"{index}.{part} {name}", features[some], is_slip[some])
        return plan, gathered.solve()

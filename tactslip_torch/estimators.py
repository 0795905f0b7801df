"""Estimators for scikit-learn: ``TactileFeatures`` of windows, ``SlipClassifier`` on them.

Both take windows ``[N, C, T]`` as NumPy arrays or torch tensors and work in ``Pipeline``,
``cross_val_score``, ``GridSearchCV``, ``clone`` and ``pickle``.
"""

from __future__ import annotations

import math
import os
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from statistics import mean
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator, ClassifierMixin, TransformerMixin, clone
from sklearn.utils.multiclass import check_classification_targets
from sklearn.utils.validation import (
    check_array,
    check_consistent_length,
    check_is_fitted,
    column_or_1d,
)
from torch import Tensor
from torch.nn.functional import logsigmoid

from tactslip_torch.deploy.export import export_detector, wanted_graphs
from tactslip_torch.features.pool import MOST_BIN_SAMPLES, FeaturePool
from tactslip_torch.features.pooling import ChannelPooling
from tactslip_torch.features.sensing import (
    Sensing,
    least_alive,
    longest_run_of,
    most_stuck_samples,
    run_lengths,
)
from tactslip_torch.hand import Channel, HandLayout
from tactslip_torch.model.calibration import Platt, probability
from tactslip_torch.model.detector import SlipDetector, counted_channels
from tactslip_torch.onset.decisions import KEY, AlarmSettings
from tactslip_torch.onset.rules import KOfN
from tactslip_torch.runtime import check_choice
from tactslip_torch.signals.filtering import Align, ChannelFilter
from tactslip_torch.training.bins import RecordingBins, join_groups
from tactslip_torch.training.recipe import POOLING, ClassFit, Fit, General
from tactslip_torch.training.views import ViewBins

FRAMES: Mapping[str, int] = {"SG": 51, "PVDF": 11}
"""Savitzky-Golay frames of the paper's kinds of channels, samples at 2 kHz; others are as given."""
_FOLDS = 5  # of validation without groups
_PART = 1024  # windows whose columns are in memory at once
_BLOCK = 50  # windows that lose the same channels in a second copy (``drop_channels``)
_UNCALIBRATED = Platt(2.0, 0.0)  # (1 + score) / 2 in the middle, for targets of -1 and 1

Array = NDArray[Any]


class TactileFeatures(TransformerMixin, BaseEstimator):  # type: ignore[misc]
    """Features of windows of tactile samples: statistics, wavelet branches and their spectra.

    Args:
        sample_rate_hz: of the windows.
        hand: the channels, in the order of the windows. ``None``: as many as come, all alike,
            described by wavelet branches and spectra.
        use: ``"channel"`` features, ``"pooled"`` ones (statistics of a feature over all channels of
            a kind, which do not depend on where the contact is), or ``"both"``. ``None``: both;
            ``SlipClassifier`` chooses among the three.
        pooling: statistics over channels, of ``mean``, ``std``, ``min``, ``max``, ``median``, or
            ``"sorted"``: the values in ascending order.
        descriptors: names of those to compute; ``None`` for all 17 of the paper's
            features.
        frames: of the Savitzky-Golay filter, an odd number of samples by kind of channel. ``None``:
            51 for ``SG`` and 11 for ``PVDF``, as in the paper. Other kinds are not filtered.
        filtered: whether windows are filtered already. If not, the filter takes ``context_``
            samples at both ends, half of the longest frame, and what lies between is described.
        align: of the filter: ``"centred"``, ``"causal"`` or ``"trailing"``.
        wavelet: its name; short windows need a short one, such as ``"haar"``.

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

    def __init__(
        self,
        sample_rate_hz: float,
        hand: HandLayout | None = None,
        *,
        use: str | None = None,
        pooling: str | Sequence[str] = POOLING,
        descriptors: Sequence[str] | None = General.descriptors,
        frames: Mapping[str, int] | None = None,
        filtered: bool = False,
        align: Align = "centred",
        wavelet: str = "rbio2.2",
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

    def fit(self, X: ArrayLike | Tensor, y: Any = None) -> TactileFeatures:
        """Learn what pooling compresses by, and what a working channel moves by at least.

        Args:
            X: windows.
            y: not used.
        """
        windows = self._lay_out(X)
        pool, recipe = self._pool, self._recipe()
        places = recipe.allowed(pool).nonzero()[:, 0].tolist()
        self._layer: ChannelPooling | None = None
        self._columns = described = pool.select(places)
        if self.use != "channel":
            bins = self._bins(windows)
            num = len(counted_channels(pool.hand, range(len(pool.hand)), is_pooled=True))
            spans = _spans(bins)
            self._sensing = Sensing.fit(spans, least_alive(num), _stuck_samples(pool, windows))
            features, silent = described(bins, torch.float64), self._silent(bins)
            layer = ChannelPooling.fit(pool.hand, described.names, features, self.pooling, silent)
            if self.use != "pooled":
                layer = layer.with_channels(described.names)
            self._layer, self._columns = layer, pool.select(pool.places(layer.inputs))
        return self

    def transform(self, X: ArrayLike | Tensor) -> Array:
        """The features of windows, ``[N, C, T] -> [N, F]``."""
        check_is_fitted(self)
        with torch.no_grad():
            bins = self._bins(self._read(X, self.hand_))
            features: Tensor = self._columns(bins, torch.float64)
            if self._layer is not None:
                features = self._layer(features, self._silent(bins))
        return features.numpy()

    def get_feature_names_out(self, input_features: Any = None) -> Array:
        """Names of the features, such as ``"PVDF3 D1 time std"`` or ``"std of PVDF D1 time std"``.

        Args:
            input_features: not used.
        """
        check_is_fitted(self)
        names = self._columns.names if self._layer is None else self._layer.names
        return np.array([str(name) for name in names], dtype=object)

    def _recipe(self, **choices: Any) -> General:
        """The default recipe on these features."""
        return General(
            name="estimator",
            pooling=self.pooling,
            descriptors=self.descriptors,
            **choices,
        )

    def _views(self, wanted: str | Sequence[str]) -> tuple[str, ...]:
        """The views that ``use`` leaves of those that are wanted."""
        listed = (wanted,) if isinstance(wanted, str) else tuple(wanted)
        if self.use not in ("channel", "pooled"):
            return listed
        return tuple(view for view in listed if (view == "pooled") == (self.use == "pooled"))

    def _read(self, X: Any, hand: HandLayout | None, *, may_miss: bool = False) -> Tensor:
        """Windows ``[N, C, T]``, float64 or float32; only where they ``may_miss``, with NaN."""
        if isinstance(X, Tensor):
            X = X.detach().cpu().numpy()
        try:
            x = np.asarray(X)
        except ValueError:
            raise ValueError(
                "X is a list of windows of different shapes; cut them to one, [N, C, T]"
            ) from None
        if x.ndim != 3:
            raise ValueError(
                f"expected windows [N, C, T], got an array of shape {x.shape}; one window "
                "is X[None]"
            )
        x = check_array(x, dtype=(np.float64, np.float32), allow_nd=True, ensure_all_finite=False)
        if hand is not None and x.shape[1] != len(hand):
            swapped = "; transpose them: X.transpose(0, 2, 1)" * (x.shape[2] == len(hand))
            raise ValueError(
                f"X is windows [{x.shape[0]} windows, {x.shape[1]} channels, {x.shape[2]} samples],"
                f" expected {len(hand)} channels, {hand.names[0]} to {hand.names[-1]}"
                f"{swapped or '; give windows [N, C, T] of this hand, or another hand='}"
            )
        if not may_miss and not np.isfinite(x).all():
            window, channel, sample = np.argwhere(~np.isfinite(x))[0].tolist()
            value = "NaN" if np.isnan(x[window, channel, sample]) else "inf"
            raise ValueError(
                f"X holds {value}: window {window}, channel {channel}, sample {sample} (counted "
                "from 0); repair or leave out such samples"
            )
        return torch.from_numpy(np.require(x, requirements=("C", "W")))

    def _lay_out(self, X: Any) -> Tensor:
        """Read training windows, and make the features and the filter for such."""
        if not (self.hand is None or isinstance(self.hand, HandLayout)):
            raise ValueError(
                f"hand must be a HandLayout or None, got {type(self.hand).__name__}; make one, such"
                " as HandLayout.paper24()"
            )
        check_choice("use", self.use, ("channel", "pooled", "both", None))
        windows = self._read(X, self.hand)
        hand, frames = self.hand, FRAMES if self.frames is None else self.frames
        if hand is None:
            alike = range(1, windows.shape[1] + 1)
            hand = HandLayout(tuple(Channel(f"C{i}", "taxel", "any", "any", "fast") for i in alike))
        if self.frames and (unknown := sorted(set(frames) - set(hand.kinds))):
            raise ValueError(
                f"frames names the kind {unknown[0]!r}, which no channel is of; take some of "
                f"{', '.join(hand.kinds)}"
            )
        lengths = [frames.get(channel.kind) or 1 for channel in hand.channels]
        layer = ChannelFilter(lengths, align=self.align)
        before, after = (0, 0) if self.filtered else (layer.context_before, layer.context_after)
        if (num := windows.shape[-1] - before - after) < 1:
            raise ValueError(
                f"windows of {windows.shape[-1]} samples leave nothing, as the filter takes "
                f"{before} before and {after} behind; give longer ones, filtered ones with "
                "filtered=True, or frames={} for no filter"
            )
        if num > MOST_BIN_SAMPLES:
            raise ValueError(
                f"windows have at most {MOST_BIN_SAMPLES} samples without what filters take, got "
                f"{num}; cut shorter windows, or resample them to a lower rate"
            )
        pool = FeaturePool(
            hand,
            float(self.sample_rate_hz),
            bin_samples=num,
            wavelet=self.wavelet,
            level=None,
        )
        self._set(pool, layer)
        return windows

    def _set(self, pool: FeaturePool, layer: ChannelFilter) -> None:
        """What windows of a fit, or of a detector, are described by."""
        self._pool, self._filter, self.hand_ = pool, layer, pool.hand
        context = (layer.context_before, layer.context_after)
        self.context_ = (0, 0) if self.filtered else context

    def _bins(self, windows: Tensor) -> Tensor:
        """Filtered bins of windows."""
        if windows.shape[-1] != (num := self._pool.bin_samples + sum(self.context_)):
            raise ValueError(
                f"X is windows of {windows.shape[-1]} samples, expected {num} as in the fit; cut "
                "all windows to one length"
            )
        bins = self._pool.widen(windows)
        return bins if self.filtered else self._filter.valid(bins)

    def _silent(self, bins: Tensor) -> Tensor:
        """Channels that pools leave out, ``[N, C]``, bool."""
        return self._sensing.is_silent(_spans(bins), bins.shape[-1])

    def __sklearn_is_fitted__(self) -> bool:
        return hasattr(self, "_columns")

    def __sklearn_tags__(self) -> Any:
        return _of_windows(super().__sklearn_tags__())


class SlipClassifier(ClassifierMixin, BaseEstimator):  # type: ignore[misc]
    """Slip or not, or several kinds of slip, of windows ``[N, C, T]``.

    The mean of the scores of up to three kernel ridge machines, each on a view of the windows
    (``recipe.General``). All classes weigh the same, however many windows they have. Penalties,
    the weights of the views and the threshold are chosen by leaving out groups. Without ``groups``
    five blocks of consecutive rows of each class are left out in turn; with fewer than two rows of
    a class nothing is, and views weigh alike, with the middle C.

    Of more than two labels, such as directions, each has machines of its own against all others, on
    the same features and with the same views and penalties; the highest score decides. Such a
    classifier has no ``detector_``, so no file, stream or ONNX graph: pickle it, or fit one label
    against the others, ``y == label``.

    Args:
        sample_rate_hz: of the windows.
        hand: the channels, as ``TactileFeatures`` has them.
        features: in place of both, how windows are described; ``None``: by
            ``TactileFeatures(sample_rate_hz, hand)``.
        views: some of ``simple``, ``channel`` and ``pooled``; those that do no good are dropped.
        num_features: columns of each view, the best together; ``None``: all.
        penalties: values of C to choose from; small ones are the strong penalties.
        threshold: part of the validated shift of the threshold that is applied: ``zero``, ``half``
            or ``full``; of two labels only.
        drop_channels: of every window the view ``pooled`` is trained on a second copy, without up
            to this part of its channels, so that a broken one does little harm.
        slip_label: the label of ``y`` that is slip. ``None``: ``True``, 1 of 0 and 1 or of -1 and
            1, or the one whose name says slip (``"Slip"``, of ``"slip"`` and ``"non-slip"`` the
            first); of two other labels it must be given, of more than two it may not.

    Attributes:
        classes_: the labels, ascending.
        slip_label_: the one that is slip; ``None`` of more than two.
        views_: the weight of each view, 0 of one that is dropped.
        penalty_: C of the view that weighs most.
        validation_: one row for each view and penalty: its balanced accuracy by group.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> X, y = rng.standard_normal((60, 3, 100)), np.repeat(["grip", "slip"], 30)
        >>> X[y == "slip"] *= 2
        >>> classifier = SlipClassifier(2000.0).fit(X, y)
        >>> classifier.predict(X[:1]), classifier.predict_proba(X).shape
        (array(['grip'], dtype='<U4'), (60, 2))
    """

    def __init__(
        self,
        sample_rate_hz: float | None = None,
        hand: HandLayout | None = None,
        *,
        features: TactileFeatures | None = None,
        views: str | Sequence[str] = General.views,
        num_features: int | None = None,
        penalties: float | Sequence[float] = General.penalties,
        threshold: str = General.threshold,
        drop_channels: float = 0.5,
        slip_label: Any = None,
    ) -> None:
        self.sample_rate_hz = sample_rate_hz
        self.hand = hand
        self.features = features
        self.views = views
        self.num_features = num_features
        self.penalties = penalties
        self.threshold = threshold
        self.drop_channels = drop_channels
        self.slip_label = slip_label

    def fit(self, X: ArrayLike | Tensor, y: Any, groups: Any = None) -> SlipClassifier:
        """Choose and fit.

        Args:
            X: windows.
            y: two labels or more.
            groups: of each row, such as its material, recording or day: a choice is evaluated on
                groups that it was not fitted to. ``None`` and NaN are a group too. More than ten
                are put together, and so are groups where no two have all labels. In
                ``cross_val_score`` they come by ``params={"groups": groups}``; with metadata
                routing after ``set_fit_request(groups=True)``.

        Shape:
            - X: ``[N, C, T]``; y, groups: ``[N]``

        Raises:
            TypeError: if ``features`` are no ``TactileFeatures``.
            ValueError: if there is no rate, or one beside ``features``; for other shapes, NaN, a
                single class, labels that do not say which is slip, or groups of which no two parts
                with all labels can be made.

        Warns:
            UserWarning: if no feature differs between windows, as of constant X.
        """
        features = self._described_by()
        windows = features._lay_out(X)
        y = column_or_1d(y.numpy() if isinstance(y, Tensor) else y)
        check_consistent_length(windows, y)
        check_classification_targets(y)
        self.classes_ = np.unique(y)
        if len(self.classes_) < 2:
            raise ValueError("y must have two classes or more, got 1 class; give rows of others")
        is_binary = len(self.classes_) == 2
        if is_binary:
            place = _place_of_slip(self.classes_.tolist(), self.slip_label)
        elif self.slip_label is not None:
            raise ValueError(
                f"slip_label is for two labels, and y has {len(self.classes_)}; leave it out, or "
                "fit y == slip_label"
            )
        self.slip_label_: Any = self.classes_[place] if is_binary else None
        recipe = features._recipe(
            views=features._views(self.views),
            num_features=self.num_features,
            penalties=self.penalties,
            threshold=self.threshold,
            drop_channels=self.drop_channels,
            sample_bins=max(len(windows), 2),
        )
        pool, (group, names) = features._pool, _groups(y, groups)
        with torch.no_grad():
            x = pool(features._bins(windows), torch.float64)
            if torch.equal(x, x[:1].expand_as(x)):
                what = "no feature of X differs between windows, so nothing is learned"
                warnings.warn(f"{what}; check that X holds samples", UserWarning, stacklevel=2)
            if is_binary:
                is_slip = torch.from_numpy(np.asarray(y == self.slip_label_))
                fit = _fitted(recipe, pool, x, is_slip, group, names)
                detector = fit.detector(pool, features._filter, self._calibrated(fit, recipe))
                hop = max(pool.bin_samples // 2, 1)
                settings = AlarmSettings(hop, self._slope, KOfN(2, 3), 0.0, None)
                detector.info[KEY] = settings.to_dict()  # as onset=debounced
            else:
                labels = torch.from_numpy(np.searchsorted(self.classes_, y))
                fits = _fitted_to_classes(recipe, pool, x, labels, group, names)
                detector = fits.detector(pool, features._filter, self._calibrated_heads(fits))
        stuck = _stuck_samples(pool, windows)
        detector.sensing = replace(detector.sensing, stuck_samples=stuck)
        self._set(detector, features)
        return self

    def _calibrated(self, fit: Fit, recipe: General) -> dict[str, Any]:
        """Take the calibration of a fit of two labels; metadata of its detector."""
        self._slope: Platt = _UNCALIBRATED
        if fit.calibration is not None:
            self._slope = Platt(fit.calibration["slope"], 0.0)  # a score of 0 says nothing
        return fit.metadata | {
            "recipe": recipe.name,
            "calibration": self._slope.to_dict(),
            "classes": self._ordered(self.classes_.tolist()),
        }

    def _calibrated_heads(self, fits: ClassFit) -> dict[str, Any]:
        """Take the heads of more than two labels and one calibration of all; metadata.

        Of one calibration the most probable label is that of the highest score.
        """
        self._heads, choice = fits.heads, fits.choice
        known = [each for each in choice.calibration if each is not None]
        self._slope = _UNCALIBRATED
        if known:
            slope, offset = (mean(each[name] for each in known) for name in ("slope", "offset"))
            self._slope = Platt(slope, offset)
        return {
            "views": choice.shares,
            "penalty": choice.penalty,
            "validation": list(choice.rows),
        }

    def _described_by(self) -> TactileFeatures:
        """How windows are described, not fitted."""
        if self.features is None:
            if self.sample_rate_hz is None:
                raise ValueError("the rate of the windows is not known; give sample_rate_hz=")
            return TactileFeatures(self.sample_rate_hz, self.hand)
        if not isinstance(self.features, TactileFeatures):
            raise TypeError(
                f"features must be TactileFeatures, got {self.features!r}; give "
                "TactileFeatures(sample_rate_hz)"
            )
        if self.sample_rate_hz is not None or self.hand is not None:
            raise ValueError("give sample_rate_hz and hand, or features=, which has both")
        described: TactileFeatures = clone(self.features)
        return described

    def decision_function(self, X: ArrayLike | Tensor) -> Array:
        """Scores, of two labels ``[N]``; above 0 means ``classes_[1]``, 0: not valid.

        Of more labels ``[N, L]``: the highest decides, and all are 0 where it is not valid.
        """
        score = self._score(X)[0]
        is_first = self._is_binary and self.slip_label_ == self.classes_[0]
        return -score if is_first else score

    def predict(self, X: ArrayLike | Tensor) -> Array:
        """Labels ``[N]``: slip where the score is at least 0, and the decision is valid.

        Of more than two labels that of the highest score, the first where it is not valid.
        """
        score, is_valid = self._score(X)
        if not self._is_binary:
            best: Array = self.classes_[score.argmax(1)]
            return best
        is_slip = (score >= 0) & is_valid
        other = self.classes_[self.classes_ != self.slip_label_][0]
        found: Array = np.where(is_slip, self.slip_label_, other).astype(self.classes_.dtype)
        return found

    def predict_proba(self, X: ArrayLike | Tensor) -> Array:
        """Probabilities of ``classes_``, ``[N, L]``, for classes that are equally frequent.

        Calibrated on the scores of groups that were left out (Platt's slope); of two labels one
        half is where the decision changes. Equal where the decision is not valid. Of more than two
        labels the probability of each against the others, divided by their sum.
        """
        score = torch.from_numpy(self._score(X)[0])
        if not self._is_binary:
            log_odds = self._slope.llr(score) - math.log(len(self.classes_) - 1)
            each: Array = logsigmoid(log_odds).softmax(1).numpy()
            return each
        slip = probability(self._slope.llr(score), 0.5).numpy()
        return np.stack(self._ordered([1 - slip, slip]), axis=1)

    def predict_valid(self, X: ArrayLike | Tensor) -> Array:
        """Which decisions are valid, ``[N]``, bool: enough channels of the window are alive.

        A channel is not alive that hardly moves, less than a tenth of what it did at rest in
        training, or holds a NaN or Inf (``features.sensing``).
        """
        return self._score(X)[1]

    @classmethod
    def from_detector(cls, detector: SlipDetector, *, filtered: bool = False) -> SlipClassifier:
        """A fitted classifier that scores as a detector does.

        Its labels are those that the detector was fitted with by a classifier, or 0 and 1.

        Args:
            detector: trained in any way.
            filtered: whether windows will come filtered; raw ones with their context otherwise.
        """
        pool, layer = detector.pool, detector.channel_filter
        labels = list(detector.info.get("classes") or (0, 1))
        features = TactileFeatures(
            pool.sample_rate_hz, pool.hand, filtered=filtered, align=layer.align
        )
        features._set(pool, layer)
        made = cls(features=features, slip_label=labels[1])
        made.classes_, made.slip_label_ = np.unique(np.array(labels)), np.array(labels)[1]
        found = detector.calibration
        made._slope = _UNCALIBRATED if found is None else found[0]
        made._set(detector, features)
        return made

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write ``detector_``, which every command takes; what only another fit needs is lost."""
        check_is_fitted(self)
        self._whole().save(path)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> SlipClassifier:
        """Read what ``save`` wrote, or any detector; nothing in the file is executed.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if it is none, or a damaged one.
        """
        return cls.from_detector(SlipDetector.load(path))

    def export_onnx(self, folder: str | os.PathLike[str]) -> tuple[Any, ...]:
        """Write ``model.onnx`` and, if the detector has an alarm, as ``fit`` sets, ``stream.onnx``.

        Returns:
            The paths; each has its metadata beside it, ``<file>.json``.
        """
        check_is_fitted(self)
        detector = self._whole()
        return export_detector(detector, folder, wanted_graphs(None, detector))

    @property
    def detector_(self) -> SlipDetector:
        """The ``SlipDetector``, for streams, ONNX and the commands; of two labels only.

        As ``fit`` sets it, its alarm is raised where two of three decisions say slip, half a bin
        apart; after ``load`` and ``from_detector`` it has the alarm of the file or detector.
        """
        return self._whole()

    def _whole(self) -> SlipDetector:
        """The detector, which scores as the classifier does.

        Raises:
            AttributeError: if it is not fitted, or to more than two labels.
        """
        if not hasattr(self, "_detector"):
            raise AttributeError("not fitted yet; call fit")
        if not self._is_binary:
            raise AttributeError(
                f"a classifier of {len(self.classes_)} labels is no detector: files, streams and "
                "ONNX are of two; pickle it, or fit one label against the others, y == label"
            )
        return self._detector

    @property
    def _is_binary(self) -> bool:
        return len(self.classes_) == 2

    def _set(self, detector: SlipDetector, features: TactileFeatures) -> None:
        self._detector, self._features = detector, features
        self.views_: dict[str, float] = detector.info.get("views", {})
        self.penalty_: Any = detector.info.get("penalty")
        self.validation_: list[dict[str, Any]] = detector.info.get("validation", [])

    def _score(self, X: Any) -> tuple[Array, Array]:
        """Scores, positive for slip or for each label, float64, 0 where not valid; which are."""
        check_is_fitted(self)
        windows = self._features._read(X, self._features.hand_, may_miss=True)
        with torch.no_grad():
            bins = self._features._bins(windows)
            found = self._detector.predict(bins)
            if self._is_binary:
                score = torch.where(found.is_valid, found.score.double(), 0.0)
            else:
                parts = zip(bins.split(_PART), found.channels_lost.split(_PART), strict=True)
                columns = (self._detector.scaled_bins(*part) for part in parts)
                score = torch.cat([torch.stack([h(u) for h in self._heads], -1) for u in columns])
                score = torch.where(found.is_valid[:, None], score, 0.0)
        return score.numpy(), found.is_valid.numpy()

    def _ordered(self, pair: list[Any]) -> list[Any]:
        """Non-slip and slip of what is in the order of ``classes_``, or the other way round."""
        return pair if self.slip_label_ == self.classes_[1] else pair[::-1]

    def __sklearn_is_fitted__(self) -> bool:
        return hasattr(self, "_detector")

    def __sklearn_tags__(self) -> Any:
        return _of_windows(super().__sklearn_tags__())


def _of_windows(tags: Any) -> Any:
    tags.input_tags.two_d_array, tags.input_tags.three_d_array = False, True
    return tags


def _spans(bins: Tensor) -> Tensor:
    """Largest less smallest sample of each channel, ``[N, C, n] -> [N, C]``, float64."""
    return (bins.amax(-1) - bins.amin(-1)).double()


def _stuck_samples(pool: FeaturePool, windows: Tensor) -> int:
    """Equal samples in a row that a working channel may have, by training windows."""
    longest_run, has_fast = longest_run_of(run_lengths(windows)), bool(pool.hand.fast)
    return most_stuck_samples(pool.sample_rate_hz, longest_run, has_fast=has_fast)


_MISSING = ("None", "nan", "<NA>", "NaT")
_SLIP = re.compile(r"(?<![a-z])slip(s|ped|ping|page)?(?![a-z])")
_NO_SLIP = re.compile(r"(?<![a-z])(no|non|not|without|un)[^a-z]*slip")


def _place_of_slip(labels: list[Any], slip_label: Any) -> int:
    """Which of two labels, ascending, is slip.

    Raises:
        ValueError: if ``slip_label`` is neither, or is ``None`` and no name of a label says it.
    """
    if slip_label is not None:
        if slip_label not in labels:
            raise ValueError(
                f"slip_label={slip_label!r} is none of the labels in y, {labels}; give one of them"
            )
        return labels.index(slip_label)
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
        ValueError: if there are other numbers of rows, or a label is in one group alone.
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
    has = np.zeros((len(values), of_class.max() + 1), bool)
    has[index, of_class] = True
    rarest = int(has.sum(0).argmin())
    if len(values) > 1 and (num := has[:, rarest].sum()) < 2:
        label = np.unique(y)[rarest].item()
        raise ValueError(
            "validation leaves out groups and needs two parts that have all labels; of the "
            f"{len(values)} groups {num} has the label {label!r}; give groups of which two have "
            "it, or groups=None for blocks of rows"
        )
    return torch.from_numpy(index), tuple(str(value).replace("|", "/") for value in values)


def _fitted(
    recipe: General,
    pool: FeaturePool,
    features: Tensor,
    is_slip: Tensor,
    group: Tensor,
    names: tuple[str, ...],
) -> Fit:
    """The fit of the training to features ``[N, F]``, of which all serve for choices too."""
    bins = [
        RecordingBins(f"{index}.{part} {name}", name, features[some], is_slip[some])
        for index, name in enumerate(names)
        for part, some in enumerate((group == index).nonzero()[:, 0].split(_BLOCK))
    ]
    return recipe.fit(bins, pool)


def _fitted_to_classes(
    recipe: General,
    pool: FeaturePool,
    features: Tensor,
    labels: Tensor,
    group: Tensor,
    names: tuple[str, ...],
) -> ClassFit:
    """The fit to features ``[N, F]`` of any number of labels, whole numbers ``[N]``."""
    weights = torch.ones(len(labels), dtype=torch.float64)
    group, names = join_groups(group, labels, weights, names)
    stratum = group * (int(labels.max()) + 1) + labels
    copies = recipe.second_copies("sample", len(labels), pool)
    bins = ViewBins(features, labels, group, names, weights, stratum, copies)
    return recipe.fit_classes(bins, pool)

"""``SlipDetector``: from a bin of all channels to a score, positive for slip. One module, one file.

A file is a plain table of tensors and JSON text; loading it executes nothing.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from tactslip_torch.features.descriptors import FeatureName
from tactslip_torch.features.pool import FeaturePool, saturating
from tactslip_torch.features.pooling import ChannelPooling
from tactslip_torch.features.sensing import (
    FEWEST_SAMPLES,
    LARGEST_SAMPLE,
    Sensing,
    is_alive,
    is_enough,
)
from tactslip_torch.hand import HandLayout
from tactslip_torch.model.calibration import Platt, calibration_from_dict
from tactslip_torch.model.calibration import probability as stated
from tactslip_torch.model.kernels import QuadraticForm, collapse, kernel_from_dict
from tactslip_torch.model.prediction import ChannelMask, Prediction, predict_in_parts, without
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.native import (
    BackendName,
    Channels,
    Filters,
    Machine,
    backend_of,
    reason_unavailable,
)
from tactslip_torch.package_files import DETECTOR as FORMAT
from tactslip_torch.package_files import load_table, reading, save_table
from tactslip_torch.runtime import (
    PACKAGE,
    are_unchanged,
    has_values,
    is_concrete,
    is_traced,
    stamps_of,
)
from tactslip_torch.signals.filtering import ChannelFilter, check_samples

MOST_BYTES = 2**30
"""Of a file."""
_MOST_CHANNELS, _MOST_FRAME = 2048, 4001  # beyond, constant matrices take gigabytes or minutes


class SlipDetector(nn.Module):
    """The fitted pipeline from filtered or raw samples to a score.

    Features are computed and scaled in float64, of float32 bins too (``FeaturePool.arithmetic``);
    the head works in the dtype of the detector, float64 as fitted.

    The native engine copies the tensors of the detector and notices when they change, but for a
    change through ``.data``, which torch does not count: change them under ``torch.no_grad``.

    Args:
        pool: what features there are, F of C channels.
        channel_filter: the Savitzky-Golay filter of each channel.
        selected: pool indices of the features that are read, best first: the K columns themselves
            or, with ``pooling``, its inputs.
        scaler: from the K columns to S scaled columns, as many unless it has ``columns``.
        head: the machine on scaled columns.
        info: JSON-able metadata about the training, kept in the file.
        imputation: scaled columns in place of those of a lost channel, ``[S]``; default 0.
        pooling: from the features that are read to the columns; ``None``: they are the columns.
        sensing: what training found of channels that work: from it follows which channels are lost
            and which decisions are not valid. May be set at any time. Default:
            ``Sensing.unknown``.
        backend: what features are made by where no gradient is asked for (``FeaturePool``).

    Shape:
        - bins: ``[*, C, n]``, filtered, in volts; ``n = pool.bin_samples``
        - score: ``[*]``, dtype of ``bins``; at least 0 means slip, NaN: not valid
        - inside: ``bins -> features [*, M] -> columns [*, K] -> scaled [*, S] -> score [*]``
        - raw samples, for ``score_raw`` and ``predict_raw``: ``[*, C, before + n + after]``, with
          ``context_before`` and ``context_after`` samples around the bin

    Raises:
        ValueError: if the parts disagree about the number of channels or features.
    """

    imputation: Tensor
    channel_index: Tensor  # of each scaled column; one past the last channel for a pooled one
    needed_index: Tensor  # of the channels in use
    _is_used: Tensor
    counted: Tensor  # [C], 1 for channels that count among those that must be alive

    def __init__(
        self,
        pool: FeaturePool,
        channel_filter: ChannelFilter,
        selected: Sequence[int],
        scaler: FeatureScaler,
        head: QuadraticForm,
        info: Mapping[str, Any] | None = None,
        imputation: Tensor | None = None,
        pooling: ChannelPooling | None = None,
        *,
        sensing: Sensing | None = None,
        backend: BackendName = "auto",
    ) -> None:
        super().__init__()
        if imputation is None:
            imputation = torch.zeros(len(scaler.minimum))
        self.pool, self.channel_filter = pool, channel_filter
        self.extractor = pool.select(selected, backend)
        self.selected = self.extractor.selected
        self.pooling, self.scaler, self.head = pooling, scaler, head
        self.info = dict(info or {})
        self._engine: _Engine | None = None
        self._check_parts(imputation)
        self.register_buffer("imputation", imputation.to(next(head.buffers()), copy=True))
        place = {name: index for index, name in enumerate(pool.hand.names)}
        channels = [place.get(name.channel, len(place)) for name in self.selected_names]
        if scaler.columns is not None:
            channels = [channels[column] for column in scaler.columns.tolist()]
        indices = {"channel": channels, "needed": self.extractor.plan.channels}
        for name, index in indices.items():
            self.register_buffer(f"{name}_index", torch.tensor(index), persistent=False)
        is_used = torch.zeros(len(pool.hand), dtype=torch.bool)
        is_used[list(indices["needed"])] = True
        self.register_buffer("_is_used", is_used, persistent=False)
        counted = torch.zeros(len(pool.hand), dtype=torch.float64)
        counted[counted_channels(pool.hand, indices["needed"], pooling is not None)] = 1.0
        self.register_buffer("counted", counted, persistent=False)
        if sensing is None:
            num = int(counted.sum())
            sensing = Sensing.unknown(len(pool.hand), num, pool.sample_rate_hz)
        self.sensing = sensing

    @property
    def sensing(self) -> Sensing:
        """What training tells of channels that work."""
        return self._sensing

    @sensing.setter
    def sensing(self, sensing: Sensing) -> None:
        if len(sensing.rest_span) != (num := len(self.pool.hand)):
            raise ValueError(f"expected spans of {num} channels, got {len(sensing.rest_span)}")
        if sensing.min_alive > (most := int(self.counted.sum())):
            raise ValueError(f"min_alive is {sensing.min_alive}, of {most} channels that count")
        self._sensing, self._engine = sensing, None

    def __repr__(self) -> str:
        pool, info = self.pool, self.info
        degree = "linear" if self.head.is_linear else "quadratic"
        simulated, name = info.get("simulated"), info.get("name", "")
        name = name and f"{name}: "
        origin = f", trained on {'simulated' if simulated else 'real'} recordings"
        said = "has an alarm" if "alarm" in info else "no alarm set"
        return (
            f"SlipDetector({name}{len(pool.hand)} channels, bins of {pool.bin_samples} samples at "
            f"{pool.sample_rate_hz:g} Hz, {len(self.selected_names)} columns, {degree} machine"
            f"{origin * (simulated is not None)}, {said}, {self.extractor.backend} backend)"
        )

    @property
    def calibration(self) -> tuple[Platt, float] | None:
        """What makes a probability of a score, and the share of slip that it is stated for.

        That of the alarm in ``info``; else that of the held-out scores its training chose by, at
        equal shares; else None.
        """
        if alarm := self.info.get("alarm"):
            return calibration_from_dict(alarm["calibration"]), float(alarm["slip_share"])
        if plain := self.info.get("calibration"):
            return calibration_from_dict(plain), 0.5
        return None

    @property
    def selected_names(self) -> tuple[FeatureName, ...]:
        """Names of the columns, best first."""
        return self.extractor.names if self.pooling is None else self.pooling.names

    @property
    def context_before(self) -> int:
        """Samples that a raw bin needs before it; with a causal filter, all of its context."""
        return self.channel_filter.context_before

    @property
    def context_after(self) -> int:
        """Samples that a raw bin has after it; only the first ``look_ahead`` matter."""
        return self.channel_filter.context_after

    @property
    def look_ahead(self) -> int:
        """Samples after a bin that its score needs, by the filters of the channels in use.

        What comes after them may be anything; so a stream of the paper's fast channels waits for 5
        samples, 2.5 ms, and fills up the rest.
        """
        return max(self.channel_filter.reaches[i][1] for i in self.extractor.plan.channels)

    def forward(self, bins: Tensor) -> Tensor:
        """Scores of filtered bins, as ``predict`` has them: at least 0 is slip, NaN not valid.

        Shape:
            - bins: ``[*, C, n]``
            - output: ``[*]``, dtype of ``bins``

        Raises:
            ValueError: if the number of channels or samples is another.
        """
        return self.predict(bins).score

    def score_raw(self, samples: Tensor) -> Tensor:
        """Scores of raw bins that come with their context, as ``predict_raw`` has them.

        Shape:
            - samples: ``[*, C, context_before + n + context_after]``, volts
            - output: ``[*]``, dtype of ``samples``

        Raises:
            ValueError: if the number of channels or samples is another.
        """
        return self.predict_raw(samples).score

    def predict(
        self,
        bins: Tensor,
        given: torch.dtype | None = None,
        masked_channels: ChannelMask | None = None,
    ) -> Prediction:
        """Score filtered bins of a hand whose sensors may fail: a score, and whether it counts.

        A channel with NaN or Inf counts as missing.

        Args:
            bins: in volts.
            given: dtype of the samples that the bins were filtered from, float32 or float64, by
                default theirs; that of the score, whose rounding a span must exceed (the raw
                samples are not known here).
            masked_channels: channels that count as missing whatever they say.

        Shape:
            - bins: ``[*, C, n]``

        Raises:
            ValueError: if the number of channels or samples is another, for another dtype, or for a
                masked channel that the hand does not have.
        """
        self.pool.check(bins)
        return self._predict_in_parts(bins, False, given, masked_channels)

    def predict_raw(
        self,
        samples: Tensor,
        given: torch.dtype | None = None,
        masked_channels: ChannelMask | None = None,
    ) -> Prediction:
        """``predict`` for raw bins with their context, where NaN and Inf count as filters reach it.

        A channel is alive only if its filtered samples vary by more than the rounding of the raw
        samples in its frames (``features.pool.LEAST_SPAN``). So a channel with nothing but a tone
        that the filter removes is not alive, however loud the tone is.

        Shape:
            - samples: ``[*, C, context_before + n + context_after]``, volts

        Raises:
            ValueError: as ``predict``.
        """
        self._check_raw(samples)
        return self._predict_in_parts(samples, True, given, masked_channels)

    def probability(self, samples: Tensor | NDArray[Any]) -> Tensor:
        """How probable slip is, by ``calibration``: of filtered bins, or of raw ones; else NaN.

        It is NaN where the decision is not valid. Lost channels are left out, as ``predict`` does.

        Shape:
            - samples: ``[*, C, n]``, filtered, or ``[*, C, context_before + n + context_after]``
            - output: ``[*]``

        Raises:
            ValueError: if scores were not calibrated, or as ``predict_raw``.
        """
        if (known := self.calibration) is None:
            raise ValueError(
                "this detector has no calibration, as its training chose nothing; train with "
                "several recipe.penalties, or use the score"
            )
        x = torch.as_tensor(samples)
        is_filtered = x.ndim > 0 and x.shape[-1] == self.pool.bin_samples
        found = self.predict(x) if is_filtered else self.predict_raw(x)
        score = torch.where(found.is_valid, found.score, 0.0)
        return stated(known[0].llr(score), known[1]).masked_fill(~found.is_valid, torch.nan)

    def predict_proba(self, samples: Tensor | NDArray[Any]) -> Tensor:
        """Probabilities of non-slip and slip, ``[*, 2]``; otherwise as ``probability``."""
        slip = self.probability(samples)
        return torch.stack([1 - slip, slip], -1)

    def columns(self, features: Tensor, is_lost: Tensor | None = None) -> Tensor:
        """What the scaler takes: features, pooled over channels where the detector does that.

        Shape:
            - features: ``[*, M]`` in the order of ``selected``
            - is_lost: ``[*, C]``, bool, channels to leave out of their pools
            - output: ``[*, K]``
        """
        if self.pooling is None:
            return features
        columns: Tensor = self.pooling(features, is_lost, self.extractor.backend)
        return columns

    def scaled(self, features: Tensor, is_lost: Tensor | None = None) -> Tensor:
        """Scaled columns ``[*, S]``, which the head takes; otherwise as ``columns``."""
        columns = self.columns(saturating(features, self.scaler.minimum.dtype), is_lost)
        scaled: Tensor = self.scaler(columns).to(self.imputation.dtype)
        return scaled if is_lost is None else self.imputed(scaled, is_lost)

    def sensed(self, span: Tensor, run: Tensor) -> tuple[Tensor, Tensor]:
        """Channels that are lost and bins that are valid, as ``predict_raw`` finds them.

        Args:
            span: of filtered bins, 0 if it is within the rounding of the raw samples.
            run: most equal samples in a row in the frames of the bins.

        Shape:
            - span, run: ``[N, C]``
            - output: ``[N, C]`` and ``[N]``, bool
        """
        alive = run <= self.sensing.stuck_samples
        if self.pool.bin_samples >= FEWEST_SAMPLES:
            floor = torch.tensor(self.sensing.floor, dtype=torch.float64, device=span.device)
            alive &= (span > 0) & (span >= floor)
        sensing, channels = self.sensing, range(len(self.pool.hand))
        is_valid, _ = is_enough(alive & self._is_used, span, self.counted, sensing, channels)
        return ~alive & self._is_used, is_valid

    def scaled_bins(self, bins: Tensor, is_lost: Tensor) -> Tensor:
        """Scaled columns of filtered bins, for other heads on the same columns.

        Shape:
            - bins: ``[*, C, n]``, filtered; is_lost: ``[*, C]``, bool, as ``predict`` found it
            - output: ``[*, S]``
        """
        bins = torch.where(is_lost[..., None], 0.0, self.pool.widen(bins))
        return self.scaled(self._features(bins), is_lost)

    def imputed(self, scaled: Tensor, is_lost: Tensor) -> Tensor:
        """Scaled columns ``[*, S]`` with imputation values in those of lost channels ``[*, C]``."""
        pooled = torch.zeros_like(is_lost[..., :1])  # a pooled column is of the other channels
        is_filled = torch.cat([is_lost, pooled], -1).index_select(-1, self.channel_index)
        return torch.where(is_filled, self.imputation, scaled)

    def _check_raw(self, samples: Tensor) -> None:
        check_samples(samples)
        (channel_filter := self.channel_filter).check(samples)
        before, after = channel_filter.context_before, channel_filter.context_after
        if samples.shape[-1] != (wanted := before + self.pool.bin_samples + after):
            raise ValueError(
                f"expected bins of {wanted} samples, {before} of context before and {after} "
                f"behind, got {samples.shape[-1]}"
            )

    def _predict_in_parts(
        self,
        x: Tensor,
        is_raw: bool,
        given: torch.dtype | None,
        masked_channels: ChannelMask | None,
    ) -> Prediction:
        names, dtype = self.pool.hand.names, given or x.dtype
        if dtype not in _DTYPES:
            raise ValueError(
                f"given must be torch.float32 or torch.float64, got {dtype}; use torch.float32 for "
                "samples of less"
            )
        x = without(x, masked_channels, names)
        return predict_in_parts(lambda part: self._predict(part, is_raw, dtype), x)

    def _predict(self, x: Tensor, is_raw: bool, given: torch.dtype) -> Prediction:
        """The same, as they were given in a dtype, which is the score's."""
        if (engine := self._engine_of(x)) is not None:
            return engine.predict(x, is_raw, given)
        return self._predict_by_torch(x, is_raw, given)

    def _predict_by_torch(self, x: Tensor, is_raw: bool, given: torch.dtype) -> Prediction:
        used = self.extractor.plan.channels
        bins = self._filter(x) if is_raw else x
        high, low = bins.detach().amax(-1).double(), bins.detach().amin(-1).double()
        largest = torch.maximum(high, -low)
        loudest = self.channel_filter.raw_magnitude(x, used) if is_raw else largest
        is_known = largest <= min(LARGEST_SAMPLE, torch.finfo(bins.dtype).max)
        if is_traced():  # onnxruntime's maxima pass over NaN
            is_known = bins.isfinite().all(-1) & is_known
        span, alive = high - low, is_known
        if self.pool.bin_samples >= FEWEST_SAMPLES:
            inverse = self.pool.inverse_span(given, is_raw).to(span.device)
            floor = torch.tensor(self.sensing.floor, dtype=torch.float64, device=span.device)
            alive = is_alive(span, loudest, is_known, inverse, floor)
        is_used = torch.zeros_like(is_known[..., :1]) | self._is_used
        is_lost = ~alive & is_used
        is_valid, in_range = is_enough(
            alive & is_used, span, self.counted, self.sensing, range(len(self.pool.hand))
        )
        bins = self.pool.widen(bins)
        is_whole = _is_all_false(~is_known)
        if not is_whole:
            bins = torch.where(is_known[..., None], bins, 0.0)
        features = self._features(bins)
        scaled = self.scaled(features, None if is_whole and _is_all_false(is_lost) else is_lost)
        score = saturating(self.head(scaled), given)
        is_valid = is_valid & score.isfinite()
        score = torch.where(is_valid, score, torch.nan)
        span = torch.where(is_known & is_used, span, torch.nan)
        return Prediction(score, is_valid, in_range & is_valid, is_lost, span)

    def _engine_of(self, x: Tensor) -> _Engine | None:
        """The native engine of the whole detector, where only values are asked for."""
        if self.extractor.backend != "native" or not is_concrete(x):
            return None
        names = ("pooling", "scaler", "head", "channel_filter", "extractor")
        modules = [m for name in names if (m := self._modules.get(name)) is not None]
        if any(m._forward_hooks or m._forward_pre_hooks or "forward" in vars(m) for m in modules):
            return None
        tensors = [x for m in modules for x in m._buffers.values() if x is not None]
        if torch.is_grad_enabled() and any(x.requires_grad for x in tensors):
            return None
        engine = self._engine
        if engine is None or modules != engine.modules or not are_unchanged(tensors, engine.stamps):
            if not all(is_concrete(each) for each in tensors):
                return None
            if any(type(m) not in _KNOWN_TO_ENGINE for m in modules if m is not self.head):
                return None
            with torch.inference_mode(False), torch.no_grad():
                engine = self._engine = _Engine(self, modules, tensors)
        return engine

    def engine_tables(self) -> tuple[ctypes.Structure, ctypes.Structure]:
        """What the native engine reads of features and of all behind them, in float64.

        They are valid as long as the detector is there and no part of it changes.

        Raises:
            ValueError: if there is no native engine, or none for the parts of this detector.
        """
        engine = self._engine_of(torch.empty(0, dtype=torch.float64))
        if engine is None or not engine.machines[np.float64].has_head:
            reason = reason_unavailable() or "a part of it is none that the engine knows"
            raise ValueError(f"no tables of the native engine for this detector: {reason}")
        return engine.features[torch.float64].plan, engine.machines[np.float64].of

    def __getstate__(self) -> dict[str, Any]:
        """Without the engine, which holds addresses."""
        return self.__dict__ | {"_engine": None}

    def _filter(self, samples: Tensor) -> Tensor:
        return self.channel_filter.valid(self.pool.widen(samples), self.extractor.plan.channels)

    def _features(self, bins: Tensor) -> Tensor:
        features: Tensor = self.extractor(bins, self.scaler.minimum.dtype)
        return features

    def _apply(self, fn: Callable[..., Any], recurse: bool = True) -> SlipDetector:
        """``float()`` and ``to()``: what is known of features stays float64, as offsets cancel."""
        modules = [m for m in (self.scaler, self.pooling) if m is not None]
        exact = [(each, *part) for each in modules for part in each.named_buffers()]
        super()._apply(fn, recurse)  # type: ignore[no-untyped-call]  # torch has no annotations
        for module, name, value in exact:
            setattr(module, name, value.to(getattr(module, name).device))
        return self

    def _check_parts(self, imputation: Tensor) -> None:
        """Refuse parts that disagree about the number of channels or features."""
        pool, pooling, num = self.pool, self.pooling, len(self.selected)
        if pooling is not None:
            given = tuple(pool.names[index] for index in self.selected)
            if given != pooling.inputs or pooling.hand != pool.hand:
                raise ValueError(
                    f"{num} selected features do not fit a pooling of {len(pooling.inputs)}: they "
                    "must be its inputs, in their order"
                )
            num = len(pooling.names)
        if (columns := self.scaler.columns) is not None:
            if bool((columns >= num).any()):
                most = int(columns.max())
                raise ValueError(f"the scaler takes column {most} of {num}, counted from 0")
            num = len(columns)
        if not num == len(self.scaler.minimum) == self.head.num_features:
            raise ValueError(
                f"{num} columns, a scaler of {len(self.scaler.minimum)} and a head of "
                f"{self.head.num_features}: the three must agree"
            )
        if (num_frames := len(self.channel_filter.window_lengths)) != len(pool.hand):
            raise ValueError(
                f"a filter of {num_frames} channels does not fit a hand of {len(pool.hand)}"
            )
        if imputation.shape != (num,) or not bool((imputation.abs() <= 1).all()):
            raise ValueError(
                f"imputation must be {num} scaled columns in [-1, 1], got "
                f"{tuple(imputation.shape)} of at most {float(imputation.abs().max()):g}"
            )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the detector to one file, whole or not at all."""
        metadata = {
            "channels": self.pool.hand.to_rows(),
            "pool": self.pool.config(),
            **self.channel_filter.config(),
            "selected": list(self.selected),
            "pooling": None if self.pooling is None else self.pooling.to_dict(),
            "sensing": self.sensing.to_dict(),
            "info": dict(self.info),
        }
        tensors = {name: value.cpu() for name, value in self.state_dict().items()}
        save_table(path, FORMAT, metadata, tensors)

    @classmethod
    def load(cls, path: str | os.PathLike[str], backend: BackendName = "auto") -> SlipDetector:
        """Read a detector; nothing in the file is executed.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if it is not a detector file, a damaged one, or of an earlier version.
        """
        backend_of(backend)
        try:
            metadata, state = load_table(path, FORMAT, MOST_BYTES)
        except FileNotFoundError:
            raise FileNotFoundError(f"no detector at {os.fspath(path)}") from None
        with reading(path), torch.inference_mode(False):  # it may be differentiated later
            return cls._from_table(metadata, {k: v.clone() for k, v in state.items()}, backend)

    @classmethod
    def pretrained(cls, name: str = "paper24-sim", backend: BackendName = "auto") -> SlipDetector:
        """A detector that comes with the package, its alarm set.

        ``"paper24-sim"`` is of the paper's hand (``HandLayout.paper24``), trained on simulated
        recordings of it alone: to try things, not for a hand. ``info`` tells what its test found.

        Raises:
            ValueError: if there is none of that name.
        """
        folder = PACKAGE / "pretrained"
        known = sorted(path.stem for path in folder.glob("*.pt"))
        if name not in known:
            raise ValueError(f"no pretrained detector {name!r}; there are {', '.join(known)}")
        return cls.load(folder / f"{name}.pt", backend)

    @classmethod
    def _from_table(
        cls, metadata: Mapping[str, Any], state: Mapping[str, Tensor], backend: BackendName
    ) -> SlipDetector:
        """What ``save`` wrote."""
        numbers = {name: value for name, value in state.items() if name != "scaler.columns"}
        if odd := [name for name, value in numbers.items() if not value.is_floating_point()]:
            raise ValueError(f"{odd[0]} must hold floating-point numbers")
        for name, most in (("channels", _MOST_CHANNELS), ("window_lengths", _MOST_CHANNELS)):
            if len(metadata[name]) > most:
                raise ValueError(f"{name} must be at most {most}, got {len(metadata[name])}")
        if (longest := max(metadata["window_lengths"])) > _MOST_FRAME:
            raise ValueError(f"window_lengths must be at most {_MOST_FRAME}, got {longest}")

        def part(name: str) -> dict[str, Any]:
            start = f"{name}."
            own = {key: value for key, value in state.items() if key.startswith(start)}
            return {key.removeprefix(start): value for key, value in own.items()}

        hand, pooling = HandLayout.from_rows(metadata["channels"]), metadata.get("pooling")
        if (kernel := metadata.get("kernel")) is None:
            head = QuadraticForm(**part("head"))
        else:  # an earlier version kept the sum over bins where these were fewer than columns
            head = collapse(**part("head"), kernel=kernel_from_dict(kernel))
        return cls(
            FeaturePool(hand, **metadata["pool"]),
            ChannelFilter(
                metadata["window_lengths"],
                metadata["polyorder"],
                metadata["align"],
                metadata.get("kernels"),  # only where they are none of Savitzky-Golay's
            ),
            metadata["selected"],
            FeatureScaler(**part("scaler")),
            head,
            metadata["info"],
            state["imputation"],
            pooling and ChannelPooling.from_dict(hand, pooling, part("pooling")),
            sensing=Sensing.from_dict(metadata["sensing"]),
            backend=backend,
        )


class _Engine:
    """A detector's filter, features, pooling, scaling and head in one call of the native engine.

    Args:
        detector: as it stands; another engine is made when a part of it changes.
        modules: that it is of.
        tensors: of these.
    """

    def __init__(
        self, detector: SlipDetector, modules: list[nn.Module], tensors: Sequence[Tensor]
    ) -> None:
        self.modules, self.stamps = modules, stamps_of(tensors)
        self._of = detector
        scaler, head, channel_filter = detector.scaler, detector.head, detector.channel_filter
        more: dict[str, Any] = {
            "scaling": (
                scaler.minimum.double().numpy(),
                scaler.maximum.double().numpy(),
                None if scaler.compression is None else scaler.compression.double().numpy(),
                None if scaler.columns is None else scaler.columns.numpy(),
            )
        }
        if type(head) is QuadraticForm:
            quadratic, linear = head.quadratic.double(), head.linear.double()
            more["head"] = (quadratic.numpy(), linear.numpy(), float(head.constant))
            more["signs"] = None if head.signs is None else head.signs.double().numpy()
        hand, sensing = detector.pool.hand, detector.sensing
        of_channel = detector.channel_index.numpy()
        of_channel = np.where(of_channel < len(hand), of_channel, -1)
        more["imputation"] = detector.imputation.double().numpy(), of_channel
        if detector.pooling is not None:
            make = detector.pooling.machine
        else:
            num = len(detector.selected)
            singles = [(i, i) for i in range(num)]
            make = partial(
                Machine,
                num_channels=len(hand),
                num_inputs=num,
                num_columns=num,
                singles=singles,
            )
        channels = range(len(hand))
        kernels = [channel_filter.kernel(c).numpy() for c in channels]
        reaches = [channel_filter.reaches[c][0] for c in channels]
        starts = [channel_filter.context_before - reach for reach in reaches]
        self._unused = ~detector._is_used.numpy()

        # by dtypes of bins, of the engine, and of samples that bins were filtered from
        self.features = {dtype: detector.extractor.engine(dtype) for dtype in _DTYPES}
        numbers = {engine.dtype for engine in self.features.values()}
        self.machines = {number: make(**more, dtype=number) for number in numbers}
        self._filters = {number: Filters(kernels, starts, number) for number in numbers}
        self._channels = {
            (number, dtype, is_raw): Channels(
                detector.pool.inverse_span(dtype, is_raw).numpy(),
                sensing.floor,
                sensing.bounds,
                detector.counted.numpy(),
                sensing.min_alive,
                number,
            )
            for number in numbers
            for dtype in _DTYPES
            for is_raw in (False, True)
        }

    def predict(self, x: Tensor, is_raw: bool, given: torch.dtype) -> Prediction:
        """As ``SlipDetector._predict``, of bins ``[*, C, n]``."""
        flat = x.detach().numpy().reshape(-1, *x.shape[-2:])
        if flat.strides[-1] != flat.itemsize:
            flat = np.ascontiguousarray(flat)
        engine = self.features[x.dtype]
        number = engine.dtype
        filters = self._filters[number] if is_raw else None
        channels = self._channels[number, given, is_raw]
        found = engine.score(self.machines[number], flat, filters, _DTYPES[given], channels)
        is_valid, score = found.is_valid, found.score
        if score is None:
            made = self._of.head(torch.from_numpy(found.scaled).to(self._of.imputation))
            score = saturating(made, given).numpy()
            score = np.where(is_valid, score, score.dtype.type(np.nan))
        is_valid &= np.isfinite(score)
        found.span[:, self._unused] = np.nan
        arrays = (score, is_valid, found.in_range & is_valid, found.is_lost, found.span)
        parts = Prediction(*map(torch.from_numpy, arrays))
        for row in found.is_odd.nonzero()[0].tolist():  # torch has no limits
            one = torch.from_numpy(flat[row : row + 1])
            own = self._of._predict_by_torch(one, is_raw, given)
            for whole, part in zip(parts, own, strict=True):
                whole[row] = part[0]
        if x.ndim == 3:
            return parts
        return Prediction(*(each.reshape((*x.shape[:-2], *each.shape[1:])) for each in parts))


def counted_channels(hand: HandLayout, used: Sequence[int], is_pooled: bool) -> list[int]:
    """Channels in use that count among those that must be alive.

    Of a detector that pools channels the fast ones, or the slow ones where none is fast; else all.
    """
    fast = [channel for channel in used if channel in hand.fast]
    return fast if is_pooled and fast else list(used)


_KNOWN_TO_ENGINE = (ChannelPooling, FeatureScaler, ChannelFilter, FeaturePool)
_DTYPES: dict[torch.dtype, Any] = {torch.float32: np.float32, torch.float64: np.float64}


def _is_all_false(mask: Tensor) -> bool:
    """Whether a mask is known to hold nowhere, so that what depends on it can be passed over."""
    return mask.device.type == "cpu" and has_values(mask) and not bool(mask.any())

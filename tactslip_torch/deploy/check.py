"""The self-check behind every export: a graph in onnxruntime against the detector in float64.

Bins: noise and a simulated slip in batches of several sizes, bins at which formulas end, channels
that are missing. Streams: a simulated slip in pieces of several sizes, another threshold, channels
that are broken or missing.

Bins that real hands produce and textbooks do not: dead sensors, rails, offsets, lost tones.

Each kind is a corner in which sums of squares cancel, overflow
or underflow, or a descriptor's definition ends.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import cycle, pairwise
from typing import Any, Literal

import numpy as np
import onnx
import onnxruntime
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import pad

from tactslip_torch.deploy.bins import Precision, RawBin, Timing
from tactslip_torch.hand import HandLayout
from tactslip_torch.model.calibration import probability
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.prediction import Prediction, without
from tactslip_torch.onset.decisions import AlarmSettings, calibration_of
from tactslip_torch.onset.rules import NOTHING_YET
from tactslip_torch.onset.streaming import StreamingDetector
from tactslip_torch.simulation.scene import Scene
from tactslip_torch.simulation.simulate import simulate

GraphKind = Literal["bin", "stream"]
Arrays = Mapping[str, NDArray[Any]]
Run = Callable[[Arrays], dict[str, NDArray[Any]]]

RAIL_V = 5.0
COUNT_V = 2 * RAIL_V / 2**16
"""One count of a converter of 16 bits."""

EXTREMES = (
    "plain",
    "constant",
    "zero",
    "spike",
    "offset 1e6, vibration 1e-6",
    "offset 1e3, vibration 1e-2",
    "rails",
    "outlier",
    "integers",
    "alternating",
    "ramp",
    "denormal",
    "huge",
    "tone without gain",
    "constant and dither",
    "synchronous",
    "mixed magnitudes",
)
"""Names of the kinds."""
DEGENERATE: tuple[str, ...] = (*EXTREMES, "step", "nan", "inf", "-inf", "all nan")
"""Degenerate bins by name."""
WORST_SD = {"float32": 1e-3, "float64": 1e-9}
"""Largest score error allowed, in standard deviations of the score on simulated bins."""
WORST_DEGENERATE_SD = {"float32": 1e-2, "float64": 1e-6}
"""The same on degenerate bins, but for those that rounding decides, and where channels are lost."""
WORST_PROBABILITY = {"float32": 1e-5, "float64": 1e-9}
"""By which a probability may differ from that of the score beside it."""
_BATCHES = (1, 7, 0, 56)  # of noise
_SIMULATED, _EACH = 256, 16  # bins, and of each degenerate kind
_BEFORE_S, _AFTER_S = 1.0, 0.5  # of the simulated onset
_FEWEST_BINS = 4  # that the simulated slip lasts at least, whatever the rate
_SPARE = 10  # samples that the simulator may leave out at the ends
_QUIET_V = 0.02  # span at rest of a channel of a detector of simulated recordings, at most
_DECISIONS = 12  # of the stream, at least
_STATISTIC = {"float32": 1e-3, "float64": 1e-8}  # by which it may differ, as a part of its range
_LATE_S = 1e-9  # by which times may differ
_ONSET_SCORE = 1e-9  # by which onset scores may, which are float64 always


def check_model(
    model: onnx.ModelProto, detector: SlipDetector, kind: GraphKind, precision: Precision
) -> dict[str, Any]:
    """Hold a model against its detector.

    Args:
        model: as written.
        detector: that it was made of.
        kind: of its graph.
        precision: of its graph.

    Returns:
        What was measured, in JSON types; ``worst_sd`` is the largest score error on noise and on
        the simulated slip, in standard deviations of the score.

    Raises:
        ValueError: for the first thing that is wrong, in one line.
    """
    run = runner(session_of(model))
    check = check_bins if kind == "bin" else check_stream
    return {
        "against": "torch float64",
        "torch": torch.__version__,
        "onnxruntime": onnxruntime.__version__,
        "simulated": True,
        **check(run, detector, precision),
    }


def session_of(model: onnx.ModelProto) -> onnxruntime.InferenceSession:
    """A session on one thread, optimised as onnxruntime does by default.

    Raises:
        ValueError: if onnxruntime cannot load the model.
    """
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.log_severity_level = 4  # what is wrong is raised
    content = model.SerializeToString()
    try:
        return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's errors have no other base in common
        raise ValueError(f"onnxruntime cannot load it: {_first_line(error)}") from error


def runner(session: onnxruntime.InferenceSession) -> Run:
    """The model as a function of arrays by name.

    Raises:
        ValueError: by the function, if the model cannot be run on what it is given.
    """
    names = [output.name for output in session.get_outputs()]

    def run(inputs: Arrays) -> dict[str, NDArray[Any]]:
        try:
            return dict(zip(names, session.run(names, dict(inputs)), strict=True))
        except Exception as error:
            shapes = ", ".join(f"{name} {list(x.shape)}" for name, x in inputs.items())
            raise ValueError(
                f"onnxruntime cannot run it on {shapes}: {_first_line(error)}"
            ) from error

    return run


def _first_line(error: BaseException) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0]


@dataclass(frozen=True)
class _Comparison:
    """A graph beside the detector in float64 that it was made of."""

    run: Run
    precision: Precision
    detector: SlipDetector
    sd: float
    """Standard deviation of the scores of what was simulated, the unit of score errors."""

    def outputs(self, inputs: Arrays, wanted: Mapping[str, str], what: str) -> dict[str, Any]:
        """What the graph gives, which must be as wanted by name, such as ``float32[7]``."""
        try:
            got = self.run(inputs)
        except ValueError as error:
            raise ValueError(f"{what}: {error}") from error
        found = {name: f"{array.dtype}{list(array.shape)}" for name, array in got.items()}
        if odd := sorted(n for n in {**found, **wanted} if found.get(n) != wanted.get(n)):
            gives, expected = (
                ", ".join(f"{name} {each.get(name, 'missing')}" for name in odd)
                for each in (found, wanted)
            )
            raise ValueError(f"{what}: it gives {gives}, expected {expected}")
        return got

    def score_error(self, error: NDArray[Any], degenerate: bool, what: str) -> float:
        """The worst score error in standard deviations, if it is no larger than it may be."""
        most = (WORST_DEGENERATE_SD if degenerate else WORST_SD)[self.precision]
        return _worst(error, most, "standard deviations", f"{what}: score")


def _worst(error: NDArray[Any], most: float, unit: str, what: str) -> float:
    if not (found := float(error.max(initial=0.0))) <= most:
        raise ValueError(f"{what} differs from torch by {found:.1e} {unit}, more than {most:g}")
    return found


def _same_flags(got: NDArray[Any], expected: NDArray[Any], what: str) -> None:
    differs = got != expected
    differs = differs.any(-1) if differs.ndim > 1 else differs
    if places := np.flatnonzero(differs).tolist():
        num = len(expected)
        raise ValueError(
            f"{what} differs from torch at {len(places)} of {num}, the first is number {places[0]}"
        )


# Bins ------------------------------------------------------------------------------------------


def check_bins(run: Run, detector: SlipDetector, precision: Precision) -> dict[str, Any]:
    """Hold a bin graph, as a function of its inputs, against the detector; as ``check_model``."""
    hand, dtype = detector.pool.hand, getattr(torch, precision)
    length, unit = RawBin.of(detector).length, _unit_of(detector)
    slip = unit * simulated_bins(hand, detector.pool.sample_rate_hz, _SIMULATED, length, dtype)
    exact = copy.deepcopy(detector).double()
    sd = _deviation(_predicted(exact, slip.double()).score.numpy())
    compare = _BinComparison(run, precision, exact, sd)
    worst = compare(slip, "simulated bins")
    for seed, batch in enumerate(_BATCHES):
        worst = max(worst, compare(unit * noise_bins(hand, batch, length, seed, dtype), "noise"))
    of_kind = {}
    for kind in DEGENERATE:
        bins = degenerate_bins(hand, kind, _EACH, length, dtype)
        of_kind[kind] = compare(bins, f"degenerate bins ({kind})", degenerate=True)
        mixed = torch.cat([bins[:1], slip[:_EACH]])  # where a graph may go another way
        compare(mixed, f"simulated bins behind a degenerate one ({kind})", behind=1)
    of_mask = {
        name: compare(without(slip, mask, hand.names), f"bins without {name}", degenerate=True)
        for name, mask in _masks(detector).items()
    }
    return {
        "bins": len(slip) + sum(_BATCHES),
        "score_sd": sd,
        "worst_sd": worst,
        "degenerate_worst_sd": of_kind,
        "missing_worst_sd": of_mask,
    }


class _BinComparison(_Comparison):
    """Bins scored by a graph, and by its detector."""

    def __call__(
        self,
        samples: Tensor,
        what: str,
        *,
        degenerate: bool = False,
        behind: int = 0,
    ) -> float:
        """The worst score error, in standard deviations, of those that rounding does not decide.

        Args:
            samples: raw bins of the channels of the hand.
            what: they are, for messages.
            degenerate: whether the larger tolerance counts.
            behind: so many bins, the scores are compared.

        Raises:
            ValueError: if anything differs by more than it may.
        """
        # a channel is alive by what its samples resolve in the precision they come in
        exact = _predicted(self.detector, samples.double(), samples.dtype)
        of_score, calibrated = f"{self.precision}[{len(samples)}]", calibration_of(self.detector)
        wanted = {"score": of_score} | dict.fromkeys(("valid", "in_range"), f"bool[{len(samples)}]")
        wanted["channels_lost"] = f"bool{[len(samples), samples.shape[1]]}"
        if calibrated is not None:
            wanted["probability"] = of_score
        got = self.outputs({"samples": samples.numpy()}, wanted, what)
        score = got["score"].astype(np.float64)
        for name, flags in (
            ("valid", exact.is_valid),
            ("in_range", exact.in_range),
            ("channels_lost", exact.channels_lost),
        ):
            _same_flags(got[name], flags.numpy(), f"{what}: {name}")
        if (odd := np.isfinite(score) != got["valid"]).any():
            raise ValueError(f"{what}: {odd.sum()} scores are not finite, or valid without a score")
        known = got["valid"] & exact.is_valid.numpy()
        error = np.where(known, np.abs(score - exact.score.numpy()), 0.0)[behind:] / self.sd
        worst = WORST_DEGENERATE_SD[self.precision]
        if degenerate and not (error <= worst).all():
            error = np.where(self._rounding_decides(samples, exact.score, worst), 0.0, error)
        found = self.score_error(error, degenerate, what)
        if calibrated is not None:
            calibration, slip_share = calibrated
            llr = calibration.llr(torch.from_numpy(score[got["valid"]]))
            off = np.abs(got["probability"][got["valid"]] - probability(llr, slip_share).numpy())
            if np.isfinite(got["probability"][~got["valid"]]).any():
                raise ValueError(f"{what}: a decision that is not valid has a probability")
            _worst(off, WORST_PROBABILITY[self.precision], "", f"{what}: probability")
        return found

    def _rounding_decides(self, samples: Tensor, score: Tensor, worst: float) -> NDArray[np.bool_]:
        """Bins ``[N]`` whose score moves by more than it may where samples move by their rounding.

        Such as the sign of a mean of 0, by which the coefficient of variation takes its own, or a
        step between values of few digits. Samples move by 4 eps of the largest of their channel,
        together and each by itself, up and down: a constant stays one.
        """
        x = samples.double()
        size = x.nan_to_num(0.0, 0.0, 0.0).abs().amax(-1, keepdim=True)
        size = 4 * torch.finfo(x.dtype).eps * size
        generator = torch.Generator().manual_seed(0)
        drawn = 2 * torch.rand((4, *x.shape), generator=generator, dtype=x.dtype) - 1
        moves = [size, -size, *(size * drawn), *(-size * drawn)]
        moved = torch.stack([_predicted(self.detector, x + move).score for move in moves])
        return ((moved - score).abs() > worst * self.sd).any(0).numpy()


def _predicted(
    detector: SlipDetector, samples: Tensor, given: torch.dtype | None = None
) -> Prediction:
    """What the detector says of a graph's bins; what no filter in use takes in is 0."""
    raw = RawBin.of(detector)
    ends = detector.context_before - raw.before, detector.context_after - raw.after
    with torch.no_grad():
        return detector.predict_raw(pad(samples, ends), given=given)


# Streams ---------------------------------------------------------------------------------------

_COLUMNS = {
    "score": "score",
    "probability": "probability",
    "statistic": "statistic",
    "valid": "is_valid",
    "in_range": "in_range",
    "channels_lost": "channels_lost",
    "alarm": "is_alarm",
    "on": "is_on",
    "time_s": "available_s",
    "onset_s": "onset_s",
}
"""Outputs of the graph, and the fields of ``Decisions`` that they are."""
_OF_ONSETS = {"onset_score": "onset_score", "by_onset": "by_onset"}
"""The same, with an onset classifier."""
_FLAGS = ("valid", "in_range", "channels_lost", "alarm", "on", "by_onset")
_TIMES = ("time_s", "onset_s")
_OF_CHANNELS = ("valid", "in_range", "channels_lost")


def _columns(settings: AlarmSettings) -> dict[str, str]:
    return _COLUMNS if settings.onset is None else _COLUMNS | _OF_ONSETS


def check_stream(run: Run, detector: SlipDetector, precision: Precision) -> dict[str, Any]:
    """Hold a stream graph, as a function of its inputs, against the detector; as ``check_model``.

    The simulated slip is repeated as often as a long hop asks for.
    """
    settings = AlarmSettings.of(detector)
    timing = Timing.of(detector, settings)
    slip = simulated_stream(
        detector.pool.hand,
        detector.pool.sample_rate_hz,
        getattr(torch, precision),
        _FEWEST_BINS * max(timing.first, timing.frame),
    )
    num = max(slip.shape[1], max(timing.first, timing.frame) + _DECISIONS * timing.hop)
    if settings.onset is not None:  # of which half is over before there is evidence
        num = max(num, 2 * settings.onset.evidence.first_hop * settings.decision_samples)
    samples = _unit_of(detector) * slip.T[torch.arange(num) % slip.shape[1]]
    exact = copy.deepcopy(detector).double()
    usual = _decided(exact, samples, settings)
    sd = _deviation(usual["score"])
    compare = _StreamComparison(run, precision, exact, sd)
    generator = np.random.default_rng(0)
    anyhow = np.cumsum(generator.integers(0, 400, num) * (generator.random(num) < 0.8))
    by_hop = range(timing.hop, num, timing.hop)
    cuts: dict[str, Sequence[int]] = {
        "whole": [],
        "by hop": by_hop,
        "by sample": range(min(num, 300)),
        "anyhow": [0, *(int(cut) for cut in anyhow if cut < num)],
    }
    worst = max(compare(samples, settings, cut, f"cut {name}") for name, cut in cuts.items())
    if settings.onset is None:
        middling = replace(settings, threshold=_middle_threshold(usual["statistic"]))
    else:
        known = usual["onset_score"][usual["onset_score"] > NOTHING_YET]
        onset = replace(settings.onset, threshold=_middle_threshold(known))
        middling = replace(settings, onset=onset)
    compare(samples, middling, by_hop, "another threshold")
    broken = _broken(samples, detector.needed_index.tolist())
    fewer = without(samples.T, _masks(detector)["every other"], detector.pool.hand.names).T
    return {
        "decisions": len(usual["score"]),
        "alarms": int(usual["alarm"].sum()),
        "score_sd": sd,
        "worst_sd": worst,
        "broken_worst_sd": compare(broken, settings, by_hop, "broken channels", degenerate=True),
        "missing_worst_sd": compare(
            fewer.contiguous(), settings, by_hop, "missing channels", degenerate=True
        ),
    }


class _StreamComparison(_Comparison):
    """A stream watched by a graph, and by its detector."""

    def __call__(
        self,
        samples: Tensor,
        settings: AlarmSettings,
        cuts: Sequence[int],
        what: str,
        *,
        degenerate: bool = False,
    ) -> float:
        """The worst score error, in standard deviations.

        Args:
            samples: of all channels, ``[T, C]``.
            settings: whose threshold the graph is given.
            cuts: places where a piece of the stream ends and the next begins.
            what: it is, for messages.
            degenerate: whether the larger tolerance counts.

        Raises:
            ValueError: if anything differs by more than it may.
        """
        expected = _decided(self.detector, samples, settings)
        got = self._watched(samples.numpy(), settings, cuts, what)
        for name in expected.keys() & _FLAGS:
            _same_flags(got[name], expected[name], f"{what}: {name}")
        off = {name: _off(got[name], expected[name]) for name in expected.keys() - {*_FLAGS}}
        if settings.onset is not None:
            _worst(off["onset_score"], _ONSET_SCORE, "", f"{what}: onset_score")
        for name in _TIMES:
            _worst(off[name], _LATE_S, "s", f"{what}: {name}")
        found = self.score_error(off["score"] / self.sd, degenerate, what)
        tells = (
            expected["statistic"] > NOTHING_YET
        )  # not NaN; before that a rule has seen too few decisions
        span = float(np.ptp(expected["statistic"][tells])) if tells.any() else 0.0
        error = off["statistic"][tells] / (span or 1.0)
        _worst(error, _STATISTIC[self.precision], "of its range", f"{what}: statistic")
        known = np.isfinite(got["score"])
        llr = settings.calibration.llr(torch.from_numpy(got["score"][known].astype(np.float64)))
        stated = probability(llr, settings.slip_share).numpy()
        error = np.abs(got["probability"][known] - stated)
        _worst(error, WORST_PROBABILITY[self.precision], "", f"{what}: probability")
        return found

    def _watched(
        self,
        samples: NDArray[Any],
        settings: AlarmSettings,
        cuts: Sequence[int],
        what: str,
    ) -> dict[str, NDArray[Any]]:
        """All columns, by a host that hands on tail and state and nothing else."""
        timing, columns = Timing.of(self.detector, settings), _columns(settings)
        threshold = np.array([(settings.onset or settings).threshold])
        feeds = {"tail": samples[:0], "state": np.empty(0), "threshold": threshold}
        pieces = []
        for start, stop in pairwise([0, *cuts, len(samples)]):
            num = timing.decisions(stop) - timing.decisions(start)
            wanted = dict.fromkeys(columns, f"{self.precision}[{num}]")
            wanted |= dict.fromkeys(columns.keys() & _FLAGS, f"bool[{num}]")
            wanted["channels_lost"] = f"bool{[num, samples.shape[1]]}"
            wanted |= dict.fromkeys(columns.keys() & {*_TIMES, "onset_score"}, f"float64[{num}]")
            wanted["next_tail"] = f"{self.precision}{[timing.tail, samples.shape[1]]}"
            wanted["next_state"] = f"float64{[timing.state_size]}"
            piece = feeds | {"samples": samples[start:stop]}
            got = self.outputs(piece, wanted, f"{what}: at sample {stop}")
            feeds["tail"], feeds["state"] = got.pop("next_tail"), got.pop("next_state")
            pieces.append(got)
        return {name: np.concatenate([piece[name] for piece in pieces]) for name in columns}


def _decided(
    detector: SlipDetector, samples: Tensor, settings: AlarmSettings
) -> dict[str, NDArray[Any]]:
    """What the detector says of a stream, under the graph's names."""
    exact, in_its_own = (
        StreamingDetector(detector, settings, dtype=dtype)
        for dtype in (torch.float64, samples.dtype)
    )
    decisions, own = exact.push(samples), in_its_own.push(samples)
    # a channel is alive by what its samples resolve in the precision they come in
    return {
        name: getattr(own if name in _OF_CHANNELS else decisions, field).numpy()
        for name, field in _columns(settings).items()
    }


def _off(got: NDArray[Any], expected: NDArray[Any]) -> NDArray[Any]:
    """By how much numbers differ; NaN does not differ from NaN, and without end from others."""
    off = np.abs(got.astype(np.float64) - expected)
    none = np.isnan(got) & np.isnan(expected)
    return np.where(none | (got == expected), 0.0, np.nan_to_num(off, nan=np.inf))


def _deviation(score: NDArray[Any]) -> float:
    """Standard deviation of the scores of valid decisions; 1 if they do not differ."""
    known = score[np.isfinite(score)]
    return float(known.std()) or 1.0 if len(known) else 1.0


def _middle_threshold(statistic: NDArray[Any]) -> float:
    """A threshold that the statistic crosses, in the widest gap between its middling values."""
    statistic = statistic[np.isfinite(statistic)]
    if not len(statistic):
        return 0.0
    low, high = np.quantile(statistic, [0.5, 0.95])
    values = np.unique(statistic[(low <= statistic) & (statistic <= high)])
    if len(values) < 2:
        return float(low)
    widest = int(np.diff(values).argmax())
    return float(values[widest : widest + 2].mean())


# Signals ---------------------------------------------------------------------------------------


def noise_bins(hand: HandLayout, num: int, length: int, seed: int, dtype: torch.dtype) -> Tensor:
    """Noise of sizes from 1 V to 1 mV, slow channels on an offset: ``[num, C, length]``, volts."""
    generator = torch.Generator().manual_seed(seed)
    size = 10 ** torch.linspace(0, -3, num, dtype=torch.float64)[:, None, None]
    noise = torch.randn(num, len(hand), length, generator=generator, dtype=torch.float64)
    samples = size * noise
    samples[:, list(hand.slow)] += 1.0
    return samples.to(dtype)


def degenerate_bins(
    hand: HandLayout, kind: str, num: int, length: int, dtype: torch.dtype
) -> Tensor:
    """Bins of one kind of ``DEGENERATE``, ``[num, C, length]``, volts.

    ``"nan"`` and the infinities are one sample of one channel of noise, another in each bin.
    """
    seed = DEGENERATE.index(kind)
    generator = torch.Generator().manual_seed(seed)
    if kind in EXTREMES:
        return extreme_bins(kind, (num, len(hand), length), generator, dtype)
    samples = noise_bins(hand, num, length, seed, dtype)
    if kind == "step":
        edge = torch.randint(length, (num, len(hand), 1), generator=generator)
        return torch.where(torch.arange(length) < edge, 0.0, RAIL_V).to(dtype)
    if kind == "all nan":
        return samples.fill_(torch.nan)
    channels = torch.randint(len(hand), (num,), generator=generator)
    places = torch.randint(length, (num,), generator=generator)
    samples[torch.arange(num), channels, places] = float(kind)
    return samples


def simulated_stream(
    hand: HandLayout, sample_rate_hz: float, dtype: torch.dtype, at_least: int = 0
) -> Tensor:
    """A slip as the simulator records it, ``[C, T]``, volts; 1 s before its onset, .5 s behind.

    Of another hand than the simulated one, each channel is the next that adapts as it does. Where
    that makes fewer samples than ``at_least``, the rate is that at which it makes so many: what a
    model is tried on must fill bins, not keep time.
    """
    simulated = HandLayout.paper24()
    places = {"slow": cycle(simulated.slow), "fast": cycle(simulated.fast)}
    rows = [next(places[str(channel.adapting)]) for channel in hand.channels]
    fewest = (at_least + _SPARE) / (_BEFORE_S + _AFTER_S)
    return _simulated(max(sample_rate_hz, fewest))[rows].to(dtype)


def simulated_bins(
    hand: HandLayout, sample_rate_hz: float, num: int, length: int, dtype: torch.dtype
) -> Tensor:
    """Bins of the simulated slip, evenly spread over it: ``[num, C, length]``, volts."""
    samples = simulated_stream(hand, sample_rate_hz, dtype, _FEWEST_BINS * length)
    starts = torch.linspace(0, samples.shape[-1] - length, num).long()
    return samples.unfold(-1, length, 1)[:, starts].movedim(1, 0).contiguous()


@lru_cache(maxsize=1)
def _simulated(sample_rate_hz: float) -> Tensor:
    """Of the whole hand, float64; not to be written to."""
    scene = Scene("M1", seed=1, sample_rate_hz=sample_rate_hz)
    onset_s = simulate(scene, windows=[]).onsets_s[0]
    window = (onset_s - _BEFORE_S, onset_s + _AFTER_S)
    samples = simulate(scene, windows=[window], dtype=torch.float64).samples
    return samples[:, samples.isfinite().all(0)]


def _broken(samples: Tensor, needed: Sequence[int]) -> Tensor:
    """Samples ``[T, C]`` with a channel that dies, one that tears off, and lost instants."""
    broken, sixth = samples.clone(), len(samples) // 6
    broken[sixth : 2 * sixth, needed[0]] = broken[sixth, needed[0]]
    broken[3 * sixth : 4 * sixth, needed[-1]] = torch.inf
    broken[5 * sixth : 5 * sixth + 30] = torch.nan
    return broken


def _masks(detector: SlipDetector) -> dict[str, Tensor]:
    """Masks ``[C]`` of channels by name: the first in use, every other one, all of them."""
    used, none = detector.needed_index, torch.zeros(len(detector.pool.hand), dtype=torch.bool)
    chosen = {"the first": used[:1], "every other": used[::2], "all": used}
    return {name: none.index_fill(0, own, True) for name, own in chosen.items()}


def _unit_of(detector: SlipDetector) -> float:
    """What a volt is to a detector, a power of 2 from 1 on.

    A detector that leaves out channels which hardly move was trained in some unit; in what it is
    tried on, something must move by it.
    """
    quietest = max(detector.sensing.rest_span) / _QUIET_V
    return 2.0 ** max(math.ceil(math.log2(quietest)), 0) if quietest > 0 else 1.0


def extreme_bins(
    kind: str,
    shape: Sequence[int],
    generator: torch.Generator,
    dtype: torch.dtype = torch.float64,
) -> Tensor:
    """Generated bins of one kind, in volts; drawn in float64 and rounded once.

    Args:
        kind: one of ``EXTREMES``.
        shape: of the result; the last axis is time and has at least two samples.
        generator: source of the random numbers.
        dtype: of the result. ``"denormal"`` and ``"huge"`` suit their size to it.

    Shape:
        - output: ``shape``

    Raises:
        ValueError: for an unknown kind or fewer than two samples.

    Example:
        >>> extreme_bins("rails", (3, 24, 100), torch.Generator().manual_seed(0)).unique()
        tensor([-5.,  5.], dtype=torch.float64)
    """
    size = tuple(shape)
    if not size or size[-1] < 2:
        raise ValueError(f"a bin needs at least two samples, got shape {size}")
    num, each = size[-1], (*size[:-1], 1)  # shape of one number a signal

    def noise(shape: tuple[int, ...] = size) -> Tensor:
        return torch.randn(shape, generator=generator, dtype=torch.float64)

    def uniform(shape: tuple[int, ...] = size) -> Tensor:
        return torch.rand(shape, generator=generator, dtype=torch.float64)

    def power_of_ten(low: float, high: float) -> Tensor:
        return 10 ** (low + (high - low) * uniform(each))

    def is_at_one_sample() -> Tensor:
        return torch.arange(num) == torch.randint(num, each, generator=generator)

    limits = torch.finfo(dtype)
    match kind:
        case "plain":
            bins = noise() * power_of_ten(-4, 0)
        case "constant":
            bins = (2 * RAIL_V * uniform(each) - RAIL_V).expand(size).clone()
        case "zero":
            bins = torch.zeros(size, dtype=torch.float64)
        case "spike":
            height = noise(each) * power_of_ten(-6, 3)
            bins = torch.where(is_at_one_sample(), height, 0.0)
        case "offset 1e6, vibration 1e-6":
            bins = 1e6 + 1e-6 * noise()
        case "offset 1e3, vibration 1e-2":
            bins = 1e3 + 1e-2 * noise()
        case "rails":
            bins = RAIL_V * torch.where(uniform() < 0.5, -1.0, 1.0)
        case "outlier":
            quiet = 1e-3 * noise()
            bins = torch.where(is_at_one_sample(), RAIL_V, quiet)
        case "integers":
            bins = torch.randint(-3, 4, size, generator=generator)
        case "alternating":
            bins = (1.0 - 2.0 * (torch.arange(num) % 2)) * power_of_ten(-3, 1).expand(size)
        case "ramp":
            bins = noise(each) * torch.linspace(-1, 1, num, dtype=torch.float64)
        case "denormal":
            bins = noise() * (limits.tiny / 8)
        case "huge":
            bins = noise() * min(1e30, limits.max / 1e6)
        case "tone without gain":  # of whole counts; a moving average over its period is 0
            one = torch.randint(-9000, 9000, (*size[:-1], 51), generator=generator)
            is_short = uniform(each) < 0.5
            one[..., 11:] = torch.where(is_short, 0, one[..., 11:])
            one[..., :1] -= one.sum(-1, keepdim=True)
            period = torch.where(is_short, 11, 51)
            bins = COUNT_V * one.gather(-1, torch.arange(num) % period)
        case "constant and dither":
            counts = torch.randint(-(2**14), 2**14, each, generator=generator)
            bins = COUNT_V * (counts + torch.randint(0, 2, size, generator=generator))
        case "synchronous":  # a tone of which each period gives the same one, two or four samples
            turns = torch.tensor([1.0, 0.5, 0.25])[torch.randint(3, each, generator=generator)]
            phase = 2 * torch.pi * uniform(each)
            bins = torch.sin(2 * torch.pi * ((turns * torch.arange(num)) % 1) + phase)
        case "mixed magnitudes":
            most = 40.0 if limits.max > 1e40 else 36.0
            bins = noise() * power_of_ten(-most, most)
        case _:
            raise ValueError(f"kind must be one of {', '.join(EXTREMES)}, got {kind!r}")
    return bins.to(dtype)

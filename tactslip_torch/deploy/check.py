"""Compares an exported graph, run by onnxruntime, with its detector in float64.

Both get the recording that comes with the package, as it is and with channels and instants lost.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping
from itertools import cycle, pairwise, takewhile
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
from tactslip_torch.onset.decisions import HOST_COLUMNS, AlarmSettings
from tactslip_torch.onset.rules import NOTHING_YET
from tactslip_torch.onset.streaming import StreamingDetector
from tactslip_torch.runtime import PACKAGE

GraphKind = Literal["bin", "stream"]
Arrays = Mapping[str, NDArray[Any]]
Run = Callable[[Arrays], dict[str, NDArray[Any]]]

LARGEST_ERROR: dict[Precision, float] = {"float32": 1e-3, "float64": 1e-9}
"""Largest error of a score in its standard deviations, and of a statistic in its range."""
_LARGEST_PROBABILITY_ERROR = {"float32": 1e-5, "float64": 1e-9}  # beside that of the given score
_LOSSES = 10.0  # by which errors may be larger where channels are lost
_CLOSE = 1e-9  # of times, and of onset scores, which are float64 always
_NUM_BINS, _NUM_DECISIONS = 128, 12
_QUIET_V = 0.02  # span at rest of a channel of the recording, at most

_OF_ONSETS = {"onset_score": "onset_score", "by_onset": "by_onset", "hint": "is_hint"}
_OF_CHANNELS = ("valid", "in_range", "channels_lost")


def check_model(
    model: onnx.ModelProto, detector: SlipDetector, kind: GraphKind, precision: Precision
) -> dict[str, Any]:
    """Compare a graph with the detector that it was made of.

    Returns:
        JSON-able; ``worst_sd`` is the largest score error where nothing is lost, in standard
        deviations of the score.

    Raises:
        ValueError: for the first output that differs, in one line.
    """
    return compare(runner(session_of(model)), detector, kind, precision)


def compare(
    run: Run,
    detector: SlipDetector,
    kind: GraphKind,
    precision: Precision,
    *,
    exact_onsets: bool = True,
) -> dict[str, Any]:
    """As ``check_model``, of a function from inputs to outputs by name.

    ``exact_onsets``: onset scores are computed in float64 whatever the precision.
    """
    exact = copy.deepcopy(detector).double()
    samples = _kept_samples(detector, kind).to(getattr(torch, precision))
    both = _bins_by_both if kind == "bin" else _stream_by_both
    calibrated = exact.calibration
    worst, sd = 0.0, 1.0
    for what, given in {"whole": samples, "losses": _with_losses(samples, exact)}.items():
        found, expected = both(run, exact, given, is_whole=what == "whole")
        score = expected["score"][np.isfinite(expected["score"])]
        if what == "whole" and len(score):
            sd = float(score.std()) or 1.0
        _assert_alike(found, expected, f"{kind} graph, {what}")
        most = LARGEST_ERROR[precision] * (1.0 if what == "whole" else _LOSSES)
        known = expected.get("statistic", score)
        known = known[known > NOTHING_YET]
        tolerances = {
            "score": most * sd,
            "time_s": _CLOSE,
            "onset_s": _CLOSE,
            "onset_score": _CLOSE,
        }
        if not exact_onsets and "onset_score" in expected:
            own = expected["onset_score"][expected["onset_score"] > NOTHING_YET]
            tolerances["onset_score"] = most * float(own.std()) if len(own) else 0.0
        tolerances["statistic"] = most * (float(np.ptp(known)) if len(known) else 0.0)
        if calibrated is not None:
            tolerances["probability"] = _LARGEST_PROBABILITY_ERROR[precision]
            llr = calibrated[0].llr(torch.from_numpy(found["score"].astype(np.float64)))
            expected["probability"] = probability(llr, calibrated[1]).numpy()
        for name, most in tolerances.items():
            if name in expected and not (off := _off(found[name], expected[name])) <= most:
                raise ValueError(
                    f"{kind} graph, {what}: {name} differs from torch by {off:.1e}, more than "
                    f"{most:.1e}"
                )
        if what == "whole":
            worst = _off(found["score"], expected["score"]) / sd
    return {
        "against": "torch float64",
        "torch": torch.__version__,
        "onnxruntime": onnxruntime.__version__,
        "simulated": True,
        "score_sd": sd,
        "worst_sd": worst,
    }


def _assert_alike(found: Arrays, expected: Arrays, what: str) -> None:
    """Outputs are those expected, with their shapes; and flags are the same."""
    for name in sorted({*found, *expected}):
        got, wanted = found.get(name), expected.get(name)
        kinds = [
            "missing" if x is None else f"{x.dtype.kind}{list(x.shape)}" for x in (got, wanted)
        ]
        if got is None or wanted is None or kinds[0] != kinds[1]:
            raise ValueError(f"{what}: {name} is {kinds[0]}, expected {kinds[1]}")
        if wanted.dtype == bool and (differs := (got != wanted).reshape(len(got), -1).any(1)).any():
            raise ValueError(
                f"{what}: {name} differs from torch at {differs.sum()} of {len(got)}, the first is "
                f"number {differs.argmax()}"
            )


def _off(found: NDArray[Any], expected: NDArray[Any]) -> float:
    """The largest difference; NaN does not differ from NaN, and without end from all else."""
    off = np.abs(found.astype(np.float64) - expected)
    is_same = (np.isnan(found) & np.isnan(expected)) | (found == expected)
    is_same |= (found < 0.99 * NOTHING_YET) & (expected <= NOTHING_YET)  # rounded to float32
    return float(np.where(is_same, 0.0, np.nan_to_num(off, nan=np.inf)).max(initial=0.0))


def _bins_by_both(
    run: Run, exact: SlipDetector, samples: Tensor, *, is_whole: bool
) -> tuple[dict[str, NDArray[Any]], dict[str, NDArray[Any]]]:
    """Outputs of the graph, and what they should be, of bins spread over samples ``[C, T]``."""
    raw = RawBin.of(exact)
    starts = torch.linspace(0, samples.shape[-1] - raw.length, _NUM_BINS).long()
    bins = samples.unfold(-1, raw.length, 1)[:, starts].movedim(1, 0).contiguous()
    bins = bins if is_whole else bins[:-1]  # of another batch
    ends = exact.context_before - raw.before, exact.context_after - raw.after
    with torch.no_grad():  # a channel is alive by what its samples resolve as they are given
        found = exact.predict_raw(pad(bins.double(), ends), given=bins.dtype)
    expected = dict(zip(("score", "valid", "in_range", "channels_lost"), found, strict=False))
    if exact.calibration is not None:
        expected["probability"] = found.score
    return run({"samples": bins.numpy()}), {k: v.numpy() for k, v in expected.items()}


def _stream_by_both(
    run: Run, exact: SlipDetector, samples: Tensor, *, is_whole: bool
) -> tuple[dict[str, NDArray[Any]], dict[str, NDArray[Any]]]:
    """The same of samples pushed in pieces of 1, 2, 3 and so on; with losses at another threshold.

    As a host does: tail and state are handed on, and nothing else is.
    """
    settings = AlarmSettings.of(exact)
    columns = HOST_COLUMNS if settings.onset is None else HOST_COLUMNS | _OF_ONSETS
    threshold = np.empty(0)
    if not is_whole:
        usual = StreamingDetector(exact, settings, dtype=torch.float64).push(samples.double().T)
        name = "statistic" if settings.onset is None else "onset_score"
        value = _middle_threshold(getattr(usual, name).numpy())
        settings = settings.at_threshold(value)
        threshold = np.array([value])
    # a channel is alive by what its samples resolve in the precision they come in
    own, decisions = (
        StreamingDetector(exact, settings, dtype=dtype).push(samples.T)
        for dtype in (samples.dtype, torch.float64)
    )
    expected = {
        name: getattr(own if name in _OF_CHANNELS else decisions, column).numpy()
        for name, column in columns.items()
    }
    rows, pieces = samples.T.numpy(), list[dict[str, NDArray[Any]]]()
    feeds = {"tail": rows[:0], "state": np.empty(0), "threshold": threshold}
    cuts = takewhile(lambda cut: cut < len(rows), (n * (n + 1) // 2 for n in range(len(rows))))
    for start, stop in pairwise([*cuts, len(rows)]):
        got = run({**feeds, "samples": rows[start:stop]})
        if missing := {*columns, "next_tail", "next_state"} - {*got}:
            raise ValueError(f"the stream graph lacks {', '.join(sorted(missing))}")
        feeds["tail"], feeds["state"] = got.pop("next_tail"), got.pop("next_state")
        pieces.append(got)
    return {name: np.concatenate([piece[name] for piece in pieces]) for name in columns}, expected


def _middle_threshold(statistic: NDArray[Any]) -> float:
    """A threshold that the statistic crosses, in the widest gap between its middling values."""
    known = statistic[statistic > NOTHING_YET]
    if not len(known):
        return 0.0
    low, high = np.quantile(known, [0.5, 0.95])
    values = np.unique(known[(low <= known) & (known <= high)])
    if len(values) < 2:
        return float(low)
    widest = int(np.diff(values).argmax())
    return float(values[widest : widest + 2].mean())


def _kept_samples(detector: SlipDetector, kind: GraphKind) -> Tensor:
    """Samples ``[C, T]`` in the detector's unit, as many as a comparison needs.

    The recording of the paper's hand that comes with the package, again from its beginning where
    it ends, whatever the rate: each channel is the next that adapts as it does.
    """
    with np.load(PACKAGE / "pretrained" / "paper24-sim.npz") as file:
        kept = torch.from_numpy(file["samples"]).double()
    known, hand = HandLayout.paper24(), detector.pool.hand
    places = {"slow": cycle(known.slow), "fast": cycle(known.fast)}
    rows = [next(places[str(channel.adapting)]) for channel in hand.channels]
    quietest = max(detector.sensing.rest_span) / _QUIET_V
    unit = 2.0 ** max(math.ceil(math.log2(quietest)), 0) if quietest > 0 else 1.0
    num = max(kept.shape[-1], 2 * RawBin.of(detector).length)
    if kind == "stream":
        settings = AlarmSettings.of(detector)
        timing = Timing.of(detector, settings)
        num = max(num, max(timing.first, timing.frame) + _NUM_DECISIONS * timing.hop)
        if settings.onset is not None:  # of which half is over before there is evidence
            num = max(num, 2 * settings.onset.evidence.first_hop * settings.decision_samples)
    return unit * kept[rows][:, torch.arange(num) % kept.shape[-1]]


def _with_losses(samples: Tensor, detector: SlipDetector) -> Tensor:
    """Samples with a channel that dies, a quiet hand, one that tears off, and lost instants."""
    broken, sixth, needed = samples.clone(), samples.shape[-1] // 6, detector.needed_index
    broken[needed[0], sixth : 2 * sixth] = broken[needed[0], sixth]
    broken[:, 2 * sixth : 3 * sixth] *= 2.0**-10
    broken[needed[1::2], 3 * sixth : 4 * sixth] = torch.inf
    broken[:, 5 * sixth : 5 * sixth + 30] = torch.nan
    return broken


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

"""Ways from one raw bin to a score, and their parts, as functions of a number."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from benchmarks.bins import WINDOW_LENGTHS, labelled_bins, raw_bins
from benchmarks.clocks import say
from benchmarks.detectors import Timed
from benchmarks.engines import DTYPES, ENGINES, FLOAT32, FLOAT64, pool_of, selected_extractor
from benchmarks.exported import ORT, session
from benchmarks.latency.sizes import Sizes
from benchmarks.peers import heads, loop, others
from tactslip_torch.features.extractor import EngineName
from tactslip_torch.model.kernels import KernelSum
from tactslip_torch.signals.filtering import ChannelFilter

LOOP = "SciPy + PyWavelets loop, kernel sum"
PRUNED_LOOP = "the same loop, only what is wanted"
SVC, RIDGE, SUM = "SVC head", "KernelRidge head", "kernel sum head"
QUADRATIC, FILTER = "scaling and quadratic head", "filter"
REFERENCE: EngineName = "reference"


class Call(NamedTuple):
    """One way to a score, or a part of it.

    Attributes:
        run: of the number of a bin, taken modulo how many there are.
        features: how many it makes.
        is_whole: whether it goes from samples to a score.
        judged: of how many bins its scores are held against the reference; 0 for another machine.
    """

    run: Callable[[int], Any]
    features: int
    is_whole: bool = True
    judged: int = 0


def ours(timed: Timed, sizes: Sizes) -> dict[str, Call]:
    """Detectors by every engine."""
    samples = raw_bins(sizes.bins)
    num = len(timed.selected)
    calls: dict[str, Call] = {}
    for dtype in (FLOAT32, FLOAT64):
        cast = samples.to(DTYPES[dtype].dtype)
        for engine in (*ENGINES, REFERENCE):
            detector = timed.detector(engine, dtype)
            run = _of_each(cast, detector.score_raw)
            calls[f"{engine}, {dtype}"] = Call(run, num, judged=sizes.judged)
    best = timed.detector(ENGINES[0], FLOAT32)
    judging = f"{ENGINES[0]}, {FLOAT32}, judge_raw with validity"
    calls[judging] = Call(
        _of_each(samples, lambda x: best.judge_raw(x).score), num, judged=sizes.judged
    )
    if sizes.has_onnx:
        say("latency: export")
        calls[ORT] = Call(_in_onnxruntime(timed, samples), num, judged=sizes.judged)
    return calls


def peers(timed: Timed, sizes: Sizes) -> dict[str, Call]:
    """Other tools from samples to a score, and other heads behind our features."""
    samples = raw_bins(sizes.bins).numpy()
    selected, every = list(timed.selected), range(len(pool_of(FLOAT64).names))
    calls = {
        LOOP: Call(_looped(timed, samples, every), len(every), judged=sizes.looped),
        PRUNED_LOOP: Call(_looped(timed, samples, selected), len(selected), judged=sizes.looped),
        "MiniRocket and ridge": Call(_rocket(sizes, samples), sizes.num_kernels),
    }
    engine = ENGINES[0]
    front = timed.detector(engine, FLOAT64)
    wide = raw_bins(sizes.bins).double()
    for name, score in _heads(timed).items():

        def run(number: int, score: Callable[[Tensor], Any] = score) -> Any:
            bins = front.channel_filter.valid(wide[number % len(wide)][None])
            return score(front.scaler(front.extractor(bins)))

        is_same = 0 if name == SVC else sizes.judged  # a vector machine is another
        calls[f"{engine}, {FLOAT64}, {name}"] = Call(run, len(selected), judged=is_same)
    return calls


def parts(timed: Timed, sizes: Sizes) -> dict[str, Call]:
    """What a way is made of, each alone."""
    samples = raw_bins(sizes.bins)
    channel_filter = ChannelFilter(WINDOW_LENGTHS)
    bins = channel_filter.valid(samples.double())
    calls = {FILTER: Call(_of_each(samples, channel_filter.valid), 0, is_whole=False)}
    for engine in (*ENGINES, REFERENCE):
        for dtype in (FLOAT32, FLOAT64):
            made = selected_extractor(engine, dtype, timed.selected)
            run = _of_each(bins.to(DTYPES[dtype].dtype), made)
            name = f"features, {engine}, {dtype}"
            calls[name] = Call(run, len(timed.selected), is_whole=False)
    detector = timed.detector(ENGINES[-1], FLOAT32)
    features = selected_extractor(ENGINES[-1], FLOAT64, timed.selected)(bins)
    run = _of_each(features, detector.score_features)
    calls[QUADRATIC] = Call(run, len(timed.selected), is_whole=False)
    z = timed.scaler(features)
    for name, score in _heads(timed).items():
        calls[name] = Call(_of_each(z, score), len(timed.selected), is_whole=False)
    return calls


# --------------------------------------------------------------------------------------- making
def _of_each(values: Tensor, function: Callable[[Tensor], Any]) -> Callable[[int], Any]:
    each = [value[None].contiguous() for value in values]
    return lambda number: function(each[number % len(each)])


def _heads(timed: Timed) -> dict[str, Callable[[Tensor], Any]]:
    z, targets = timed.z.numpy(), timed.targets.numpy()
    svc = heads.svc(z, targets, timed.kernel.offset)
    ridge = heads.kernel_ridge(z, targets, timed.kernel.offset, timed.penalty)
    return {
        SVC: lambda z: svc.decision_function(z.numpy()),
        RIDGE: lambda z: ridge.predict(z.numpy()),
        SUM: timed.kernel_sum(),
    }


def _looped(timed: Timed, samples: Any, wanted: Any) -> Callable[[int], float]:
    score = looped(timed, timed.kernel_sum(), wanted)
    return lambda number: score(samples[number % len(samples)])


def looped(timed: Timed, machine: KernelSum, wanted: Sequence[int]) -> Callable[[Any], float]:
    """The loop, from one raw bin ``[C, n + 2 * context]`` to its score.

    Args:
        timed: filter, features and scaler.
        machine: the kernel sum.
        wanted: pool indices of the features that are made, among them those in use.
    """
    pool, channel_filter = pool_of(FLOAT64), ChannelFilter(WINDOW_LENGTHS)
    chosen = [pool.names[index] for index in wanted]
    names = [(n.channel, n.component, n.domain, n.descriptor) for n in chosen]
    place = {index: at for at, index in enumerate(wanted)}
    used = [place[index] for index in timed.selected]
    channels = list(dict.fromkeys(name.channel for name in chosen))  # the others are not filtered
    rows = [pool.hand.names.index(channel) for channel in channels]
    lengths = [WINDOW_LENGTHS[row] for row in rows]
    support, beta = (np.asarray(of) for of in (machine.support, machine.beta))
    low, high = (np.asarray(of) for of in (timed.scaler.minimum, timed.scaler.maximum))
    knee = None if timed.scaler.knee is None else np.asarray(timed.scaler.knee)

    def score(samples: Any) -> float:
        raw = samples[rows].astype(np.float64)
        filtered = loop.savgol(raw, lengths, 1, channel_filter.context)
        with others.quiet():
            x = loop.features(filtered, names, channels)[used]
        if knee is not None:
            x = np.sign(x) * knee * np.log1p(np.abs(x) / knee)
        z = np.clip(2 * (x - low) / (high - low) - 1, -1, 1)
        return loop.kernel_score(z, support, beta, timed.kernel.offset, timed.kernel.degree)

    return score


def _rocket(sizes: Sizes, samples: Any) -> Callable[[int], Any]:
    bins, is_slip = labelled_bins(sizes.recordings)
    targets = np.where(is_slip.numpy(), 1.0, -1.0)
    say("latency: MiniRocket")
    scores = others.mini_rocket_ridge(bins.numpy(), targets, 1, sizes.num_kernels)
    context = ChannelFilter(WINDOW_LENGTHS).context

    def score(number: int) -> Any:
        raw = samples[number % len(samples)].astype(np.float64)
        filtered = loop.savgol_in_groups(raw, WINDOW_LENGTHS, 1, context)
        return scores(filtered[None].astype(np.float32))

    return score


def _in_onnxruntime(timed: Timed, samples: Tensor) -> Callable[[int], Any]:
    judge = session(timed, threads=1)
    each = [judge.cut(value[None]) for value in samples]
    return lambda number: judge.run(each[number % len(each)])

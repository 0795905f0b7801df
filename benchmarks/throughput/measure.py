"""The measurements of ``benchmarks.throughput``: seconds and bytes, no judgement."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import pywt
import torch
from torch import Tensor

from benchmarks.bins import RANDOM, WINDOW_LENGTHS, bins_of, raw_bins
from benchmarks.clocks import Way, on_threads, say, shuffled_rounds, shuffled_turns
from benchmarks.detectors import Timed
from benchmarks.engines import DTYPES, ENGINES, FLOAT32, FLOAT64
from benchmarks.exported import ORT, session
from benchmarks.machine import threads_text
from benchmarks.throughput.sizes import Sizes
from benchmarks.throughput.worker import IN_ONE_PIECE, peak
from tactslip_torch.features.extractor import EngineName, FeatureExtractor
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.hand import HandLayout
from tactslip_torch.signals.filtering import ChannelFilter

FEATURES, FILTERED, RAW = "features", "filtered bin to score", "raw bin to score"
REFERENCE: EngineName = "reference"
_ONNX_CHUNK = 256  # what it is fastest with
Calls = dict[str, Callable[[], object]]


def bulk(timed: Timed, sizes: Sizes) -> dict[str, Any]:
    """The planned detector on many bins at once, stage by stage, on every number of threads."""
    rows = []
    for threads in sizes.threads:
        calls, counts = _bulk_calls(timed, sizes, threads)
        with torch.inference_mode(), on_threads(threads):
            what = f"bulk on {threads_text(threads)}"
            turns = shuffled_turns(calls, sizes.rounds, sizes.seed, what)
        for name, of in turns.items():
            way, stage = name.split(": ")
            row = {"way": way, "stage": stage, "threads": threads, "bins": counts[name]}
            rows.append(row | {"seconds": of.seconds, "core_s": of.core_s})
    return {"rows": rows}


def _bulk_calls(timed: Timed, sizes: Sizes, threads: int) -> tuple[Calls, dict[str, int]]:
    calls: Calls = {}
    counts: dict[str, int] = {}
    samples = raw_bins(64)[torch.arange(sizes.bulk_bins) % 64]
    filtered = ChannelFilter(WINDOW_LENGTHS).valid(samples.double())
    for engine in (*ENGINES, REFERENCE):
        num = sizes.reference_bins if engine == REFERENCE else sizes.bulk_bins
        for dtype in (FLOAT32, FLOAT64):
            detector = timed.detector(engine, dtype)
            raw, bins = (of[:num].to(DTYPES[dtype].dtype) for of in (samples, filtered))
            stages: Calls = {
                FEATURES: partial(detector.extractor, bins),
                FILTERED: partial(detector, bins),
                RAW: partial(detector.score_raw, raw),
            }
            for stage, call in stages.items():
                name = f"{engine}, {dtype}: {stage}"
                calls[name], counts[name] = call, num
    if sizes.has_onnx:
        name = f"{ORT}: {RAW}"
        few = samples[: sizes.onnx_bins]
        calls[name], counts[name] = _exported(timed, few, threads), len(few)
    return calls, counts


def _exported(timed: Timed, samples: Tensor, threads: int) -> Callable[[], object]:
    judge = session(timed, threads)
    chunks = [judge.cut(chunk) for chunk in samples.split(_ONNX_CHUNK)]
    return lambda: [judge.run(chunk) for chunk in chunks]


def batch(timed: Timed, sizes: Sizes) -> dict[str, Any]:
    """The planned detector from filtered bins to scores, over the number of bins at once."""
    rows = []
    generator = torch.Generator().manual_seed(sizes.seed)
    whole = torch.randn(max(sizes.batches), 24, 100, generator=generator)
    for num in sizes.batches:
        bins = whole[:num]
        for threads in sizes.threads:
            calls: Calls = {
                engine: partial(timed.detector(engine, FLOAT32), bins) for engine in ENGINES
            }
            with torch.inference_mode(), on_threads(threads):
                say(f"batch of {num} on {threads_text(threads)}")
                seconds = _timed_as_fits(calls, num, sizes)
            rows += [
                {"way": f"{engine}, {FLOAT32}", "threads": threads, "bins": num, "seconds": taken}
                for engine, taken in seconds.items()
            ]
    return {"rows": rows}


def _timed_as_fits(calls: Calls, num: int, sizes: Sizes) -> Mapping[str, list[float]]:
    if num < sizes.many:
        return shuffled_rounds({k: Way(v) for k, v in calls.items()}, sizes.rounds, sizes.seed)
    turns = shuffled_turns(calls, sizes.few_rounds, sizes.seed, f"batch of {num}")
    return {name: of.seconds for name, of in turns.items()}


def length(timed: Timed, sizes: Sizes) -> dict[str, Any]:
    """The whole pool over the length of a bin."""
    rows = []
    for bin_ms in sizes.bins_ms:
        num_samples = 2 * bin_ms  # at 2 kHz
        level = min(4, pywt.dwt_max_level(num_samples, "rbio2.2"))
        hand = HandLayout.paper24()
        pool = FeaturePool(hand, bin_samples=num_samples, level=level, arithmetic="native")
        rows += _curve(pool, sizes, f"bins of {bin_ms} ms", {"bin_ms": bin_ms, "level": level})
    return {"rows": rows}


def channels(timed: Timed, sizes: Sizes) -> dict[str, Any]:
    """The whole pool over the number of channels."""
    rows = []
    for num in sizes.channels:
        pool = FeaturePool(hand_of(num), arithmetic="native")
        films = len(pool.hand.fast)
        rows += _curve(pool, sizes, f"{num} channels", {"channels": num, "films": films})
    return {"rows": rows}


def hand_of(num: int) -> HandLayout:
    """A hand of so many channels, ten films to 14 gauges as far as that goes, one film at least."""
    films = max(1, round(num * 10 / 24))
    kinds = ["SG"] * (num - films) + ["PVDF"] * films
    rows = [
        {"name": f"{kind}{index}", "kind": kind, "finger": "index", "segment": "distal"}
        for index, kind in enumerate(kinds)
    ]
    return HandLayout.from_rows(rows)


def _curve(
    pool: FeaturePool, sizes: Sizes, what: str, facts: Mapping[str, Any]
) -> list[dict[str, Any]]:
    size = len(pool.hand) * pool.bin_samples
    num = min(4096, max(4, sizes.curve_samples // size))
    bins = bins_of(RANDOM, num, len(pool.hand), pool.bin_samples).float()
    calls: Calls = {
        engine: partial(FeatureExtractor(pool, engine=engine), bins) for engine in ENGINES
    }
    about = {"bins": num, "features": len(pool.names), **facts}
    rows = []
    for threads in sizes.threads:
        with torch.inference_mode(), on_threads(threads):
            turns = shuffled_turns(calls, sizes.few_rounds, sizes.seed, what)
        rows += [
            {"way": f"{engine}, {FLOAT32}", "threads": threads, **about, "seconds": of.seconds}
            for engine, of in turns.items()
        ]
    return rows


def memory(timed: Timed, sizes: Sizes) -> dict[str, Any]:
    """Peak of memory over the number of bins held, each in a fresh process."""
    threads = max(sizes.threads)
    jobs: list[tuple[str, int]] = [(engine, num) for engine in ENGINES for num in sizes.held]
    jobs.append((IN_ONE_PIECE, sizes.pieced))
    rows = []
    for engine, num in jobs:
        say(f"memory of {num} bins, {engine}")
        names = None if engine == IN_ONE_PIECE else timed.selection["names"]
        answer = peak(do="hold", engine=engine, batch=num, names=names, threads=threads)
        rows.append({"way": engine, "bins": num, "threads": threads, **answer})
    return {"rows": rows}


def stream(timed: Timed, sizes: Sizes) -> dict[str, Any]:
    """Many bins as chunks to a consumer, in a fresh process."""
    rows = []
    threads = max(sizes.threads)
    for is_pool, num in ((False, sizes.streamed), (True, sizes.streamed_pool)):
        say(f"stream of {num} bins, {ENGINES[0]}")
        answer = peak(
            do="stream",
            engine=ENGINES[0],
            num_bins=num,
            chunk=sizes.chunk,
            names=None if is_pool else timed.selection["names"],
            threads=threads,
        )
        about = {"way": f"{ENGINES[0]}, {FLOAT32}", "is_pool": is_pool, "chunk": sizes.chunk}
        rows.append(about | {"threads": threads} | answer)
    return {"rows": rows}


SECTIONS: dict[str, Callable[[Timed, Sizes], dict[str, Any]]] = {
    "bulk": bulk,
    "batch": batch,
    "length": length,
    "channels": channels,
    "memory": memory,
    "stream": stream,
}


def held_bytes(row: Mapping[str, Any]) -> int:
    """What a row of ``memory`` took besides the bins, their features and the imports."""
    return int(row["peak_bytes"] - row["before_bytes"] - row["own_bytes"])

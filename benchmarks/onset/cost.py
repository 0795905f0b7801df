"""What decisions cost a stream: pushes of one hop, each of which makes one decision."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import cycle
from statistics import median
from typing import Any

from torch import Tensor

from benchmarks.clocks import Way, on_threads, say, shuffled_rounds
from tactslip_torch.data.recording import RecordingSource
from tactslip_torch.data.splits import PAPER_SCENE
from tactslip_torch.onset.streaming import StreamingDetector


def push_seconds(
    streams: Mapping[str, StreamingDetector], source: RecordingSource, rounds: int, seed: int
) -> dict[str, float]:
    """Median seconds of a push of one hop to each, in turns, on one thread.

    Args:
        streams: by name.
        source: of the recording that is pushed, over and over: one of the paper's protocol.
        rounds: of every stream.
        seed: of the order.
    """
    recording = next(recording for recording in source.ids if recording.scene == PAPER_SCENE)
    samples = source.load(recording).samples.T.contiguous()
    say(f"cost: {rounds} rounds of {len(streams)} streams")
    with on_threads(1):
        ways = {name: Way(next_hop(live, samples)) for name, live in streams.items()}
        taken = shuffled_rounds(ways, rounds, seed)
    return {name: median(seconds) for name, seconds in taken.items()}


def next_hop(live: StreamingDetector, samples: Tensor) -> Callable[[], Any]:
    """A call that pushes the next hop, once every push makes a decision.

    Args:
        live: a stream that nothing was pushed to.
        samples: taken in turns, ``[T, C]``.
    """
    hop = live.settings.hop_samples
    pieces = cycle(samples[: len(samples) // hop * hop].split(hop))
    while not len(live.push(next(pieces)).number):
        pass
    return lambda: live.push(next(pieces))

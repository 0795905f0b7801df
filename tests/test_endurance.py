"""A long stream against whole recordings; slow.

``TACTSLIP_STREAM_HOPS`` says how many decisions the stream has (8,640,000 are a day).
"""

import gc
import os
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from small_detector import HAND
from test_dead_streams import alarming_with_gaussians

from tactslip_torch import StreamingDetector
from tactslip_torch.onset.decisions import (
    AlarmSettings,
    Decider,
    Decisions,
    is_usable,
    score_stream,
)

NUM_HOPS = int(os.environ.get("TACTSLIP_STREAM_HOPS", "12000"))
RATE_HZ = 2000.0
PART = 100_000
"""Samples between two gaps that are too long to be filled."""
CUTS = {0: 0.02, 1: 0.05, 20: 0.8, 50: 0.1, 10_000: 0.03}
"""Largest size of a piece, and how often; of 20 samples, a hop, all are, the others are drawn."""


def part_of(rng):
    """Samples ``[4, T]`` with what befalls sensors: bursts of NaN, rails, death and recovery."""
    knots = np.arange(0, PART + 1000, 1000)
    loud = np.interp(np.arange(PART), knots, 10 ** rng.uniform(-3, 0, len(knots)))
    samples = loud * rng.standard_normal((len(HAND), PART))
    samples[:2] += np.array([[1.0], [-0.5]])
    for value in rng.choice([np.nan, 5.0, 0.0], rng.integers(0, 8)):
        channels = rng.random(len(HAND)) < rng.choice([0.3, 1.0])
        start, length = rng.integers(0, PART), rng.integers(1, 4000)
        samples[channels, start : start + length] = value
    return torch.from_numpy(samples)


def pushed(live, samples, start_s, rng, seconds):
    """What a stream says of samples in pieces; of some pieces only the gap arrives."""
    found, place = [], 0
    while place < PART:
        most = int(rng.choice(list(CUTS), p=list(CUTS.values())))
        num = most if most in (0, 20) else int(rng.integers(1, most + 1))
        if place > 0 and num <= 100 and place + num < PART and rng.random() < 0.01:
            samples[:, place : place + num] = torch.nan  # at most the gap that is filled
        else:
            piece = samples[:, place : place + num].T
            before = time.thread_time()
            found.append(live.push(piece, start_s + place / RATE_HZ if len(piece) else None))
            if num == 20 and len(piece) == 20:
                seconds.append(time.thread_time() - before)
        place += num
    return found


def whole(detector, settings, samples, start_s):
    """What is said of a recording that lies there whole."""
    scores = score_stream(detector, samples, settings.hop_samples)
    tells = is_usable(scores.score, scores.is_missing, detector.needed_index)
    decider = Decider(settings, RATE_HZ, detector.pool.bin_samples, detector.look_ahead)
    made = decider.decide(scores.score, scores.is_valid, tells, scores.variance)
    later = {name: getattr(made, name) + start_s for name in ("available_s", "onset_s")}
    return made._replace(**later)


@pytest.mark.slow
def test_a_long_stream_is_decided_as_whole_recordings_in_memory_and_time_that_stay(capsys):
    detector = alarming_with_gaussians()
    settings, rng = AlarmSettings.of(detector), np.random.default_rng(0)
    live = StreamingDetector(detector, dtype=torch.float64)
    num, alarms, start_s, seconds, resident = 0, 0, 0.0, [], []
    gc.freeze()  # as a live loop does: what the tests hold is not looked through in the midst of it
    while num < NUM_HOPS:
        found, expected = [], []
        for _ in range(2):  # the second push of times begins anew after the gap
            samples = part_of(rng)
            found += pushed(live, samples, start_s, rng, seconds)
            expected.append(whole(detector, settings, samples, start_s))
            start_s += PART / RATE_HZ + 1.0
        found.append(live.flush())
        for name in Decisions._fields:
            ours, theirs = (torch.cat([getattr(x, name) for x in y]) for y in (found, expected))
            if ours.is_floating_point():
                torch.testing.assert_close(
                    ours, theirs, rtol=1e-9, atol=1e-7, msg=lambda m, n=name: n + m
                )
            else:
                assert torch.equal(ours, theirs), name
        num += sum(len(each.score) for each in found)
        alarms += sum(len(each.alarms) for each in found)
        size = int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
        resident.append(size)
    gc.unfreeze()
    median, high = np.quantile(seconds, [0.5, 0.9999])
    grown = resident[-1] - resident[len(resident) // 4]
    with capsys.disabled():
        print(
            f"\n{num} decisions, {alarms} alarms, {live.num_gaps} gaps, {len(seconds)} pushes of a "
            f"hop: median {1e6 * median:.0f} us of CPU, 99.99 % {high / median:.1f} medians, "
            f"memory {grown / 2**20:+.1f} MiB"
        )
    assert alarms
    assert grown < 16 * 2**20
    if os.getloadavg()[0] < (os.cpu_count() or 1):  # times beside other work tell nothing
        assert high < 10 * median

"""Latency against a robot that is played sample by sample, the cost model by hand, the clock."""

import json

import pytest
from small_detector import HAND, small_detector

from tactslip_torch.analysis import latency as module
from tactslip_torch.analysis.latency import (
    GROUPS,
    CostModel,
    Latency,
    Limits,
    Timing,
    detector_parts,
    measure_costs,
    parts_of,
    time_calls,
    time_in_fresh_process,
)
from tactslip_torch.features.bank import make_plan
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.signals.filtering import ChannelFilter

RATE_HZ = 2000


def decided_after_ms(onset, num_samples, hop, look_ahead, compute_us):
    """Samples come one by one; the first bin that begins at or behind the onset decides."""
    for newest in range(10**6):
        start = newest - look_ahead - num_samples + 1
        if start >= onset and start % hop == 0:
            return (newest + 1 - onset) * 1000 / RATE_HZ + compute_us / 1000
    raise AssertionError("never decided")


@pytest.mark.parametrize("look_ahead", [0, 5, 25])
@pytest.mark.parametrize("hop", [10, 37, 100])
def test_no_onset_waits_longer_and_one_waits_so_long(look_ahead, hop):
    played = [decided_after_ms(400 + i, 100, hop, look_ahead, 700.0) for i in range(hop)]
    stated = Latency(look_ahead / 2, 50.0, hop / 2, 700.0)
    # an onset just behind the first sample of a bin is the worst: it misses that bin by nothing
    assert max(played) == pytest.approx(stated.worst_ms - 1000 / RATE_HZ)
    assert stated.to_dict()["worst_ms"] == stated.worst_ms


def test_what_is_missed_is_named():
    latency = Latency(2.5, 50.0, 5.0, 400.0)
    assert Limits(57.9, 400, [5.0]).misses(latency) == []
    assert Limits(57.8, 399, [5.0]).misses(latency) == [
        "latency 57.90 ms above deadline_ms=57.8",
        "compute 400 us above compute_us=399",
    ]
    assert Limits(100, 9999, [5.0]).misses(Latency(0.0, 50.0, 5.0, 5000.0)) == [
        "compute 5000 us not below the hop 5 ms"
    ]
    assert Latency(0.0, 50.0, 5.0, 1000.0).load == pytest.approx(0.2)


def test_the_hop_leaves_head_room_where_one_does():
    limits = Limits(80.0, 500.0, [5.0, 10.0, 25.0])
    parts = Latency(4.6, 50.0, 5.0, 1.0)
    assert limits.latency(parts, 380.0).hop_ms == 25  # 79.98 ms
    roomy = limits.latency(parts, 380.0, headroom=1.25)
    assert (roomy.hop_ms, roomy.compute_us) == (10, 380)  # 25 ms with 475 us are 80.075 ms
    assert limits.latency(parts, 390.0, headroom=1.5).hop_ms == 25  # 585 us are none: without
    assert Limits(60.0, 5000.0, [5.0]).headroom(Latency(2.0, 50.0, 5.0, 400.0)) == pytest.approx(
        7.5
    )
    assert Limits(900.0, 500.0, [5.0]).headroom(Latency(2.0, 50.0, 5.0, 400.0)) == 1.25
    for us, hop_ms in ((12_000.0, 25), (60_000.0, 25), (5_000.0, 10)):
        assert Latency(0.0, 50.0, 5.0, us).with_shortest_hop(limits.hops_ms).hop_ms == hop_ms


@pytest.mark.parametrize("name", ["deadline_ms", "compute_us", "hop_ms"])
def test_limits_and_parts_are_finite_positive_numbers(name):
    given = {"deadline_ms": 80, "compute_us": 500, "hops_ms": [5.0], name: 0}
    with pytest.raises(ValueError, match=rf"{name} must be a positive finite number, got 0"):
        Latency(0.0, 50.0, 0, 1.0) if name == "hop_ms" else Limits(**given)


# Costs -------------------------------------------------------------------------------------------
POOL = FeaturePool(HAND)
PRIMES = dict(zip(GROUPS, (2.0, 3, 5, 7, 11, 13, 17, 19, 23, 29, 31, 37), strict=True))
MODEL = CostModel(0.5, {name: 1000 * price for name, price in PRIMES.items()}, PRIMES, tail=2.0)


def parts(*names):
    return parts_of(make_plan(HAND, 4, names))


def priced(**groups):
    """The bill by hand: each group once, and so many of its parts."""
    return 2 * (0.5 + sum((1000 + num) * PRIMES[name] for name, num in groups.items()))


@pytest.mark.parametrize(
    ("names", "bill"),
    [
        (["SG1 raw time mean"], {"gauges": 1, "moments": 1, "columns": 1}),
        (["SG1 raw time mode"], {"gauges": 1, "sorts": 1, "columns": 1}),
        (
            ["PVDF1 A2 time std", "PVDF1 A2 time median", "PVDF1 A2 time iqr"],
            {"films": 1, "branches": 1, "moments": 1, "sorts": 1, "columns": 3},
        ),
        (
            ["PVDF1 A2 time correlation", "PVDF2 A2 time entropy"],
            {
                "films": 2,
                "branches": 2,
                "correlations": 1,
                "sorts": 1,
                "histograms": 1,
                "columns": 2,
            },
        ),
        (
            ["PVDF1 D4 freq spectral_centroid", "PVDF1 D4 freq spectral_spread"],
            {"films": 1, "spectra": 1, "lines": 1, "columns": 2},
        ),
        (
            ["PVDF1 A1 freq band_energy_ratio", "PVDF1 D3 freq band_energy_ratio"],
            {"films": 1, "energies": 1, "columns": 2},
        ),
    ],
)
def test_shared_work_is_on_the_bill_once(names, bill):
    needed, everything = parts(*names), range(len(names))
    assert MODEL.compute_us(detector_parts(needed, everything)) == pytest.approx(priced(**bill))
    pooled = priced(**bill | {"columns": 5, "pooled": len(names)})  # five numbers of all of them
    assert MODEL.compute_us(detector_parts(needed, everything, 5)) == pytest.approx(pooled)


def test_prices_are_found_again_in_timings_that_follow_them(monkeypatch):
    needed = parts_of(make_plan(POOL.hand, POOL.level, POOL.names))

    def played(detector, calls):
        layer = detector.pooling
        num_pooled = None if layer is None else len(layer.names)
        us = MODEL.compute_us(detector_parts(needed, detector.selected, num_pooled))
        return Timing(us / 2, us, us, calls)

    monkeypatch.setattr(module, "time_detector", played)
    costs = measure_costs(POOL, ChannelFilter([51, 51, 11, 11]), [4, 8], "auto", ["mean", "std"])
    assert costs.tail == pytest.approx(2.0)
    assert costs.error < 0.02
    assert min(costs.base_us, *costs.group_us.values(), *costs.part_us.values()) >= 0
    some = detector_parts(needed, range(0, len(needed), 50))
    assert costs.compute_us(some) == pytest.approx(MODEL.compute_us(some), rel=0.05)
    assert (
        json.loads(json.dumps(costs.to_dict(), allow_nan=False))["groups"].keys() == GROUPS.keys()
    )


# The clock ---------------------------------------------------------------------------------------
class Played:
    """A clock and calls that are played: microseconds as given, interrupted if negative."""

    def __init__(self, monkeypatch, *runs):
        self.now, self.switches = 0, 0
        self.left = iter([1, *(us for run in runs for us in run)])  # the first is not timed
        monkeypatch.setattr(module.time, "perf_counter_ns", lambda: self.now)
        monkeypatch.setattr(module, "_interruptions", lambda: self.switches)

    def __call__(self, given):
        us = next(self.left)
        self.now += 1000 * abs(us)
        self.switches += us < 0


def test_calls_are_timed_one_by_one_and_interrupted_ones_told_but_not_counted(monkeypatch):
    run = list(range(1, 101))
    played = Played(monkeypatch, run[::-1], [10 * us for us in run], run)
    # one run that a neighbour slows down does not decide
    assert time_calls(played, [None], 100, runs=3) == Timing(51.0, 99.0, 99.0, 100, 0.0)
    played = Played(monkeypatch, [*run[:50], *[-5000] * 25, *run[50:]])
    assert time_calls(played, [None], 100, runs=1) == Timing(51.0, 99.0, 5000.0, 100, 0.2)
    played = Played(monkeypatch, [7, *[-5000] * 100])
    assert time_calls(played, [None], 100, runs=1).p50_us == 5000  # hardly one was left alone


@pytest.mark.slow
def test_a_saved_detector_is_timed_in_a_process_of_its_own(tmp_path):
    path = tmp_path / "detector.pt"
    small_detector().save(path)
    timing = time_in_fresh_process(path, 20, "auto")
    assert timing.calls == 20
    assert 0 < timing.p50_us <= timing.p99_us <= timing.p99_all_us
    with pytest.raises(FileNotFoundError, match=r"gone.pt"):
        time_in_fresh_process(tmp_path / "gone.pt", 20)

"""The arithmetic of latency against a robot that is played sample by sample."""

import pytest

from tactslip_torch.analysis.latency import (
    Latency,
    Limits,
    check_hops,
    look_ahead_samples,
)
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
    sample_ms = 1000 / RATE_HZ
    assert max(played) <= stated.worst_ms + 1e-9
    # an onset just behind the first sample of a bin is the worst: it misses that bin by nothing
    assert max(played) == pytest.approx(stated.worst_ms - sample_ms)
    assert stated.to_dict()["worst_ms"] == pytest.approx(
        sum(stated.to_dict()[part] for part in ("look_ahead_ms", "bin_ms", "hop_ms")) + 0.7
    )


def test_look_ahead_is_of_the_channels_in_use():
    centred = ChannelFilter([51, 51, 11, 11])
    assert look_ahead_samples(centred, [0, 2]) == 25
    assert look_ahead_samples(centred, [3, 2]) == 5
    for align in ("causal", "trailing"):
        assert look_ahead_samples(ChannelFilter([51, 51, 11, 11], align=align), range(4)) == 0
    with pytest.raises(ValueError, match="no channel is in use"):
        look_ahead_samples(centred, [])


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


@pytest.mark.parametrize(
    ("deadline_ms", "compute_us", "hop_ms"),
    [(200, 500, 50), (72.8, 500, 10), (72.7, 500, 5), (60, 500, 5), (200, 200, 5)],
)
def test_the_longest_hop_that_keeps_the_limits_else_the_shortest(deadline_ms, compute_us, hop_ms):
    limits = Limits(deadline_ms, compute_us, [50.0, 5.0, 10.0, 25.0])
    assert limits.latency(Latency(12.5, 50.0, 5.0, 300.0), 300.0).hop_ms == hop_ms


@pytest.mark.parametrize(("us", "hop_ms"), [(12_000.0, 25), (60_000.0, 50), (5_000.0, 10)])
def test_the_shortest_hop_that_compute_fits_into(us, hop_ms):
    latency = Latency(0.0, 50.0, 5.0, us).with_shortest_hop([50.0, 5.0, 10.0, 25.0])
    assert latency.hop_ms == hop_ms


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ((-1.0, 50.0, 5.0, 1.0), "look_ahead_ms must be a finite number of at least 0, got -1"),
        ((0.0, 0.0, 5.0, 1.0), "bin_ms must be a positive finite number, got 0"),
        ((0.0, 50.0, 0.0, 1.0), "hop_ms must be a positive finite number, got 0"),
        (
            (0.0, 50.0, 5.0, float("nan")),
            "compute_us must be a finite number of at least 0",
        ),
    ],
)
def test_parts_that_are_none_are_refused(parts, message):
    with pytest.raises(ValueError, match=message):
        Latency(*parts)


def test_the_hop_leaves_head_room_where_one_does():
    limits = Limits(80.0, 500.0, [5.0, 10.0, 25.0])
    parts = Latency(4.6, 50.0, 5.0, 1.0)
    assert limits.latency(parts, 380.0).hop_ms == 25  # 79.98 ms
    roomy = limits.latency(parts, 380.0, headroom=1.25)
    assert (roomy.hop_ms, roomy.compute_us) == (10, 380)  # 25 ms with 475 us are 80.075 ms
    assert limits.latency(parts, 390.0, headroom=1.5).hop_ms == 25  # 585 us are none: without
    assert limits.misses(limits.latency(parts, 501.0)) == ["compute 501 us above compute_us=500"]


def test_head_room_is_how_often_compute_fits():
    limits = Limits(60.0, 5000.0, [5.0])
    assert limits.headroom(Latency(2.0, 50.0, 5.0, 400.0)) == pytest.approx(3.0 / 0.4)
    assert limits.headroom(Latency(0.0, 50.0, 2.0, 400.0)) == pytest.approx(2.0 / 0.4)
    assert Limits(900.0, 500.0, [5.0]).headroom(Latency(2.0, 50.0, 5.0, 400.0)) == 1.25


@pytest.mark.parametrize("value", [None, "abc", True, 0, -1.0, float("inf"), float("nan")])
def test_limits_are_finite_positive_numbers(value):
    for name in ("deadline_ms", "compute_us"):
        given = {"deadline_ms": 80, "compute_us": 500, "hops_ms": [5.0]} | {name: value}
        with pytest.raises(ValueError, match=rf"{name} must be a positive finite number, got"):
            Limits(**given)


def test_hops_are_whole_samples():
    check_hops([0.5, 5, 12.5, 25.0], RATE_HZ)
    check_hops([0.1 + 0.2], 10_000)
    with pytest.raises(ValueError, match=r"5.3 ms are 10.6 samples at 2000 Hz, .* of 0.5 ms"):
        check_hops([5, 5.3], RATE_HZ)

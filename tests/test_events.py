"""Alarms against onsets, held against a loop over milliseconds, and the numbers of many."""

import json
import math
from collections import Counter
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from tactslip_torch.onset.events import (
    EventRecord,
    EventRules,
    LatencyParts,
    pooled_metrics,
    recording_events,
)

LATENCY = LatencyParts(look_ahead_s=0.0125, bin_s=0.05)
RULES = EventRules(settle_s=0.1)


def watched(alarms=(), onsets=(1.0,), slides=None, speeds=None, **more):
    slides = slides or tuple((onset, onset + 2.0) for onset in onsets)
    facts = {"recording": "a", "material": "M1", "scene": "paper", "duration_s": 10.0}
    facts |= {"alarms_s": tuple(alarms), "onset_estimates_s": (), "onsets_s": tuple(onsets)}
    facts |= {"sliding_s": slides, "speeds_mm_s": speeds or (20.0,) * len(onsets)}
    return EventRecord(**(facts | more))


def events_of(one, rules=RULES):
    return recording_events(one, rules, LATENCY)


def metrics_of(*events):
    metrics = pooled_metrics(events, num_resamples=50)
    json.dumps(metrics, allow_nan=False)
    return metrics


# By loops ----------------------------------------------------------------------------------------


def random_recording(rng, number=0):
    """Everything in whole milliseconds: slides apart, alarms anywhere, stretches or the whole."""
    duration = 4000
    edges = np.sort(rng.choice(np.arange(100, duration - 100), 6, replace=False)).tolist()
    slides = [(edges[2 * i], edges[2 * i + 1]) for i in range(rng.integers(0, 4))]
    alarms = set(rng.choice(duration, rng.integers(0, 14), replace=False).tolist())
    if slides and rng.random() < 0.5:
        alarms.add(max(slides[0][0] + int(rng.integers(-250, 600)), 0))
    alarms, ends, stretches = sorted(alarms), None, None
    if rng.random() < 0.6:
        later = [*alarms, 10**6][1:]
        latest = [min(b, a + 900) for a, b in zip(alarms, later, strict=True)]
        ends = [int(rng.integers(a + 1, b + 1)) for a, b in zip(alarms, latest, strict=True)]
    if rng.random() < 0.5:
        cuts = np.sort(rng.choice(duration, 4, replace=False)).tolist()
        stretches = [(cuts[0], cuts[1]), (cuts[2], cuts[3])]
    firsts = [start for start, _ in slides]
    if told := rng.random() < 0.5:  # when the first element lets go, behind the slide before
        earlier = [start - int(rng.integers(0, 50)) for start in firsts]
        firsts = [max(first, end) for first, end in zip(earlier, [0, *edges[1::2]], strict=False)]
    speeds = rng.choice([20.0, 40.0, 60.0], len(slides)).tolist()
    return SimpleNamespace(
        number=number,
        duration=duration,
        alarms=alarms,
        ends=ends,
        slides=slides,
        firsts=firsts,
        told=told,
        speeds=speeds,
        stretches=stretches,
    )


def as_watched(made):
    def s(times):
        return tuple(time / 1000 for time in times)

    released = zip(made.firsts, made.slides, strict=True) if made.told else ()
    return EventRecord(
        recording=f"{made.number}",
        material=f"M{made.number % 3}",
        scene="paper",
        duration_s=made.duration / 1000,
        alarms_s=s(made.alarms),
        onset_estimates_s=s(alarm - 7 * (place % 3) for place, alarm in enumerate(made.alarms)),
        onsets_s=s(start for start, _ in made.slides),
        sliding_s=tuple(s(slide) for slide in made.slides),
        speeds_mm_s=tuple(made.speeds),
        watched_s=tuple(s(stretch) for stretch in made.stretches or ()),
        alarm_ends_s=s(made.ends or ()),
        released_s=tuple(s((first, start + 30)) for first, (start, _) in released),
    )


def by_loops(made):
    """The definitions, word by word, in whole milliseconds."""
    found, early, settle = 500, 200, 100

    def is_seen(t):
        return made.stretches is None or any(a <= t <= b for a, b in made.stretches)

    firsts = made.firsts
    windows = [
        (first - early, stop + settle) for first, (_, stop) in zip(firsts, made.slides, strict=True)
    ]
    alarms = [
        (alarm, None if made.ends is None else made.ends[place])
        for place, alarm in enumerate(made.alarms)
        if is_seen(alarm)
    ]
    of, false = Counter(), []
    for alarm, _ in alarms:
        holding = [i for i, (a, b) in enumerate(windows) if a <= alarm <= b]
        if holding:
            of[max(holding)] += 1
        else:
            false.append(alarm)
    told = []
    for i, (onset, _) in enumerate(made.slides):
        if not is_seen(onset):
            continue
        before = [(alarm, end) for alarm, end in alarms if alarm < firsts[i]]
        is_early = False
        if before:
            alarm, end = before[-1]
            is_early = firsts[i] - alarm <= early and (end is None or end > firsts[i])
        hits = [
            alarm
            for alarm, _ in alarms
            if firsts[i] <= alarm <= onset + found
            and alarm <= windows[i][1]
            and not any(firsts[i] < other <= alarm for other in firsts)
        ]
        outcome = "early" if is_early else "found" if hits else "missed"
        told.append((outcome, of[i], hits[0] - onset if outcome == "found" else None))
    quiet = 0
    for t in range(made.duration):  # the millisecond from t to t + 1
        inside = made.stretches is None or any(a <= t < b for a, b in made.stretches)
        quiet += inside and not any(a <= t < b for a, b in windows)
    return told, false, quiet


@pytest.fixture(scope="module")
def many():
    """Recordings, what the loops say of each, and its events."""
    rng = np.random.default_rng(0)
    made = [random_recording(rng, number) for number in range(80)]
    return [(one, by_loops(one), events_of(as_watched(one))) for one in made]


def test_every_onset_and_alarm_counts_as_the_loops_say(many):
    for made, (told, false, quiet), events in many:
        got = [(o.outcome, o.num_alarms) for o in events.onsets]
        assert got == [(outcome, num) for outcome, num, _ in told], made
        for onset, (_, _, delay) in zip(events.onsets, told, strict=True):
            assert onset.delay_s == delay / 1000 if delay is not None else math.isnan(onset.delay_s)
        assert [round(1000 * alarm) for alarm in events.false_alarms_s] == false, made
        assert events.quiet_s == pytest.approx(quiet / 1000, abs=1e-9), made


def test_numbers_of_many_are_sums_of_what_the_loops_count(many):
    metrics = metrics_of(*(events for _, _, events in many))
    onsets = [onset for _, (told, _, _), _ in many for onset in told]
    counts = Counter(outcome for outcome, _, _ in onsets)
    for outcome in ("found", "early", "missed"):
        assert metrics[f"num_{outcome}"] == counts[outcome] > 2
        assert metrics[outcome]["value"] == pytest.approx(counts[outcome] / len(onsets))
    assert metrics["num_onsets"] == len(onsets) == sum(counts.values())
    false = sum(len(false) for _, (_, false, _), _ in many)
    minutes = sum(quiet for _, (_, _, quiet), _ in many) / 6e4
    assert metrics["num_false_alarms"] == false
    assert metrics["quiet_hours"] == pytest.approx(minutes / 60)
    assert metrics["false_alarms_per_minute"]["value"] == pytest.approx(false / minutes)
    per_hour = {end: 60 * v for end, v in metrics["false_alarms_per_minute"].items()}
    assert metrics["false_alarms_per_hour"] == pytest.approx(per_hour)
    alarms = sum(num for _, num, _ in onsets)
    assert metrics["alarms_per_slip"]["value"] == pytest.approx(alarms / len(onsets))
    delays = np.array([delay for _, _, delay in onsets if delay is not None])
    assert metrics["delay_ms"]["median"]["value"] == pytest.approx(np.median(delays))
    assert metrics["delay_ms"]["p95"]["value"] == pytest.approx(np.quantile(delays, 0.95))
    steps = np.quantile(delays, np.arange(21) / 20)
    np.testing.assert_allclose(metrics["delay_ms"]["quantiles"], steps, rtol=1e-12)


def test_rounding_moves_no_alarm_over_an_edge():
    for alarm, onset, outcome in ((0.9, 1.1, "early"), (0.68, 0.18, "found")):
        (found,) = events_of(watched([alarm], [onset])).onsets
        assert found.outcome == outcome


def test_the_settling_time_is_of_bin_and_look_ahead_unless_it_is_given():
    last = 3.0 + 0.05 + 0.0125 + 0.05
    false = events_of(watched([last, last + 1e-6]), EventRules()).false_alarms_s
    assert false == (last + 1e-6,)
    assert events_of(watched([3.3]), EventRules(settle_s=0.4)).false_alarms_s == ()


# The numbers -------------------------------------------------------------------------------------


def test_nothing_to_say_is_none_and_never_a_quotient_of_zeros():
    metrics = metrics_of(events_of(watched([1.1], watched_s=((0.9, 2.0),))))  # at no quiet time
    assert metrics["false_alarms_per_minute"] is metrics["false_alarms_per_hour"] is None
    assert metrics["found"]["value"] == 1.0
    metrics = metrics_of(events_of(watched([1.1, 2.2], ())))  # without an onset
    names = ("found", "early", "missed", "alarms_per_slip", "delay_ms", "latency_ms")
    names += ("delay_first_ms", "slid_mm")
    assert [metrics[name] for name in names] == [None] * 8
    assert metrics["false_alarms_per_minute"]["value"] == pytest.approx(12.0)
    assert metrics["per_speed"] == {}
    missed = metrics_of(events_of(watched()))
    assert missed["missed"]["value"] == 1.0
    assert missed["delay_ms"] is missed["latency_ms"] is None
    nothing = metrics_of()
    assert nothing["num_recordings"] == 0
    assert nothing["found"] is nothing["false_alarms_per_hour"] is None


@pytest.mark.parametrize("positive", [(), (math.nan,), (1.4,)], ids=["unknown", "none", "later"])
def test_without_a_decision_before_the_alarm_all_of_the_delay_is_bin_fill(positive):
    one = watched([1.3], first_positive_s=positive)
    (onset,) = events_of(one).onsets
    assert (onset.delay_s, onset.decision_s) == (0.3, 0.0)
    assert onset.bin_fill_s == pytest.approx(0.3 - 0.0125)


@pytest.mark.parametrize(
    ("alarm", "positive", "delay", "first", "slid", "fill", "decision"),
    [
        (1.05, 1.03, 0.05, 0.11, 2.0, 0.0175, 0.02),  # behind the onset: 40 mm/s for 50 ms
        (0.97, 0.96, -0.03, 0.03, 0.0, -0.0525, 0.01),  # between the first release and the onset
        (0.97, 1.03, -0.03, 0.03, 0.0, -0.0425, 0.0),
    ],
)
def test_delays_from_the_onset_and_the_first_release(
    alarm, positive, delay, first, slid, fill, decision
):
    one = watched([alarm], speeds=(40.0,), first_positive_s=(positive,), released_s=((0.94, 1.02),))
    events = recording_events(one, RULES, replace(LATENCY, compute_s=0.002))
    (onset,) = events.onsets
    assert (onset.outcome, onset.first_release_s) == ("found", 0.94)
    found = [onset.delay_s, onset.delay_first_s, onset.slid_mm, onset.bin_fill_s, onset.decision_s]
    assert found == pytest.approx([delay, first, slid, fill, decision], abs=1e-12)
    assert LATENCY.look_ahead_s + fill + decision == pytest.approx(delay)
    metrics = metrics_of(events)
    for name, value in (("delay_ms", 1000 * delay), ("delay_first_ms", 1000 * first)):
        assert metrics[name]["median"]["value"] == pytest.approx(value)
    assert metrics["slid_mm"]["p95"]["value"] == pytest.approx(slid, abs=1e-12)
    parts = metrics["latency_ms"]
    whole = parts["look_ahead"] + parts["bin_fill"] + parts["decision"]
    assert parts["delay"] == pytest.approx(whole)
    assert parts["compute"] == pytest.approx(2.0)


def test_the_same_recording_of_two_detectors_is_drawn_as_one():
    """Else pooling a recording with itself would make its intervals narrower."""
    many = [watched([1.0 + 0.01 * n], recording=str(n)) for n in range(1, 12)]
    events = [events_of(one) for one in many]
    once, twice = metrics_of(*events), metrics_of(*events, *events)
    assert twice["num_recordings"] == once["num_recordings"] == 11
    assert twice["num_onsets"] == 2 * once["num_onsets"]
    median = twice["delay_ms"]["median"]
    assert median == pytest.approx(once["delay_ms"]["median"])
    assert twice["alarms_per_slip"] == pytest.approx(once["alarms_per_slip"])


# Errors ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"alarms_s": (1.2, 1.1)}, "alarms_s must ascend"),
        ({"alarms_s": (1.2, math.nan)}, "alarms_s must ascend"),
        ({"watched_s": ((2.0, 1.0),)}, "watched_s must ascend"),
        ({"released_s": ((0.9, 1.0), (0.8, 1.0))}, "first releases must ascend"),
    ],
)
def test_what_does_not_fit_together_is_refused(changes, words):
    with pytest.raises(ValueError, match=words):
        replace(watched([1.1, 1.2]), **changes)


def test_an_alarm_in_slip_that_nobody_saw_begin_is_not_false_and_the_time_not_quiet():
    """As behind a gap inside a slide: the slide ends there, and what comes behind is slip still."""
    alarms = (1.1, 3.4, 6.0)
    slides, behind = ((1.0, 2.9),), ((3.2, 4.0),)
    whole = events_of(watched(alarms, slides=slides))
    assert whole.false_alarms_s == (3.4, 6.0)
    events = events_of(watched(alarms, slides=slides, slip_s=behind))
    assert events.false_alarms_s == (6.0,)
    settled_s = 0.8 + RULES.settle_s
    assert events.quiet_s == pytest.approx(whole.quiet_s - settled_s)
    (onset,) = events.onsets
    assert onset.outcome == "found"

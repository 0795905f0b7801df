"""The alarm of fast evidence and of bins together: by a plain loop, and in any pieces."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from streams import detector_of, signal
from test_rules import by_hand
from test_streaming import MIDDLE, joined, settings_of
from test_streaming import assert_same as same_bins

from tactslip_torch.model.kernels import QuadraticForm
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.onset.decisions import Decider, is_usable, score_stream
from tactslip_torch.onset.evidence import OnsetClassifier, OnsetEvidence
from tactslip_torch.onset.rules import Cusum, KOfN
from tactslip_torch.onset.streaming import StreamingDetector

RATE = 2000.0
DETECTOR = detector_of()
HAND = DETECTOR.pool.hand
RULES = [KOfN(2, 3), Cusum(0.5, 0.5, 2.0)]


def classifier_of(hop=10, seed=0):
    """A machine that nobody trained; a tenth of the hops speak for an onset."""
    evidence = OnsetEvidence(HAND, RATE, hop)
    columns, _ = evidence.columns(evidence.blocks_of_recording(signal(6000, 9)))
    scaler, rng = FeatureScaler.fit(columns), np.random.default_rng(seed)
    line = torch.from_numpy(rng.standard_normal(evidence.num_columns))
    head = QuadraticForm(torch.zeros(0, 0).double(), line, torch.tensor(0.0).double())
    threshold = float(head(scaler(columns)).quantile(0.9))
    return OnsetClassifier(evidence, scaler, head, threshold, 0.012)


def joint_settings(rule=RULES[0], bin_hop=50, hop=10):
    return replace(settings_of(rule, bin_hop), onset=classifier_of(hop))


def assert_same(found, expected):
    same_bins(found, expected)
    assert torch.equal(found.by_onset, expected.by_onset)
    torch.testing.assert_close(found.onset_score, expected.onset_score, rtol=0, atol=1e-8)


# Decider.join ------------------------------------------------------------------------------------


def parts_of(settings, scores, onset_scores, cuts, look_ahead=25, frame=0, num_samples=4000):
    """What a stream makes of scores that come as soon as their samples have."""
    decider, parts, bins, hops = Decider(settings, RATE, 100, look_ahead, frame), [], 0, 0
    for num in [*sorted(cuts), num_samples]:
        due = (num - 100 - look_ahead) // settings.hop_samples + 1 if num >= frame else 0
        score = scores[..., bins : max(due, bins)]
        of_bins = decider.decide(score, score.isfinite())
        last = num // settings.decision_samples
        parts.append(decider.join(of_bins, onset_scores[..., hops:last]))
        bins, hops = max(due, bins), last
    return parts


def drawn_scores(shape, seed, settings):
    """Both reach their thresholds now and then."""
    rng = np.random.default_rng(seed)
    scores = MIDDLE - 8 + 10 * rng.standard_normal((*shape, 500)).repeat(8, -1)
    onset = settings.onset.threshold - 2 + rng.standard_normal((*shape, 4000))
    return torch.from_numpy(scores), torch.from_numpy(onset)


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.name)
@pytest.mark.parametrize(
    ("bin_hop", "hop", "frame"), [(50, 10, 0), (7, 10, 0), (10, 10, 0), (130, 3, 400)]
)
def test_joined_decisions_by_a_plain_loop(rule, bin_hop, hop, frame):
    settings = joint_settings(rule, bin_hop, hop)
    scores, onset = drawn_scores((), 3, settings)
    scores = scores[: (4000 - 125) // bin_hop + 1]
    (found,) = parts_of(settings, scores, onset, (), frame=frame)
    bins = Decider(settings, RATE, 100, 25).decide(scores, scores.isfinite())
    high, by_onset = [], []
    for i in range(4000 // hop):
        end = (i + 1) * hop
        known = [n for n in range(len(scores)) if n * bin_hop + 125 <= end and end >= frame]
        by_onset.append(float(onset[i]) >= settings.onset.threshold)
        high.append(by_onset[i] or bool(known and bins.statistic[known[-1]] >= settings.threshold))
        assert float(found.available_s[i]) == end / RATE
        if not known:
            expected = 0.0, 0.5, False
        else:
            expected = tuple(
                float(x[known[-1]]) for x in (bins.score, bins.probability, bins.is_valid)
            )
        assert (found.score[i], found.probability[i], found.is_valid[i]) == expected
        began_s = end / RATE - (0.012 if by_onset[i] else 0.0)
        if known and not by_onset[i]:
            began_s = min(float(bins.onset_s[known[-1]]), end / RATE)
        assert float(found.onset_s[i]) == began_s
    seconds = {"rearm": 0.02, "refractory": 0.05}
    times = {name: math.ceil(s * RATE / hop) for name, s in seconds.items()}
    alarms, standing = by_hand(high, 1, **times)
    assert found.number.tolist() == list(range(4000 // hop))
    assert found.by_onset.tolist() == by_onset
    assert (found.is_alarm.tolist(), found.is_on.tolist()) == (alarms, standing)
    raised = [("onset" if by_onset[i] else "status") for i in np.flatnonzero(alarms)]
    assert [alarm.raised_by for alarm in found.alarms] == raised
    assert set(raised) == {"onset", "status"}


@given(
    cuts=st.lists(st.integers(0, 4000), max_size=30),
    rule=st.sampled_from(RULES),
    hops=st.sampled_from([(50, 10), (7, 10), (130, 3)]),
    streams=st.sampled_from([(), (3,)]),
)
def test_any_cut_and_several_streams_are_as_each_whole(cuts, rule, hops, streams):
    settings = joint_settings(rule, *hops)
    scores, onset = drawn_scores(streams, 4, settings)
    whole = scores[..., : (4000 - 125) // hops[0] + 1], onset[..., : 4000 // hops[1]]
    parts = parts_of(settings, *whole, cuts)
    found = [torch.cat(x, -1) for x in zip(*parts, strict=True)]
    for row in range(3 if streams else 1):
        alone = [x[row] if streams else x for x in whole]
        (expected,) = parts_of(settings, *alone, ())
        for ours, theirs in zip(found, expected, strict=True):
            own = ours[row] if ours.ndim > 1 else ours
            torch.testing.assert_close(own, theirs, rtol=1e-12, atol=0)


# Streams -----------------------------------------------------------------------------------------


def offline(settings, samples):
    scores = score_stream(DETECTOR, samples, settings.hop_samples)
    decider = Decider(settings, RATE, 100, DETECTOR.look_ahead)
    tells = is_usable(scores.score, scores.is_missing, DETECTOR.needed_index)
    bins = decider.decide(scores.score, scores.is_valid, tells)
    return decider.join(bins, settings.onset.score_recording(samples))


def stream_of(settings, dtype=torch.float64, **options):
    return StreamingDetector(DETECTOR, settings, dtype=dtype, **options)


def in_pieces(stream, samples, cuts=()):
    places = [0, *sorted(min(cut, samples.shape[-1]) for cut in cuts), samples.shape[-1]]
    parts = [stream.push(samples[:, a:b].T) for a, b in pairwise(places)]
    return joined([*parts, stream.flush()])


@given(
    num_samples=st.sampled_from([0, 9, 10, 124, 2500, 4003]),
    cuts=st.lists(st.integers(0, 4003), max_size=20),
    rule=st.sampled_from(RULES),
    hops=st.sampled_from([(50, 10), (7, 10), (50, 3)]),
    dtype=st.sampled_from([torch.float64, torch.float32]),
    bad=st.lists(st.integers(0, 4002), max_size=2),
)
def test_any_cut_of_a_stream_gives_what_the_whole_recording_gives(
    num_samples, cuts, rule, hops, dtype, bad
):
    settings, samples = joint_settings(rule, *hops), signal(4003, 5, dtype)
    for place in bad:
        samples[place % 4, place] = torch.nan
    samples = samples[:, :num_samples]
    found = in_pieces(stream_of(settings, dtype), samples, cuts)
    assert found.score.dtype == dtype
    assert_same(found, offline(settings, samples))
    assert len(found.number) == num_samples // hops[1]


def test_both_raise_alarms_in_a_stream():
    found = in_pieces(stream_of(joint_settings()), signal(20_000, 5), range(0, 20_000, 333))
    assert {alarm.raised_by for alarm in found.alarms} == {"onset", "status"}


def test_gaps_are_filled_or_begin_another_stream():
    settings, samples = joint_settings(), signal(9000, 6)
    stream, times = stream_of(settings), 7.0 + np.arange(9000) / RATE
    times[3000:] += 40 / RATE  # is filled
    times[6000:] += 101 / RATE  # is not
    cuts = [0, 1500, 3000, 4500, 6000, 7500, 9000]
    parts = [stream.push(samples[:, a:b].T, float(times[a])) for a, b in pairwise(cuts)]
    found = joined([*parts, stream.flush()])
    hole = torch.full((4, 40), torch.nan, dtype=torch.float64)
    first = torch.cat([samples[:, :3000], hole, samples[:, 3000:6000]], -1)
    pieces = [offline(settings, first), offline(settings, samples[:, 6000:])]
    starts_s = torch.tensor([7.0, float(times[6000])], dtype=torch.float64)
    starts_s = starts_s.repeat_interleave(torch.tensor([len(p.number) for p in pieces]))
    expected = joined(pieces)
    for name in ("available_s", "onset_s"):
        moved = getattr(expected, name) + starts_s
        torch.testing.assert_close(getattr(found, name), moved, rtol=0, atol=1e-9)
    times_s = {"available_s": expected.available_s, "onset_s": expected.onset_s}
    assert_same(found._replace(**times_s), expected)
    assert stream.num_gaps == 1


@pytest.mark.parametrize("end", ["flush", "reset"])
def test_a_stream_that_ended_is_forgotten(end):
    settings, samples = joint_settings(), signal(3500, 6)
    stream = stream_of(settings)
    stream.push(signal(3333, 8).T)
    left = getattr(stream, end)()
    assert left is None or len(left.number) == 0  # every decision came with its last sample
    assert_same(in_pieces(stream, samples, (1000,)), offline(settings, samples))


def test_a_masked_channel_is_not_heard():
    """As with samples that are missing from the first on."""
    settings, samples = joint_settings(), signal(4000, 6)
    found = in_pieces(stream_of(settings, masked_channels=["PVDF2"]), samples, (700, 2500))
    samples[HAND.names.index("PVDF2")] = torch.nan
    assert_same(found, offline(settings, samples))


def test_memory_does_not_grow():
    stream, held = stream_of(joint_settings()), []
    for seed in range(120):
        stream.push(signal(100, seed).T)
        held.append(stream.state_bytes)
    assert max(held[:30]) == max(held[30:])

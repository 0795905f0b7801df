"""The alarm of fast evidence and of bins together: by a plain loop, and in any pieces."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from streams import detector_of, signal
from test_rules import by_hand
from test_streaming import MIDDLE, settings_of

from tactslip_torch.model.kernels import QuadraticForm
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.onset.decisions import Decider
from tactslip_torch.onset.evidence import OnsetClassifier, OnsetEvidence
from tactslip_torch.onset.rules import Cusum, KOfN

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

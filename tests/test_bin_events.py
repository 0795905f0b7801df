"""From decisions on labelled bins to events: alarms by hand, stretches, splits by bin."""

import itertools
from collections import deque
from dataclasses import replace

import pytest
import torch

from tactslip_torch.data.labels import LabelRule, bins_of
from tactslip_torch.data.recording import RecordingId, Timeline
from tactslip_torch.onset.events import LatencyParts
from tactslip_torch.training import evaluation
from tactslip_torch.training.datamodule import RecordingFeatures

RATE_HZ = 2000.0
LATENCY = LatencyParts(look_ahead_s=0.0125, bin_s=0.05)


def batch_of(onsets=(2.0, 6.0), ends=(4.0, 8.0), stretches=(), roles=None, slip_s=(), **rule):
    """What the learner sees of a recording without disturbances, features left out."""
    rule = LabelRule(**rule)
    slides, speeds = tuple(zip(onsets, ends, strict=True)), (20.0, 40.0)[: len(onsets)]
    times = Timeline(onsets_s=onsets, speeds_mm_s=speeds, sliding_s=slides)
    labelled = replace(times, non_slip_s=stretches, slip_s=slip_s, duration_s=12.0)
    bins = bins_of(rule, labelled, RATE_HZ)
    num, speed = len(bins.starts), torch.tensor([*speeds, 0.0])[bins.stroke]
    ends_s = (bins.starts + bins.bin_samples).double() / RATE_HZ
    columns = torch.zeros(num, 1), bins.is_slip, speed, bins.position, bins.stroke, ends_s
    sensed = torch.ones(num, 1), torch.ones(num, 1)
    hop_s, roles = (rule.hop_ms or rule.bin_ms) / 1000, roles or {"test": torch.ones(num) > 0}
    return RecordingFeatures(RecordingId("M1", 0), *columns, *sensed, times, hop_s, roles)


def events_of(batch, says_slip, is_valid=None):
    is_valid = torch.ones_like(says_slip) if is_valid is None else is_valid
    part = evaluation.evaluated_bins(batch, says_slip, is_valid, {})["test"]
    return {name: own[0] for name, own in evaluation.events_by_rule([part], LATENCY).items()}


def seen(events):
    return [(onset.outcome, onset.num_alarms) for onset in events.onsets]


# -------------------------------------------------------------------------------- what rules see


def plain_alarms(decisions, is_valid, name):
    """Whether each decision raises an alarm: the paper's rule, and two of three, by hand."""
    last, was_on, raised = deque(maxlen=3), False, []
    for decision, counts in zip(decisions, is_valid, strict=True):
        if not counts:
            raised.append(False)
            continue
        last.append(bool(decision))
        is_on = last[-1] if name == "first_transition" else sum(last) >= 2
        raised.append(is_on and not was_on)
        was_on = is_on
    return raised


@pytest.mark.parametrize("hop_ms", [None, 10.0, 25.0])
@pytest.mark.parametrize("layout", ["whole_slide", "half_second"])
def test_random_decisions_raise_the_alarms_that_rules_by_hand_do(layout, hop_ms):
    generator = torch.Generator().manual_seed(3)
    batch = batch_of(stretches=((9.0, 10.0), (10.5, 11.5)), layout=layout, hop_ms=hop_ms)
    is_apart = batch.stroke == -1
    groups = [batch.stroke == 0, batch.stroke == 1]
    groups += [is_apart & (batch.ends_s < 10.1), is_apart & (batch.ends_s > 10.4)]
    for share, name, lost in itertools.product((0.2, 0.5, 0.8), evaluation.RULES, (0.0, 0.2)):
        random = torch.rand(2, len(batch.is_slip), generator=generator)
        is_valid = random[1] >= lost
        decisions = (random[0] < share) & is_valid
        events, alarms = events_of(batch, decisions, is_valid)[name], []
        for rows in groups:
            raised = torch.tensor(plain_alarms(decisions[rows], is_valid[rows], name))
            alarms += (batch.ends_s[rows][raised] + 0.0125).tolist()
        own = [onset.num_alarms for onset in events.onsets]
        windows = ((2.0 - 0.2, 4.0 + 0.1125), (6.0 - 0.2, 8.0 + 0.1125))
        false = [a for a in alarms if not any(start <= a <= end for start, end in windows)]
        assert events.false_alarms_s == pytest.approx(false)
        assert sum(own) == len(alarms) - len(false) > 0


def test_stretches_of_slip_and_of_none_are_watched_in_the_order_of_time():
    batch = batch_of((9.0,), (10.0,), ((1.0, 3.0), (5.0, 7.0)), slip_s=((0.5, 1.0), (3.0, 5.0)))
    in_stretches = batch.ends_s[batch.stroke < 0]
    assert (in_stretches.diff() < 0).any()  # labels have them by class
    for events in events_of(batch, batch.is_slip).values():
        assert seen(events) == [("found", 1)]
        # each slip of which no onset is known is one alarm, and the second one ends at 5 s
        assert len(events.false_alarms_s) == 2
        # 0.5 to 7 s are unbroken, before the onset 1.01 s; the last 0.2 s of it are early
        assert events.quiet_s == pytest.approx(6.5 + 1.01 - LATENCY.look_ahead_s - 0.2)


# ---------------------------------------------------------------------------------- whole roles
def test_a_split_by_bin_has_no_events_and_says_why():
    whole = batch_of()
    num = len(whole.is_slip)
    some = torch.arange(num) % 5 > 0
    apart = batch_of(roles={"train": some, "test": ~some, "unseen": torch.zeros_like(some)})
    parts = evaluation.evaluated_bins(apart, apart.is_slip, torch.ones_like(apart.is_slip), {})
    assert {role: part.is_whole for role, part in parts.items()} == {"train": False, "test": False}
    assert sum(len(part.says_slip) for part in parts.values()) == num
    events = {role: evaluation.events_by_rule([part], LATENCY) for role, part in parts.items()}
    for by_rule in evaluation.event_numbers(events).values():
        assert list(by_rule) == list(evaluation.RULES)
        for numbers in by_rule.values():
            assert numbers["reason"] == evaluation.BINS_APART
            assert numbers["found"] is numbers["false_alarms_per_minute"] is None
    of_whole = evaluation.evaluated_bins(whole, whole.is_slip, torch.ones_like(whole.is_slip), {})[
        "test"
    ]
    assert evaluation.events_by_rule([of_whole, parts["test"]], LATENCY) == {
        name: [] for name in evaluation.RULES
    }
    numbers = evaluation.event_numbers({"test": evaluation.events_by_rule([of_whole], LATENCY)})
    assert "reason" not in numbers["test"]["first_transition"]

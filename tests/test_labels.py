"""Which bins of a recording are slip, which are not, and which windows of time they need."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tactslip_torch.data.labels import (
    NO_POSITION,
    LabelRule,
    bins_of,
)
from tactslip_torch.data.recording import Timeline

RATE = 2000.0
ONSETS = (2.0, 9.0, 13.5)  # as in the paper, with slides of 100 mm at 20, 40, 60 mm/s
SLIDES = ((2.0, 7.0), (9.0, 11.5), (13.5, 13.5 + 100 / 60))
DURATION = 15.5
HALF = LabelRule(layout="half_second")


def lay(rule=None, onsets=ONSETS, slides=SLIDES, duration_s=DURATION, rate=RATE, **stretches):
    stretches = {name: tuple(each) for name, each in stretches.items()}
    times = Timeline(tuple(onsets), sliding_s=tuple(slides), duration_s=duration_s, **stretches)
    return bins_of(rule or LabelRule(), times, rate)


# Layouts -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("rule", "lead", "counts"), [(LabelRule(), 20, [100, 50, 33]), (HALF, 10, [10, 10, 10])]
)
def test_bins_of_the_papers_protocol(rule, lead, counts):
    """The counts of the published confusion matrices, and the half seconds of the text."""
    bins = lay(rule)
    assert bins.bin_samples == 100
    assert torch.bincount(bins.stroke[bins.is_slip]).tolist() == counts
    assert torch.bincount(bins.stroke[~bins.is_slip]).tolist() == [lead] * 3
    shorter = tuple((start, end - 1) for start, end in SLIDES)
    counts = [80, 30, 13] if rule.layout == "whole_slide" else counts
    bins = lay(rule, slides=shorter)
    assert torch.bincount(bins.stroke[bins.is_slip]).tolist() == counts


def by_hand(rule, onsets, slides, duration_s, rate, non_slip_s=(), slip_s=()):
    """Start, label, stroke and position of every bin, laid one by one."""
    size = round(rule.bin_ms * rate / 1000)
    hop = size if rule.hop_ms is None else round(rule.hop_ms * rate / 1000)
    is_half = rule.layout == "half_second"
    lead, shift_s, previous = round((0.5 if is_half else 1.0) * rate), 0.01 * (not is_half), 0
    found, taken = [], np.zeros(round(duration_s * rate), dtype=bool)
    for stroke, (onset, (start, end)) in enumerate(zip(onsets, slides, strict=True)):
        edge = round((onset - shift_s) * rate)
        last = min(int(end * rate), edge + lead if is_half else len(taken))
        ends = [math.ceil(e * rate - 1e-6) for _, e in slip_s]
        free = max([previous, *(e for e in ends if e <= edge)])
        quiet = [s for s in range(edge - lead, edge, hop) if free <= s <= edge - size]
        found += [(s, False, stroke, n - len(quiet)) for n, s in enumerate(quiet)]
        slip = [s for s in range(edge, last, hop) if s + size <= last]
        found += [(s, True, stroke, n) for n, s in enumerate(slip)]
        previous = math.ceil(end * rate)
        taken[min(edge, int(start * rate)) : previous] = True
    for start, *_ in found:
        taken[start : start + size] = True
    for is_slip, (start, end) in [(False, s) for s in non_slip_s] + [(True, s) for s in slip_s]:
        last = round(end * rate)
        for s in range(round(start * rate), last, hop):
            if s + size <= last and not taken[s : s + size].any():
                found.append((s, is_slip, -1, NO_POSITION))
        for s, *_ in found:
            taken[s : s + size] = True
    return found


stretch = st.tuples(st.integers(0, 15_000), st.integers(1, 4500)).map(
    lambda pair: (pair[0] / RATE, min(sum(pair), 16_000) / RATE)
)
stroke = st.tuples(st.floats(0.3, 1.5), st.floats(0.0, 2.0))  # a pause, and a slide behind it


@given(
    layout=st.sampled_from(["whole_slide", "half_second"]),
    hop_ms=st.sampled_from([None, 10.0, 25.0, 70.0, 150.0]),
    strokes=st.lists(stroke, max_size=2),
    late_s=st.floats(-0.045, 0.045),
    non_slip_s=st.lists(stretch, max_size=3),
    slip_s=st.lists(stretch, max_size=2),
)
def test_bins_are_those_laid_by_hand(layout, hop_ms, strokes, late_s, non_slip_s, slip_s):
    rule, slides, now = LabelRule(layout=layout, hop_ms=hop_ms), [], 0.8
    for pause_s, length_s in strokes:
        slides.append((now + pause_s, now + pause_s + length_s))
        now = slides[-1][1]
    marked = [start + late_s for start, _ in slides]
    told, spans = (rule, marked, slides, 8.0, RATE), {"non_slip_s": non_slip_s, "slip_s": slip_s}
    expected, bins = by_hand(*told, **spans), lay(*told, **spans)
    columns = bins.starts, bins.is_slip, bins.stroke, bins.position
    assert [*zip(*(column.tolist() for column in columns), strict=True)] == expected
    dtypes = torch.int64, torch.bool, torch.int64, torch.int64
    assert (*(column.dtype for column in columns), bins.bin_samples) == (*dtypes, 100)
    ends = (bins.starts + 100) / RATE
    for number, (start, (_, end)) in enumerate(zip(marked, slides, strict=True)):
        own = bins.stroke == number  # no bin straddles the onset or the end of its slide
        assert (ends[own & ~bins.is_slip] <= start + 5e-4).all()
        assert (bins.starts[own & bins.is_slip] / RATE >= start - 0.011).all()
        assert (ends[own & bins.is_slip] <= end + 1e-6).all()


# Labels of windows ---------------------------------------------------------------------------


def windows_by_hand(rule, onsets, slides, duration_s, rate, non_slip_s=(), slip_s=()):
    """Start and label of every window of which each sample has a label, one by one."""
    size, hop = (round(ms * rate / 1000) for ms in (rule.bin_ms, rule.hop_ms or rule.bin_ms))
    label = [None] * round(duration_s * rate)
    for is_slip, spans in ((False, non_slip_s), (True, slip_s)):
        for start, end in spans:
            for place in range(round(start * rate), round(end * rate)):
                label[place] = is_slip
    is_half, previous = rule.layout == "half_second", 0
    for onset, (start, end) in zip(onsets, slides, strict=True):
        lead, shift = (0.5, 0.0) if is_half else (1.0, 0.01)
        edge, end = round((onset - shift) * rate), math.ceil(end * rate)
        last = end  # of these slides a whole sample
        for place in range(min(edge, int(start * rate)), end):
            label[place] = None
        free = max([previous, *(round(e * rate) for _, e in slip_s if round(e * rate) <= edge)])
        for place in range(max(edge - round(lead * rate), free), edge):
            label[place] = False
        for place in range(edge, min(last, edge + round(lead * rate)) if is_half else last):
            label[place] = True
        previous = end
    found = []
    for first in range(0, len(label) - size + 1, hop):
        window = label[first : first + size]
        if None not in window:
            is_slip = window[-1] if rule.assign == "last" else sum(window) > size / 2
            found.append((first, is_slip))
    return found


@pytest.mark.parametrize("assign", ["majority", "last"])
@pytest.mark.parametrize("layout", ["whole_slide", "half_second"])
@pytest.mark.parametrize("hop_ms", [None, 10.0, 70.0])
def test_windows_have_the_label_of_most_samples_or_of_the_last(assign, layout, hop_ms):
    rule = LabelRule(layout=layout, hop_ms=hop_ms, assign=assign)
    onsets, slides = (1.013, 3.5), ((1.013, 2.0), (3.5, 4.2))
    told = {"non_slip_s": ((0.0, 0.5), (4.2, 5.0), (5.6, 5.8)), "slip_s": ((5.0, 5.6),)}
    bins = lay(rule, onsets, slides, 6.0, 200.0, **told)
    expected = windows_by_hand(rule, onsets, slides, 6.0, 200.0, **told)
    found = zip(bins.starts.tolist(), bins.is_slip.tolist(), strict=True)
    assert sorted(found) == expected
    of_strokes = bins.stroke >= 0
    assert (of_strokes.int().diff() <= 0).all()  # those of strokes first
    assert (bins.position[~of_strokes] == NO_POSITION).all()
    for number in range(2):
        own = bins.stroke == number
        position = bins.position[own]
        assert (bins.starts[own].diff() > 0).all()
        assert (position.diff() == 1).all()
        assert torch.equal(position >= 0, bins.is_slip[own])


def test_bins_that_need_missing_samples_are_left_out():
    def laid(*missing_s, reach=(0, 0)):
        times = Timeline(non_slip_s=((0.0, 3.0),), duration_s=3.0, missing_s=missing_s)
        bins = bins_of(LabelRule(), times, RATE, *reach)
        assert len(bins.starts) == len(bins.is_slip) == len(bins.stroke) == len(bins.position)
        return set(bins.starts.tolist())

    gap = (1.0, 1.0 + 1 / RATE)
    assert laid() - laid(gap) == {2000}
    assert laid() - laid(gap, reach=(25, 11)) == {1900, 2000}
    assert 1900 in laid((1.0 + 11 / RATE, 1.1), reach=(25, 11))


# Errors --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"layout": "nope"}, "labels.layout must be one of whole_slide, half_second, got 'nope'"),
        ({"assign": "first"}, "labels.assign must be one of whole, majority, last, got 'first'"),
        ({"bin_ms": 0.0}, "labels.bin_ms must be positive, got 0.0"),
        ({"bin_ms": 50.2}, r"labels.bin_ms=50.2 is 100.4 samples at 2000 Hz; choose a whole"),
        ({"hop_ms": 0.1}, r"labels.hop_ms=0.1 is 0.2 samples"),
        ({"layout": "half_second", "bin_ms": 600.0}, r"labels\.bin_ms=600 is longer than the 500"),
    ],
)
def test_a_bad_rule_is_refused(change, said):
    with pytest.raises(ValueError, match=said):
        lay(LabelRule(**change))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"onsets": (-0.1,), "slides": ((-0.1, 3.0),)}, r"stroke 1 with its onset at -0.100 s"),
        ({"duration_s": 15.1}, r"stroke 3 .* outside the recording of 15.100 s"),
        (
            {"rule": HALF, "onsets": (2.0,), "slides": ((2.0, 2.45),), "duration_s": 2.4},
            r"outside the recording of 2\.400 s",
        ),
        ({"onsets": ONSETS[:2]}, "zip"),
        ({"non_slip_s": ((15.0, 15.6),)}, r"the stretch from .* leaves the recording of"),
    ],
)
def test_what_leaves_the_recording_is_refused(options, said):
    with pytest.raises(ValueError, match=said):
        lay(**options)

"""Which bins of a recording are slip, which are not, and which windows of time they need."""

from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from small_set import SmallSet, SmallTimeline, small_maker

from tactslip_torch.data.labels import (
    NO_POSITION,
    LabelRule,
    clear_of,
    label_bins,
    needed_windows,
    shuffled,
)
from tactslip_torch.data.recording import RecordingId
from tactslip_torch.data.splits import Split
from tactslip_torch.signals.binning import bins_at
from tactslip_torch.signals.filtering import ChannelFilter

RATE = 2000.0
ONSETS = (2.0, 9.0, 13.5)  # REFERENCE.md section 1, with slides of 100 mm at 20, 40, 60 mm/s
SLIDES = ((2.0, 7.0), (9.0, 11.5), (13.5, 13.5 + 100 / 60))
DURATION = 15.5
HALF = LabelRule(layout="half_second")
both_layouts = pytest.mark.parametrize("layout", ["whole_slide", "half_second"])


def lay(rule=None, onsets=ONSETS, slides=SLIDES, duration_s=DURATION, rate=RATE, **stretches):
    return label_bins(rule or LabelRule(), onsets, slides, duration_s, rate, **stretches)


def of_stroke(bins, stroke, is_slip):
    return bins.starts[(bins.stroke == stroke) & (bins.is_slip == is_slip)].tolist()


# Layouts -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("rule", "lead", "shift", "counts"),
    [(LabelRule(), 20, 0.010, (100, 50, 33)), (HALF, 10, 0.0, (10, 10, 10))],
    ids=["whole_slide", "half_second"],
)
def test_bins_of_the_papers_protocol(rule, lead, shift, counts):
    """The counts of the published confusion matrices, and the half seconds of the text."""
    bins = lay(rule)
    assert bins.bin_samples == 100
    assert bins.position.dtype == torch.int64
    for stroke, (onset, num_slip) in enumerate(zip(ONSETS, counts, strict=True)):
        before, after = of_stroke(bins, stroke, False), of_stroke(bins, stroke, True)
        edge = onset - shift
        expected = (edge + 0.05 * np.arange(-lead, num_slip)) * RATE
        np.testing.assert_allclose(before + after, expected, atol=1e-6)
        position = bins.position[bins.stroke == stroke].tolist()
        assert position == list(range(-lead, num_slip))
        if rule.layout == "whole_slide":
            assert (after[-1] + 100) / RATE <= SLIDES[stroke][1] < (after[-1] + 200) / RATE
    shorter = tuple((start, end - 1) for start, end in SLIDES)
    num = 60 + 80 + 30 + 13 if rule.layout == "whole_slide" else 60
    assert len(lay(rule, slides=shorter).starts) == num


@both_layouts
@pytest.mark.parametrize("hop_ms", [25.0, 100.0, 150.0])
def test_hops_lay_bins_further_apart_or_over_each_other(layout, hop_ms):
    plain = lay(LabelRule(layout=layout))
    dense = lay(LabelRule(layout=layout, hop_ms=hop_ms))
    assert dense.bin_samples == 100
    for stroke in range(3):
        for is_slip in (False, True):
            every = of_stroke(dense, stroke, is_slip)
            assert set(np.diff(every)) <= {round(2 * hop_ms)}
            assert every[0] == of_stroke(plain, stroke, is_slip)[0]
        quiet, slip = ((dense.stroke == stroke) & (dense.is_slip == s) for s in (False, True))
        assert (int(dense.position[quiet].max()), int(dense.position[slip].min())) == (-1, 0)
        assert set(np.diff(dense.position[quiet | slip])) == {1}
    if hop_ms == 25.0:
        assert len(of_stroke(dense, 0, False)) == 2 * len(of_stroke(plain, 0, False)) - 1


@given(
    onset=st.floats(1.1, 3.0),
    length=st.floats(0.0, 4.0),
    hop_ms=st.sampled_from([None, 10.0, 50.0, 70.0]),
)
def test_no_bin_straddles_the_onset_or_the_end(onset, length, hop_ms):
    bins = lay(LabelRule(hop_ms=hop_ms), (onset,), ((onset, onset + length),), 8.0)
    ends = bins.starts + bins.bin_samples
    edge = round((onset - 0.010) * RATE)
    quiet, slip = ~bins.is_slip, bins.is_slip
    assert int(bins.starts[quiet].min()) == edge - 2000
    assert bool((ends[quiet] <= edge).all())
    assert bool((bins.starts[slip] >= edge).all())
    assert bool((ends[slip] <= (onset + length) * RATE + 1e-6).all())
    hop = 100 if hop_ms is None else round(2 * hop_ms)
    fits = int((onset + length) * RATE) - edge - 100
    assert int(slip.sum()) == (fits // hop + 1 if fits >= 0 else 0)  # not one bin less


def test_short_slides_pauses_and_recordings():
    short = lay(onsets=(2.0,), slides=((2.0, 2.03),))
    assert (len(short.starts), bool(short.is_slip.any())) == (20, False)
    half = lay(HALF, (2.0,), ((2.0, 2.23),), 5.0)
    ends = (half.starts[half.is_slip] + half.bin_samples) / RATE
    assert (len(ends), float(ends.max()) <= 2.23) == (4, True)
    for rule in (LabelRule(), HALF):  # a pause of 0.3 s leaves less than the layout asks for
        bins = lay(rule, (2.0, 3.3), ((2.0, 3.0), (3.3, 4.3)), 5.0)
        quiet = ~bins.is_slip & (bins.stroke == 1)
        assert float(bins.starts[quiet].min()) / RATE >= 3.0
        num = int(quiet.sum())
        assert bins.position[quiet].tolist() == list(range(-num, 0))
        assert num in (5, 6)
    whole = lay(HALF, (0.5,), ((0.5, 1.0),), 1.0)  # bins touch both ends
    assert (int(whole.starts[0]), int(whole.starts[-1]) + 100) == (0, 2000)


# Stretches -----------------------------------------------------------------------------------


def by_hand(strokes, slides, stretches, bin_samples, hop, num_samples):
    """Starts in stretches, sample by sample: nothing of a stroke, a slide or a bin is met."""
    taken = np.zeros(num_samples, dtype=bool)
    for start in strokes:
        taken[start : start + bin_samples] = True
    for start, end in slides:
        taken[start:end] = True
    found = []
    for first, last in stretches:
        own = [
            start
            for start in range(first, last, hop)
            if start + bin_samples <= last and not taken[start : start + bin_samples].any()
        ]
        for start in own:
            taken[start : start + bin_samples] = True
        found += own
    return found


@pytest.mark.parametrize(
    ("layout", "hop_ms"), [("whole_slide", None), ("half_second", 25.0), ("whole_slide", 70.0)]
)
@given(
    stretches=st.lists(
        st.tuples(st.integers(0, 30999), st.integers(1, 9000)).map(
            lambda pair: (pair[0], min(sum(pair), 31000))
        ),
        max_size=3,
    ),
    jitter=st.floats(-0.045, 0.045),
)
def test_bins_of_stretches_meet_no_other_bin_and_no_slide(layout, hop_ms, stretches, jitter):
    rule = LabelRule(layout=layout, hop_ms=hop_ms)
    annotated = tuple(onset + jitter for onset in ONSETS)
    seconds = tuple((start / RATE, end / RATE) for start, end in stretches)
    plain, bins = lay(rule, annotated), lay(rule, annotated, non_slip_s=seconds)
    num = len(plain.starts)
    for name in ("starts", "is_slip", "stroke", "position"):  # strokes are laid as ever
        assert torch.equal(getattr(bins, name)[:num], getattr(plain, name)), name
    shift = 0.01 if layout == "whole_slide" else 0.0
    slides = [
        (min(round((mark - shift) * RATE), int(start * RATE)), int(np.ceil(end * RATE)))
        for mark, (start, end) in zip(annotated, SLIDES, strict=True)
    ]
    hop = 100 if hop_ms is None else round(2 * hop_ms)
    expected = by_hand(plain.starts.tolist(), slides, stretches, 100, hop, 31000)
    assert bins.starts[num:].tolist() == expected
    assert not bool(bins.is_slip[num:].any())
    assert set(bins.stroke[num:].tolist()) <= {-1}
    assert set(bins.position[num:].tolist()) <= {NO_POSITION}


@both_layouts
def test_a_recording_without_onsets_has_the_bins_of_its_stretches(layout):
    rule = LabelRule(layout=layout)
    bins = lay(rule, (), (), 3.0, non_slip_s=((0.0, 1.0), (1.2 + 0.1, 3.0)))
    assert bins.starts.tolist() == [*range(0, 2000, 100), *range(2600, 6000, 100)]
    assert bins.starts.dtype == bins.stroke.dtype == bins.position.dtype == torch.int64
    assert (bins.is_slip.dtype, bool(bins.is_slip.any())) == (torch.bool, False)
    assert needed_windows(bins, 25, 3.0, RATE) == [(0.0, 2025 / RATE), (2575 / RATE, 3.0)]
    nothing = lay(rule, (), ())
    assert len(nothing.starts) == len(nothing.is_slip) == len(nothing.position) == 0
    assert needed_windows(nothing, 25, DURATION, RATE) == []


def test_stretches_of_slip_come_last_and_belong_to_no_stroke():
    stretches = {"non_slip_s": ((0.0, 0.2),), "slip_s": ((1.0, 1.1),)}
    bins = lay(LabelRule(hop_ms=25.0), (), (), 3.0, **stretches)
    assert bins.is_slip.tolist() == [False] * 7 + [True] * 3
    assert bins.starts[-3:].tolist() == [round(s * RATE) for s in (1.0, 1.025, 1.05)]
    assert set(bins.stroke.tolist()) == {-1}
    twice = lay(None, (), (), 3.0, non_slip_s=((0.0, 1.0),), slip_s=((0.0, 2.0),))
    assert (twice.starts / RATE)[twice.is_slip].min() == 1.0  # said to be no slip, it stays so


def test_bins_that_need_missing_samples_are_left_out():
    bins = lay(None, (), (), 3.0, non_slip_s=((0.0, 3.0),))
    gap = (1.0, 1.0 + 1 / RATE)
    for before, after, expected in ((0, 0, [2000]), (25, 11, [1900, 2000])):
        kept = clear_of(bins, [gap], before, after, RATE)
        assert sorted(set(bins.starts.tolist()) - set(kept.starts.tolist())) == expected
        assert len(kept.starts) == len(kept.is_slip) == len(kept.stroke) == len(kept.position)
    assert 1900 in clear_of(bins, [(1.0 + 11 / RATE, 1.1)], 25, 11, RATE).starts.tolist()


# Of a feature maker ----------------------------------------------------------------------------


def test_a_feature_maker_lays_bins_in_stretches_and_gives_them_no_speed():
    class Handled(SmallSet):
        def timeline(self, recording):
            return SmallTimeline(non_slip_s=((1.96, 2.0), (0.0, 0.09)))

    recording = RecordingId("a", 0)
    split = Split("all", {recording: "train"})
    plain, made = (small_maker(s)(recording, split) for s in (SmallSet(), Handled()))
    assert len(made.is_slip) == len(plain.is_slip) + 1  # 40 ms hold no bin, 90 hold one
    assert torch.equal(made.features[:-1], plain.features)
    assert made.speed_mm_s.tolist() == [*plain.speed_mm_s.tolist(), 0.0]
    assert made.position.tolist() == [*range(-20, 17), NO_POSITION]
    assert not bool(made.is_slip[-1])
    assert small_maker(SmallSet()).key(recording) != small_maker(Handled()).key(recording)


# Windows and shuffled labels -------------------------------------------------------------------

CASES = {
    "paper": lay(),
    "half_second": lay(HALF),
    "gaps": lay(LabelRule(hop_ms=150.0)),
    "close to both ends": lay(HALF, (0.505, DURATION - 0.51), ((0.5, 1.0), (14.9, 15.4))),
    "at both ends": lay(HALF, (0.5, DURATION - 0.5), ((0.5, 1.0), (15.0, 15.5))),
}


@pytest.mark.parametrize("name", CASES)
def test_windows_are_all_that_filtering_the_bins_needs(name, rng):
    """Samples outside the windows are NaN; not one of them reaches a bin."""
    bins, channel_filter = CASES[name], ChannelFilter([51, 11, 51])
    context, num_samples = channel_filter.context, round(DURATION * RATE)
    windows = needed_windows(bins, context, DURATION, RATE)
    flat = [edge for window in windows for edge in window]
    assert all(earlier < later for earlier, later in pairwise(flat))
    np.testing.assert_allclose(np.array(flat) * RATE, np.round(np.array(flat) * RATE), atol=1e-6)
    covered, needed = np.zeros((2, num_samples), dtype=bool)
    samples = torch.from_numpy(rng.standard_normal((3, num_samples)))
    partial = torch.full_like(samples, torch.nan)
    for low, high in windows:
        window = slice(round(low * RATE), round(high * RATE))
        covered[window] = True
        partial[:, window] = samples[:, window]
    for start in bins.starts.tolist():
        needed[max(start - context, 0) : start + 100 + context] = True
    assert covered[needed].all()
    extra = np.flatnonzero(covered & ~needed)
    assert bool(np.all((extra < 2 * context) | (extra >= num_samples - 2 * context)))
    whole = bins_at(channel_filter(samples), bins.starts, bins.bin_samples)
    cut = bins_at(channel_filter(partial), bins.starts, bins.bin_samples)
    torch.testing.assert_close(cut, whole, rtol=0, atol=0)


def test_windows_reach_an_end_that_is_close_and_merge_where_they_touch():
    """Within two contexts of an end the filter sees the true edge."""
    for start, reaches in ((0, True), (49, True), (50, False)):
        onset = 0.5 + start / RATE
        windows = needed_windows(lay(HALF, (onset,), ((onset, 2.0),)), 25, DURATION, RATE)
        assert (windows[0][0] == 0) == reaches
        onset = DURATION - onset
        windows = needed_windows(lay(HALF, (onset,), ((onset, DURATION),)), 25, DURATION, RATE)
        assert (windows[-1][1] == DURATION) == reaches
    assert len(needed_windows(lay(), 25, DURATION, RATE)) == 3  # one per stroke
    apart = lay(LabelRule(hop_ms=150.0), (2.0,), ((2.0, 2.03),))  # 200 samples between them
    counts = [len(needed_windows(apart, context, DURATION, RATE)) for context in (0, 99, 100)]
    assert counts == [len(apart.starts), len(apart.starts), 1]


def test_shuffled_labels_keep_their_number_and_depend_on_seed_and_place():
    is_slip = torch.arange(243) >= 60
    once = shuffled(is_slip, 3, 5)
    assert torch.equal(once, shuffled(is_slip, 3, 5))
    assert int(once.sum()) == 183
    assert not any(torch.equal(once, shuffled(is_slip, *by)) for by in ((3, 6), (4, 5)))


# Errors --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"layout": "nope"}, "labels.layout must be one of whole_slide, half_second, got 'nope'"),
        ({"onsets": "guessed"}, "labels.onsets must be one of annotated, exact, got 'guessed'"),
        ({"bin_ms": 0.0}, "labels.bin_ms must be positive, got 0.0"),
        ({"hop_ms": -50.0}, "labels.hop_ms must be positive, got -50.0"),
        ({"bin_ms": float("nan")}, "labels.bin_ms must be positive, got nan"),
        ({"bin_ms": 50.2}, r"labels.bin_ms=50.2 is 100.4 samples at 2000 Hz; choose a whole"),
        ({"hop_ms": 0.1}, r"labels.hop_ms=0.1 is 0.2 samples"),
        ({"bin_ms": 1100.0}, r"labels\.bin_ms=1100 is longer than the 1000 ms"),
        ({"layout": "half_second", "bin_ms": 600.0}, r"labels\.bin_ms=600 is longer"),
    ],
)
def test_a_bad_rule_is_refused(change, said):
    with pytest.raises(ValueError, match=said):
        lay(LabelRule(**change))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"onsets": (1.005,), "slides": ((1.005, 3.0),)}, r"stroke 1 with its onset at 1.005 s"),
        ({"duration_s": 15.1}, r"stroke 3 .* outside the recording of 15.100 s"),
        ({"rule": HALF, "onsets": (0.4,), "slides": ((0.4, 3.0),)}, "stroke 1"),
        (
            {"rule": HALF, "onsets": (2.0,), "slides": ((2.0, 2.45),), "duration_s": 2.4},
            r"outside the recording of 2\.400 s",
        ),
        ({"onsets": ONSETS[:2]}, "zip"),
        ({"non_slip_s": ((15.0, 15.6),)}, r"the stretch from .* leaves the recording of"),
        ({"non_slip_s": ((-0.1, 1.0),)}, r"the stretch from .* leaves the recording of"),
        ({"slip_s": ((1.0, 15.6),)}, r"the stretch from .* leaves the recording of"),
    ],
)
def test_what_leaves_the_recording_is_refused(options, said):
    with pytest.raises(ValueError, match=said):
        lay(**options)

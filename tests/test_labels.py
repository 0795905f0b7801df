from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from small_set import SmallSet, SmallTimeline, small_maker

from tactslip_torch import FeaturePool, HandLayout, Recording
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
from tactslip_torch.training.datamodule import FeatureMaker

RATE = 2000.0
ONSETS = (2.0, 9.0, 13.5)  # REFERENCE.md section 1, with slides of 100 mm at 20, 40, 60 mm/s
SLIDES = ((2.0, 7.0), (9.0, 11.5), (13.5, 13.5 + 100 / 60))
DURATION = 15.5


def lay(rule=None, onsets=ONSETS, slides=SLIDES, duration_s=DURATION, rate=RATE, non_slip=()):
    return label_bins(rule or LabelRule(), onsets, slides, duration_s, rate, non_slip)


def of_stroke(bins, stroke, is_slip):
    return bins.starts[(bins.stroke == stroke) & (bins.is_slip == is_slip)].tolist()


# Layouts -------------------------------------------------------------------------------------


def test_whole_slide_has_the_published_counts():
    bins = lay()
    assert int((~bins.is_slip).sum()) == 60
    assert int(bins.is_slip.sum()) == 183
    for stroke, num_slip in enumerate((100, 50, 33)):
        assert len(of_stroke(bins, stroke, False)) == 20
        assert len(of_stroke(bins, stroke, True)) == num_slip
    assert bins.bin_samples == 100


def test_whole_slide_moves_the_onset_ten_milliseconds_earlier():
    bins = lay()
    for stroke, (onset, (_, end)) in enumerate(zip(ONSETS, SLIDES, strict=True)):
        before, after = of_stroke(bins, stroke, False), of_stroke(bins, stroke, True)
        edge = onset - 0.010
        np.testing.assert_allclose(before, (edge - 1 + 0.05 * np.arange(20)) * RATE, atol=1e-6)
        np.testing.assert_allclose(after, (edge + 0.05 * np.arange(len(after))) * RATE, atol=1e-6)
        assert (after[-1] + 100) / RATE <= end < (after[-1] + 200) / RATE


def test_half_second_has_ten_and_ten_without_a_shift():
    bins = lay(LabelRule(layout="half_second"))
    assert len(bins.starts) == 60
    for stroke, onset in enumerate(ONSETS):
        before, after = of_stroke(bins, stroke, False), of_stroke(bins, stroke, True)
        np.testing.assert_allclose(before, (onset - 0.5 + 0.05 * np.arange(10)) * RATE, atol=1e-6)
        np.testing.assert_allclose(after, (onset + 0.05 * np.arange(10)) * RATE, atol=1e-6)


def test_half_second_does_not_follow_a_slide_that_goes_on():
    shorter = tuple((start, end - 1) for start, end in SLIDES)
    rule = LabelRule(layout="half_second")
    assert torch.equal(lay(rule).starts, lay(rule, slides=shorter).starts)
    assert len(lay(slides=shorter).starts) == 60 + 80 + 30 + 13


@pytest.mark.parametrize("layout", ["whole_slide", "half_second"])
def test_a_hop_of_half_a_bin_doubles_the_bins_but_one(layout):
    plain = lay(LabelRule(layout=layout))
    dense = lay(LabelRule(layout=layout, hop_ms=25.0))
    assert dense.bin_samples == 100
    for stroke in range(3):
        for is_slip in (False, True):
            every = of_stroke(dense, stroke, is_slip)
            assert every[::2][: len(of_stroke(plain, stroke, is_slip))] == of_stroke(
                plain, stroke, is_slip
            )
            assert set(np.diff(every)) == {50}
    assert len(of_stroke(dense, 0, False)) == 2 * len(of_stroke(plain, 0, False)) - 1


def test_a_hop_longer_than_a_bin_leaves_gaps():
    bins = lay(LabelRule(hop_ms=100.0))
    assert len(of_stroke(bins, 0, False)) == 10
    assert set(np.diff(of_stroke(bins, 0, True))) == {200}


def test_bin_length_and_rate_scale_together():
    bins = lay(LabelRule(bin_ms=25.0), rate=1000.0)
    assert bins.bin_samples == 25
    assert len(of_stroke(bins, 0, False)) == 40
    assert of_stroke(bins, 0, True)[0] == 1990


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


def test_a_slide_shorter_than_a_bin_has_no_slip_bin():
    bins = lay(onsets=(2.0,), slides=((2.0, 2.03),))
    assert len(bins.starts) == 20
    assert not bool(bins.is_slip.any())


# Positions -----------------------------------------------------------------------------------


@pytest.mark.parametrize(("layout", "lead"), [("whole_slide", 20), ("half_second", 10)])
def test_positions_count_from_the_onset(layout, lead):
    bins = lay(LabelRule(layout=layout))
    assert bins.position.dtype == torch.int64
    for stroke in range(3):
        mine = bins.stroke == stroke
        before, after = (bins.position[mine & (bins.is_slip == s)].tolist() for s in (False, True))
        assert before == list(range(-lead, 0))
        assert after == list(range(len(after)))
    edges = torch.tensor([round((o - (0.01 if lead == 20 else 0)) * RATE) for o in ONSETS])
    assert torch.equal(bins.starts, edges[bins.stroke] + 100 * bins.position)


@pytest.mark.parametrize("hop_ms", [25.0, 150.0])
def test_the_last_bin_before_an_onset_is_minus_one_at_any_hop(hop_ms):
    bins = lay(LabelRule(hop_ms=hop_ms))
    for stroke in range(3):
        quiet, slip = (
            (bins.stroke == stroke) & (bins.is_slip == is_slip) for is_slip in (False, True)
        )
        assert int(bins.position[quiet].max()) == -1
        assert int(bins.position[slip].min()) == 0
        assert set(np.diff(bins.position[quiet | slip])) == {1}


def test_bins_cut_by_the_slide_before_keep_their_positions():
    bins = lay(onsets=(2.0, 3.3), slides=((2.0, 3.0), (3.3, 4.3)), duration_s=5.0)
    quiet = bins.position[~bins.is_slip & (bins.stroke == 1)].tolist()
    assert quiet == list(range(-5, 0))  # 0.29 s hold five bins of 20


# Stretches without slip ----------------------------------------------------------------------


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


@pytest.mark.parametrize("layout", ["whole_slide", "half_second"])
@pytest.mark.parametrize("hop_ms", [None, 25.0, 70.0])
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
    plain, bins = lay(rule, annotated), lay(rule, annotated, non_slip=seconds)
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


def test_a_slide_shorter_than_a_bin_is_still_no_place_for_a_non_slip_bin():
    for onset in (2.0, 1.995, 2.02):  # as annotated; the contact slides from 2.0 on
        bins = lay(onsets=(onset,), slides=((2.0, 2.03),), non_slip=((1.5, 3.0),))
        own = bins.starts[bins.stroke == -1] / RATE
        assert not bool(bins.is_slip.any())
        assert len(own) > 10
        assert bool(((own >= 2.03) | (own + 0.05 <= min(onset - 0.01, 2.0) + 1e-9)).all())


@pytest.mark.parametrize(
    ("annotated", "stretch"),
    [(2.04, (1.98, 2.03)), (1.88, (1.93, 1.98))],
    ids=["from the exact start on", "from the annotated onset on"],
)
def test_between_annotated_and_exact_onset_nothing_is_non_slip(annotated, stretch):
    """Where a long hop leaves room for a bin; moved away by a second there is one."""
    rule = LabelRule(hop_ms=150.0)
    assert -1 not in lay(rule, (annotated,), ((2.0, 4.0),), non_slip=(stretch,)).stroke
    moved = tuple(edge + 3.0 for edge in stretch)
    assert -1 in lay(rule, (annotated,), ((2.0, 4.0),), non_slip=(moved,)).stroke


@pytest.mark.parametrize("layout", ["whole_slide", "half_second"])
def test_a_recording_without_onsets_has_the_bins_of_its_stretches(layout):
    rule = LabelRule(layout=layout)
    bins = lay(rule, (), (), 3.0, non_slip=((0.0, 1.0), (1.2 + 0.1, 3.0)))
    assert bins.starts.tolist() == [*range(0, 2000, 100), *range(2600, 6000, 100)]
    assert bins.starts.dtype == bins.stroke.dtype == bins.position.dtype == torch.int64
    assert bins.is_slip.dtype == torch.bool
    assert not bool(bins.is_slip.any())
    assert needed_windows(bins, 25, 3.0, RATE) == [(0.0, 2025 / RATE), (2575 / RATE, 3.0)]


def test_a_recording_of_nothing_has_no_bins():
    bins = lay(onsets=(), slides=())
    assert [len(part) for part in (bins.starts, bins.is_slip, bins.stroke, bins.position)] == 4 * [
        0
    ]
    assert needed_windows(bins, 25, DURATION, RATE) == []


@pytest.mark.parametrize("stretch", [(15.0, 15.6), (-0.1, 1.0)])
def test_a_stretch_that_leaves_the_recording_is_refused(stretch):
    with pytest.raises(ValueError, match=r"the stretch from .* leaves the recording of"):
        lay(non_slip=(stretch,))


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


# Whose onsets --------------------------------------------------------------------------------


@pytest.mark.parametrize("onsets", ["annotated", "exact"])
def test_the_caller_chooses_the_onsets(onsets):
    """``label_bins`` takes what it is given, whatever the rule says."""
    moved = tuple(onset + 0.02 for onset in ONSETS)
    rule = LabelRule(onsets=onsets)
    assert torch.equal(lay(rule, moved).starts[:20], lay(rule).starts[:20] + 40)


@pytest.mark.parametrize(("onsets", "expected_s"), [("annotated", 1.25), ("exact", 1.2)])
def test_a_feature_maker_takes_the_onsets_its_rule_names(onsets, expected_s):
    hand = HandLayout.from_rows(
        [{"name": "film", "kind": "PVDF", "finger": "index", "segment": "distal"}]
    )
    noise = torch.randn(1, 6000, generator=torch.Generator().manual_seed(0))
    trial = Recording(noise, RATE, "M1", (20.0,), (1.2,), ((1.2, 2.5),), (1.25,))
    source = SimpleNamespace(
        hand=hand,
        sample_rate_hz=RATE,
        is_simulated=False,
        ids=(RecordingId("M1", 0),),
        timeline=lambda recording: trial,
        load=lambda recording, windows: trial,
    )
    maker = FeatureMaker(source, FeaturePool(hand), ChannelFilter([11]), LabelRule(onsets=onsets))
    cut, bins = maker.filtered_bins(source.ids[0])
    assert int(bins.starts[bins.is_slip][0]) == round((expected_s - 0.01) * RATE)
    assert cut.shape == (len(bins.starts), 1, 100)


# Errors --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"layout": "nope"}, "labels.layout must be one of whole_slide, half_second, got 'nope'"),
        ({"onsets": "guessed"}, "labels.onsets must be one of annotated, exact, got 'guessed'"),
        ({"bin_ms": 0.0}, "labels.bin_ms must be positive, got 0.0"),
        ({"hop_ms": -50.0}, "labels.hop_ms must be positive, got -50.0"),
        ({"bin_ms": float("nan")}, "labels.bin_ms must be positive, got nan"),
    ],
)
def test_a_bad_rule_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        LabelRule(**change)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"bin_ms": 50.2}, r"labels.bin_ms=50.2 is 100.4 samples at 2000 Hz; choose a whole"),
        ({"hop_ms": 0.1}, r"labels.hop_ms=0.1 is 0.2 samples"),
    ],
)
def test_no_whole_number_of_samples_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        lay(LabelRule(**change))


@pytest.mark.parametrize("bin_ms", [33.0, 49.5, 0.5])
def test_a_whole_number_of_samples_is_not(bin_ms):
    assert lay(LabelRule(bin_ms=bin_ms)).bin_samples == round(2 * bin_ms)


def test_a_bin_that_leaves_the_recording_is_refused_with_its_stroke():
    with pytest.raises(ValueError, match=r"stroke 1 with its onset at 1.005 s needs samples from"):
        lay(onsets=(1.005,), slides=((1.005, 3.0),))
    with pytest.raises(ValueError, match=r"stroke 3 .* outside the recording of 15.100 s"):
        lay(duration_s=15.1)
    half = LabelRule(layout="half_second")
    with pytest.raises(ValueError, match="stroke 1"):
        lay(half, (0.4,), ((0.4, 3.0),))
    with pytest.raises(ValueError, match=r"outside the recording of 2\.400 s"):
        lay(half, (2.0,), ((2.0, 2.45),), 2.4)


def test_no_bin_is_slip_behind_the_end_of_its_slide():
    bins = lay(LabelRule(layout="half_second"), (2.0,), ((2.0, 2.23),), 5.0)
    ends = (bins.starts[bins.is_slip] + bins.bin_samples) / 2000
    assert len(ends) == 4
    assert float(ends.max()) <= 2.23


@pytest.mark.parametrize("layout", ["whole_slide", "half_second"])
def test_no_bin_is_non_slip_within_the_slide_before(layout):
    """A pause of 0.3 s leaves less than the layout asks for."""
    onsets, slides = (2.0, 3.3), ((2.0, 3.0), (3.3, 4.3))
    bins = lay(LabelRule(layout=layout), onsets, slides, 5.0)
    quiet = bins.starts[~bins.is_slip & (bins.stroke == 1)] / 2000
    assert float(quiet.min()) >= 3.0
    assert 0 < len(quiet) <= 6


def test_bins_may_touch_both_ends_of_the_recording():
    bins = lay(LabelRule(layout="half_second"), (0.5,), ((0.5, 1.0),), 1.0)
    assert int(bins.starts[0]) == 0
    assert int(bins.starts[-1]) + 100 == 2000


def test_onsets_and_slides_must_go_together():
    with pytest.raises(ValueError, match="zip"):
        lay(onsets=ONSETS[:2])


@pytest.mark.parametrize(
    "rule",
    [LabelRule(bin_ms=1100.0), LabelRule("half_second", bin_ms=600.0)],
    ids=["whole_slide", "half_second"],
)
def test_a_bin_longer_than_the_stretch_before_the_onset_is_refused(rule):
    with pytest.raises(ValueError, match=r"labels\.bin_ms"):
        lay(rule)


# Windows -------------------------------------------------------------------------------------


def cases():
    yield "paper", lay()
    yield "half_second", lay(LabelRule(layout="half_second"))
    yield "gaps", lay(LabelRule(hop_ms=150.0))
    yield (
        "close to both ends",
        lay(LabelRule(layout="half_second"), (0.505, DURATION - 0.51), ((0.5, 1.0), (14.9, 15.4))),
    )
    yield (
        "at both ends",
        lay(LabelRule(layout="half_second"), (0.5, DURATION - 0.5), ((0.5, 1.0), (15.0, 15.5))),
    )


@pytest.mark.parametrize(("name", "bins"), list(cases()), ids=[name for name, _ in cases()])
def test_windows_cover_every_bin_with_context_and_no_more(name, bins):
    context, num_samples = 25, round(DURATION * RATE)
    windows = [(low * RATE, high * RATE) for low, high in needed_windows(bins, 25, DURATION, RATE)]
    np.testing.assert_allclose(windows, np.round(windows), atol=1e-6)
    covered = np.zeros(num_samples, dtype=bool)
    for low, high in windows:
        covered[round(low) : round(high)] = True
    needed = np.zeros(num_samples, dtype=bool)
    for start in bins.starts.tolist():
        needed[max(start - context, 0) : start + 100 + context] = True
    assert covered[needed].all()
    extra = np.flatnonzero(covered & ~needed)
    assert bool(np.all((extra < 2 * context) | (extra >= num_samples - 2 * context)))


@pytest.mark.parametrize(("name", "bins"), list(cases()), ids=[name for name, _ in cases()])
def test_windows_ascend_with_gaps_between_them(name, bins):
    windows = needed_windows(bins, 25, DURATION, RATE)
    flat = [edge for window in windows for edge in window]
    assert all(earlier < later for earlier, later in pairwise(flat))
    assert flat[0] >= 0
    assert flat[-1] <= DURATION


def test_windows_close_to_an_end_reach_it():
    """Within two contexts, so that the filter sees the true edge."""
    half = LabelRule(layout="half_second")
    for start, reaches in ((0, True), (30, True), (49, True), (50, False)):
        onset = 0.5 + start / RATE
        windows = needed_windows(lay(half, (onset,), ((onset, 2.0),)), 25, DURATION, RATE)
        assert (windows[0][0] == 0) == reaches
        onset = DURATION - onset
        windows = needed_windows(lay(half, (onset,), ((onset, DURATION),)), 25, DURATION, RATE)
        assert (windows[-1][1] == DURATION) == reaches


def test_windows_merge_where_they_touch():
    assert len(needed_windows(lay(), 25, DURATION, RATE)) == 3  # one per stroke
    apart = lay(LabelRule(hop_ms=150.0), (2.0,), ((2.0, 2.03),))
    num_bins = len(apart.starts)
    assert len(needed_windows(apart, 0, DURATION, RATE)) == num_bins
    assert len(needed_windows(apart, 99, DURATION, RATE)) == num_bins  # 2 samples between them
    assert len(needed_windows(apart, 100, DURATION, RATE)) == 1


@pytest.mark.parametrize(("name", "bins"), list(cases()), ids=[name for name, _ in cases()])
def test_filtering_the_windows_alone_gives_the_same_bins(name, bins, rng):
    """Samples outside the windows are NaN; not one of them reaches a bin."""
    channel_filter = ChannelFilter([51, 11, 51])
    samples = torch.from_numpy(rng.standard_normal((3, round(DURATION * RATE))))
    partial = torch.full_like(samples, torch.nan)
    for low, high in needed_windows(bins, channel_filter.context, DURATION, RATE):
        window = slice(round(low * RATE), round(high * RATE))
        partial[:, window] = samples[:, window]
    assert bool(partial.isnan().any())
    whole = bins_at(channel_filter(samples), bins.starts, bins.bin_samples)
    cut = bins_at(channel_filter(partial), bins.starts, bins.bin_samples)
    torch.testing.assert_close(cut, whole, rtol=0, atol=0)


# Shuffled labels -----------------------------------------------------------------------------


def test_shuffled_labels_keep_their_number_and_depend_on_seed_and_place():
    is_slip = torch.arange(243) >= 60
    once = shuffled(is_slip, 3, 5)
    assert torch.equal(once, shuffled(is_slip, 3, 5))
    assert int(once.sum()) == 183
    assert not torch.equal(once, is_slip)
    assert not torch.equal(once, shuffled(is_slip, 3, 6))
    assert not torch.equal(once, shuffled(is_slip, 4, 5))


def test_stretches_of_slip_come_last_and_belong_to_no_stroke():
    bins = label_bins(
        LabelRule(hop_ms=25.0), (), (), 3.0, RATE, non_slip_s=((0.0, 0.2),), slip_s=((1.0, 1.1),)
    )
    assert bins.is_slip.tolist() == [False] * 7 + [True] * 3
    assert bins.starts[-3:].tolist() == [round(s * RATE) for s in (1.0, 1.025, 1.05)]
    assert set(bins.stroke.tolist()) == {-1}
    told_twice = label_bins(
        LabelRule(), (), (), 3.0, RATE, non_slip_s=((0.0, 1.0),), slip_s=((0.0, 2.0),)
    )
    starts = (told_twice.starts / RATE)[told_twice.is_slip]
    assert starts.min() == 1.0  # what is said to be no slip stays so
    with pytest.raises(ValueError, match=r"the stretch from .* leaves the recording of"):
        label_bins(LabelRule(), (), (), 3.0, RATE, slip_s=((1.0, 3.5),))


def test_bins_that_need_missing_samples_are_left_out():
    bins = label_bins(LabelRule(), (), (), 3.0, RATE, non_slip_s=((0.0, 3.0),))
    gap = (1.0, 1.0 + 1 / RATE)
    kept = clear_of(bins, [gap], 0, 0, RATE)
    assert set(bins.starts.tolist()) - set(kept.starts.tolist()) == {round(RATE)}
    before, after = 25, 11
    kept = clear_of(bins, [gap], before, after, RATE)
    lost = sorted(set(bins.starts.tolist()) - set(kept.starts.tolist()))
    assert lost == [round(RATE) - bins.bin_samples, round(RATE)]
    assert len(kept.starts) == len(kept.is_slip) == len(kept.stroke) == len(kept.position)
    moved = clear_of(bins, [(1.0 + 11 / RATE, 1.1)], 25, 11, RATE)
    assert round(RATE) - bins.bin_samples in moved.starts.tolist()

"""A stream in pieces, and the alarm of evidence and bins, against the whole and plain loops."""

import copy
import logging
import math
import pickle
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from streams import detector_of, onset_of, signal
from test_rules import ORACLES, by_hand

from tactslip_torch.features.sensing import without_stuck
from tactslip_torch.model.calibration import Platt
from tactslip_torch.onset.decisions import (
    AlarmSettings,
    Decider,
    joined_decisions,
    score_stream,
)
from tactslip_torch.onset.rules import Cusum, KOfN
from tactslip_torch.onset.streaming import StreamingDetector

HOP = 20
RATE = 2000.0
RULES = [KOfN(2, 3), Cusum(0.5, 0.5, 2.0)]
DETECTORS = {
    (kind, align): detector_of(kind, align)
    for kind in ("all", "PVDF")
    for align in ("centred", "causal", "trailing")
}
DETECTOR = DETECTORS["all", "centred"]
USUAL = score_stream(DETECTOR, signal(20000, 7), HOP).score
MIDDLE, SPREAD = float(USUAL.median()), float(USUAL.std())


def settings_of(rule=RULES[0], hop=HOP, threshold=1.0):
    """About half of the decisions speak for slip; alarms come often, and soon again."""
    calibration = Platt(0.5, -0.5 * MIDDLE)
    times = {"rearm_s": 0.02, "refractory_s": 0.05, "lead_s": 0.03}
    return AlarmSettings(hop, calibration, rule, threshold, target_per_hour=1.0, **times)


def stream_of(detector=DETECTOR, settings=None, dtype=torch.float64, **options):
    return StreamingDetector(detector, settings or settings_of(), dtype=dtype, **options)


def in_pieces(stream, samples, cuts=()):
    places = [0, *sorted(min(cut, samples.shape[-1]) for cut in cuts), samples.shape[-1]]
    parts = [stream.push(samples[:, a:b].T) for a, b in pairwise(places)]
    return joined_decisions([*parts, stream.flush()])


def offline(detector, settings, samples):
    """Decisions on a whole recording, all at once."""
    found, names = score_stream(detector, samples, settings.hop_samples), detector.pool.hand.names
    before = max(detector.channel_filter.reaches[c][0] for c in detector.needed_index)
    options = {"context_before": before, "channels": names}
    frame = 51 if settings.onset else 0
    decider = Decider(settings, RATE, 100, detector.look_ahead, frame, **options)
    bins = decider.decide(*found[:-1])
    if settings.onset is None:
        return bins
    evidence = settings.onset.evidence
    alone = torch.full((samples.shape[-1] // 10 + 2,), torch.nan, dtype=torch.float64)
    samples = without_stuck(samples, detector.sensing.stuck_samples)
    known, _ = settings.onset.scores(evidence.blocks_of_recording(samples), None, None)
    alone[-len(known) :] = known
    return decider.join(bins, alone.unfold(0, 3, 1).mean(-1).nan_to_num(-1e30))


def assert_same(found, expected):
    """Scores and what follows from them to rounding, everything else exactly."""
    close = SPREAD * (1e-9 if expected.score.dtype == torch.float64 else 1e-4)
    for name in ("score", "llr", "probability", "statistic"):
        pair = getattr(found, name), getattr(expected, name)
        how = {"rtol": 0, "atol": close, "equal_nan": True}
        torch.testing.assert_close(*pair, **how, msg=lambda m, name=name: name + m)
    exact = ("number", "available_s", "onset_s", "is_valid", "in_range", "channels_lost")
    for name in (*exact, "is_alarm", "is_on", "is_hint"):
        assert torch.equal(getattr(found, name), getattr(expected, name)), name


def assert_same_but_times(found, expected, shift_s):
    """Times are later by so much, as far as those of samples go."""
    times = {name: getattr(expected, name) for name in ("available_s", "onset_s")}
    for name, time_s in times.items():
        close = {"rtol": 0, "atol": 1e-6 if shift_s else 1e-9}
        torch.testing.assert_close(getattr(found, name), time_s + shift_s, **close)
    assert_same(found._replace(**times), expected)


# The same as the whole -------------------------------------------------------------------------


@given(
    num_samples=st.integers(0, 900),
    cuts=st.lists(st.integers(0, 900), max_size=30),
    kind=st.sampled_from(list(DETECTORS)),
    rule=st.sampled_from(RULES),
    hop=st.sampled_from([1, 7, 20, 100, 130]),
    dtype=st.sampled_from([torch.float64, torch.float32]),
    bad=st.lists(st.integers(0, 899), max_size=2),
)
def test_any_cut_gives_what_the_whole_recording_gives(
    num_samples, cuts, kind, rule, hop, dtype, bad
):
    detector, settings = DETECTORS[kind], settings_of(rule, hop)
    samples = signal(900, 5, dtype)
    for place in bad:
        samples[place % 4, place] = torch.nan
    samples = samples[:, :num_samples]
    found = in_pieces(stream_of(detector, settings, dtype), samples, cuts)
    assert found.score.dtype == dtype
    assert_same(found, offline(detector, settings, samples))


def test_samples_behind_the_look_ahead_change_no_decision():
    samples = signal(2000, 5)
    whole, later = in_pieces(stream_of(), samples), samples.clone()
    later[:, 1000:] = 7.0
    is_before = whole.available_s * RATE <= 1000
    changed = in_pieces(stream_of(), later)
    assert 10 < int(is_before.sum()) < len(is_before)
    for name in ("score", "statistic", "is_alarm", "onset_s"):
        found, expected = (getattr(of, name) for of in (changed, whole))
        assert torch.equal(found[is_before], expected[is_before]), name


def test_channels_may_be_masked_while_a_stream_runs():
    samples = signal(1800, 5)
    stream, parts = stream_of(), []
    for third, masked in zip(samples.T.tensor_split(3), ([], ["SG1", "PVDF2"], []), strict=True):
        stream.masked_channels = masked
        parts.append(stream.push(third))
        assert parts[-1].is_valid.all()  # two of four are enough
        assert {parts[-1].names_lost(i) for i in range(len(parts[-1].score))} == {tuple(masked)}
    made, whole = joined_decisions(parts), stream_of().push(samples.T)
    kept = ~made.channels_lost.any(-1)
    torch.testing.assert_close(made.score[kept], whole.score[kept], rtol=1e-9, atol=1e-9)
    assert (made.score[~kept] != whole.score[~kept]).all()


# Fast evidence ---------------------------------------------------------------------------------

WITH_ONSET = replace(settings_of(), onset=onset_of(signal(6000, 5), quantile=0.75))


@pytest.mark.parametrize(
    ("bad", "dtype"),
    [
        (None, torch.float32),
        ((1, 1, np.nan), torch.float64),
        ((0, 90, np.inf), torch.float64),
        ((3, 1, 0.0), torch.float32),
    ],
    ids=str,
)
def test_fast_evidence_in_any_cut_is_that_of_the_whole_recording(bad, dtype):
    """Of a channel now and then a sample is spoilt in the second second, or all."""
    samples = torch.cat([signal(6000, 6), signal(3000, 7)], -1).to(dtype)
    if bad is not None:
        channel, step, value = bad
        samples[channel, 2000:4000:step] = value
    expected = offline(DETECTOR, WITH_ONSET, samples)
    assert 0 < int(expected.by_onset.sum()) < int(expected.by_onset.numel()) / 2
    assert {alarm.raised_by for alarm in expected.alarms} == {"onset"}
    for cuts in (range(37, 9000, 37), [5, 3000, 3001, 8000]):
        found = in_pieces(stream_of(settings=WITH_ONSET, dtype=dtype), samples, cuts)
        assert_same(found, expected)
        torch.testing.assert_close(found.onset_score, expected.onset_score, rtol=0, atol=1e-12)
        assert torch.equal(found.by_onset, expected.by_onset)


# Times ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("each", [False, True])
@pytest.mark.parametrize("start_s", [0.0, 3.25, 1.7e9, -40.0])
def test_times_shift_what_comes_out_and_change_nothing_else(each, start_s):
    samples, stream, parts = signal(3000, 6), stream_of(), []
    for first in range(0, 3000, 70):
        part = samples[:, first : first + 70].T
        times = start_s + (first + np.arange(len(part))) / RATE
        parts.append(stream.push(part, times if each else float(times[0])))
    plain = in_pieces(stream_of(), samples)
    assert stream.num_gaps == 0
    assert len(plain.alarms) > 0
    assert_same_but_times(joined_decisions([*parts, stream.flush()]), plain, start_s)


@pytest.mark.parametrize("cuts", [[], [500, 1300, 1400, 2000, 2500]], ids=len)
def test_a_long_gap_ends_the_stream_and_begins_another(cuts, caplog):
    samples = signal(3000, 6)
    times = np.arange(3000) / RATE
    times[1300:] += 501 / RATE  # one more than are filled up
    times[2000:] += 3600.0
    fresh, expected = stream_of(), []
    for a, b in ((0, 1300), (1300, 2000), (2000, 3000)):
        expected += [fresh.push(samples[:, a:b].T, float(times[a])), fresh.flush()]
    expected, stream = joined_decisions(expected), stream_of()
    caplog.set_level(logging.WARNING)
    pushed = [stream.push(samples[:, a:b].T, times[a:b]) for a, b in pairwise([0, *cuts, 3000])]
    found = joined_decisions([*pushed, stream.flush()])
    assert_same_but_times(found, expected, 0.0)
    assert (found.number == 0).sum() == 3
    assert stream.num_gaps == 2
    assert [record.getMessage() for record in caplog.records] == [
        "the stream begins anew at 0.9005 s, behind a gap (time_s is in seconds)",
        "the stream begins anew at 3601.2505 s, behind a gap (time_s is in seconds)",
    ]
    stream.reset()
    assert stream.num_gaps == 0
    assert_same(in_pieces(stream, samples), in_pieces(stream_of(), samples))


def test_times_in_milliseconds_are_one_warning(caplog):
    stream, times_ms = stream_of(), np.arange(1000) * 1000 / RATE
    caplog.set_level(logging.WARNING)
    for first in range(0, 1000, 100):
        stream.push(signal(100, 6).T, times_ms[first : first + 100])
    assert stream.num_gaps == 999
    assert len(caplog.records) == 1


BACK = [0.2495, 0.0, -1e12, *(np.array([0.25, *then]) for then in ((0.2505, 0.2505), (-7.0, 9.0)))]


@pytest.mark.parametrize("times", BACK)
def test_times_that_go_back_are_refused_and_change_nothing(times):
    stream, samples = stream_of(), signal(1000, 6)
    before = stream.push(samples[:, :500].T, 0.0)
    with pytest.raises(ValueError, match=r"^time_s goes back: sample \d of these is at .*s, .*$"):
        stream.push(samples[:, 500:503].T, times)
    found = joined_decisions([before, stream.push(samples[:, 500:].T, 0.25), stream.flush()])
    assert_same_but_times(found, in_pieces(stream_of(), samples), 0.0)


def test_a_clock_of_its_own_and_jitter_make_no_gaps(rng):
    """A crystal 20 ppm fast for ten minutes, 24 samples; times good to a fifth of a sample."""
    stream, chunk = stream_of(settings=settings_of(hop=2000)), 2000
    samples, period = signal(chunk).T, (1 - 2e-5) / RATE
    found = []
    for first in range(0, 1_200_000, chunk):
        time_s = 1.7e9 + first * period + rng.uniform(-0.2, 0.2) / RATE
        found.append(stream.push(samples, time_s))
    assert stream.num_gaps == 0
    found = joined_decisions(found)
    assert found.is_valid.all()
    exact = 1.7e9 + (found.number.double() * 2000 + 125) * period
    assert (found.available_s - exact).abs().max() < 0.25 / RATE
    assert len(found.number) == 600


# What goes in, and a stream's life ---------------------------------------------------------------


FORMS = {
    "float32 tensor": lambda x: x.float(),
    "float32 array": lambda x: x.float().numpy(),
    "other byte order": lambda x: x.numpy().astype(">f8"),
    "read only": lambda x: np.frombuffer(x.contiguous().numpy().tobytes()).reshape(x.shape),
    "every second row": lambda x: x.repeat_interleave(2, 0).numpy()[::2],
    "backwards": lambda x: x.numpy()[::-1].copy()[::-1],
    "with gradient": lambda x: x.clone().requires_grad_(),
    "lists": lambda x: x.tolist(),
}


@pytest.mark.parametrize("form", FORMS)
def test_samples_may_come_in_any_form(form):
    samples = signal(700, 6, torch.float32).double()
    expected = in_pieces(stream_of(), samples)
    stream = stream_of()
    found = joined_decisions([stream.push(FORMS[form](samples.T)), stream.flush()])
    assert_same(found, expected)
    assert not found.score.requires_grad


def test_masked_samples_are_missing():
    samples = signal(1000, 6, torch.float32).double().T.numpy()
    masked = np.ma.array(samples, mask=False)
    masked[300:400, 1] = np.ma.masked
    stream, other = stream_of(), stream_of()
    found = joined_decisions([stream.push(masked), stream.flush()])
    expected = joined_decisions([other.push(masked.filled(np.nan)), other.flush()])
    assert_same(found, expected)
    assert found.channels_lost[:, 1].any()


@pytest.mark.parametrize(
    ("samples", "time_s", "words"),
    [
        (np.zeros((3, 5)), None, r"\[n, 4\].*\(3, 5\)"),
        (np.zeros((3, 4), np.int16), None, "floating.*int16"),
        (np.zeros((3, 4)), [0.1, 0.2], r"time_s.*3.*\(2,\)"),
    ],
)
def test_what_cannot_be_pushed_is_refused_and_changes_nothing(samples, time_s, words):
    stream, good = stream_of(), signal(1000, 6)
    before = stream.push(good[:, :500].T)
    with pytest.raises(ValueError, match=words):
        stream.push(samples, time_s)
    found = joined_decisions([before, stream.push(good[:, 500:].T), stream.flush()])
    assert_same(found, in_pieces(stream_of(), good))


def test_what_cannot_be_set_is_refused():
    for options, message in [
        ({"dtype": torch.float16}, r"dtype must be torch.float32 or torch.float64, got .*float16"),
        ({"masked_channels": ["PVDF3"]}, r"the channel 'PVDF3', which this hand does not have"),
    ]:
        with pytest.raises(ValueError, match=message):
            StreamingDetector(DETECTOR, settings_of(), **options)
    with pytest.raises(ValueError, match=r"no alarm threshold"):
        StreamingDetector(DETECTOR)


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.name)
def test_a_copy_of_a_running_stream_goes_on_by_itself(copied, rule):
    samples = signal(3000, 6)
    stream = stream_of(settings=settings_of(rule))
    before = [stream.push(samples[:, :1011].T, 7.0), stream.push(samples[:, 1011:1015].T)]
    twin = copied(stream)
    rest = [joined_decisions([x.push(samples[:, 1015:].T), x.flush()]) for x in (stream, twin)]
    assert_same(rest[1], rest[0])
    assert torch.equal(rest[1].score, rest[0].score)
    whole = offline(DETECTOR, settings_of(rule), samples)
    assert torch.equal(joined_decisions([*before, rest[0]]).is_alarm, whole.is_alarm)


# Memory ----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_an_hour_needs_no_more_memory_than_a_second():
    """What is pickled holds all that a stream remembers; the detector is left out of it."""
    settings = settings_of(RULES[0], hop=2000)
    stream = stream_of(DETECTORS["PVDF", "centred"], settings)
    samples = signal(20_000, 6).T

    def size():
        alone = copy.copy(stream)
        alone.detector = None
        return len(pickle.dumps(alone))

    sizes, buffers = [], []
    for push in range(360):
        stream.push(samples[:13_579], push * 10.0)
        found = stream.push(samples[13_579:])
        sizes.append(size())
        buffers.append(stream.state_bytes)
    assert max(sizes) - sizes[1] < 64  # larger numbers
    assert max(buffers) == buffers[1] < 4 * 8 * 2500
    assert int(found.number[-1]) == 3599


# Decisions that are not valid -------------------------------------------------------------------


def by_hand_with_gaps(rule, llrs, threshold, most, rearm, refractory):
    """Statistic, alarms, what stands, and numbers where runs began, one after the other."""
    known, lost, is_on, below, last_alarm, run = [], 0, False, 0, -math.inf, 0
    rows = []
    for number, llr in enumerate(llrs):
        statistic, is_alarm = math.nan, False
        if math.isnan(llr):
            lost += 1
            if lost > most:
                known, is_on, below, run = [], False, 0, number + 1
        else:
            lost = 0
            known.append(llr)
            statistic = ORACLES[rule.name](rule, known)[-1]
            below = below + 1 if statistic < threshold else 0
            is_on = is_on and below < max(rearm, 1)
            is_alarm = not is_on and below == 0 and number - last_alarm >= refractory
            if is_alarm:
                is_on, last_alarm = True, number
            run = run if llr > 0 else number + 1
        rows.append((statistic, is_alarm, is_on, min(run, number)))
    return list(zip(*rows, strict=True))


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.name)
@given(
    gaps=st.lists(st.tuples(st.integers(0, 199), st.integers(1, 20)), max_size=6),
    cuts=st.lists(st.integers(0, 200), max_size=6),
    hold_s=st.sampled_from([0.0, 0.02, 0.05]),
    seed=st.integers(0, 2**20),
)
def test_decisions_that_are_not_valid_move_nothing_until_the_hold_is_over(
    rule, gaps, cuts, hold_s, seed
):
    rng = np.random.default_rng(seed)
    llrs = np.repeat(rng.normal(0.3, 1.5, 100), 2)
    for start, num in gaps:
        llrs[start : start + num] = math.nan
    settings = replace(settings_of(rule), calibration=Platt(1.0, 0.0), hold_s=hold_s)
    decider = Decider(settings, RATE, 100, 25, context_before=15)
    score = torch.from_numpy(llrs)
    is_valid = score.isfinite()
    places = [0, *sorted(cuts), 200]
    spoilt = torch.where(is_valid, score, 7.0)  # what a score says there does not count
    found = joined_decisions(
        [decider.decide(spoilt[a:b], is_valid[a:b]) for a, b in pairwise(places)]
    )
    most = -(-(100 + 25 + 15 + round(hold_s * RATE)) // HOP)
    expected = by_hand_with_gaps(rule, llrs.tolist(), 1.0, most, rearm=2, refractory=5)
    np.testing.assert_allclose(found.statistic, expected[0], rtol=1e-12)
    assert found.is_alarm.tolist() == list(expected[1])
    assert found.is_on.tolist() == list(expected[2])
    assert torch.equal(found.score.isnan(), ~is_valid)
    began_s = (np.array(expected[3]) * HOP + 125) / RATE - settings.lead_s
    np.testing.assert_allclose(found.onset_s, began_s, rtol=0, atol=1e-12)


# Decider.join ----------------------------------------------------------------------------------


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.name)
@pytest.mark.parametrize(
    ("bin_hop", "hop", "frame"), [(50, 10, 0), (7, 10, 0), (10, 10, 0), (130, 3, 400)]
)
def test_joined_decisions_by_a_plain_loop(rule, bin_hop, hop, frame):
    classifier = replace(onset_of(signal(6000, 9), hop=hop), lead_s=0.012)
    settings = replace(settings_of(rule, bin_hop), onset=classifier)
    rng = np.random.default_rng(3)  # both reach their thresholds now and then
    scores = torch.from_numpy(MIDDLE - 8 + 10 * rng.standard_normal(500).repeat(8))
    onset = torch.from_numpy(classifier.threshold - 2 + rng.standard_normal(4000))
    scores = scores[: (4000 - 125) // bin_hop + 1]
    decider = Decider(settings, RATE, 100, 25, frame)
    found = decider.join(decider.decide(scores, scores.isfinite()), onset[: 4000 // hop])
    bins = Decider(settings, RATE, 100, 25).decide(scores, scores.isfinite())
    by_onset = []
    for i in range(4000 // hop):
        end = (i + 1) * hop
        known = [n for n in range(len(scores)) if n * bin_hop + 125 <= end and end >= frame]
        by_onset.append(float(onset[i]) >= settings.onset.threshold)
        assert float(found.available_s[i]) == end / RATE
        for name in ("score", "probability", "llr", "statistic"):
            wanted = getattr(bins, name)[known[-1]] if known else math.nan
            np.testing.assert_equal(float(getattr(found, name)[i]), float(wanted), name)
        assert found.is_valid[i]  # there is fast evidence always
        assert bool(found.in_range[i]) == bool(known)
        began_s = end / RATE - (0.012 if by_onset[i] else 0.0)
        if known and not by_onset[i]:
            began_s = min(float(bins.onset_s[known[-1]]), end / RATE)
        assert float(found.onset_s[i]) == began_s
    seconds = {"rearm": 0.02, "refractory": 0.05}
    times = {name: math.ceil(s * RATE / hop) for name, s in seconds.items()}
    alarms, standing = by_hand(list(map(float, by_onset)), 1, **times)
    assert found.number.tolist() == list(range(4000 // hop))
    assert found.by_onset.tolist() == by_onset
    assert (found.is_alarm.tolist(), found.is_on.tolist()) == (alarms, standing)
    assert found.is_hint.tolist() == (onset[: 4000 // hop] >= classifier.hint).tolist()
    assert {alarm.raised_by for alarm in found.alarms} == {"onset"}
    assert (bins.statistic >= settings.threshold).any()  # bins raise none of these

"""A stream watched in pieces against the same recording scored and decided whole."""

import copy
import logging
import pickle
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from streams import detector_of, onset_of, signal

from tactslip_torch.model.calibration import Platt
from tactslip_torch.onset.decisions import (
    AlarmSettings,
    Decider,
    Decisions,
    is_usable,
    score_stream,
)
from tactslip_torch.onset.rules import Cusum, KOfN
from tactslip_torch.onset.streaming import StreamingDetector
from tactslip_torch.signals.filtering import ChannelFilter

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


def joined(parts):
    return Decisions(*(torch.cat(entries) for entries in zip(*parts, strict=True)))


def in_pieces(stream, samples, cuts=()):
    places = [0, *sorted(min(cut, samples.shape[-1]) for cut in cuts), samples.shape[-1]]
    parts = [stream.push(samples[:, a:b].T) for a, b in pairwise(places)]
    return joined([*parts, stream.flush()])


def offline(detector, settings, samples):
    scores = score_stream(detector, samples, settings.hop_samples)
    decider = Decider(settings, RATE, 100, detector.look_ahead)
    tells = is_usable(scores.score, scores.is_missing, detector.needed_index)
    return decider.decide(scores.score, scores.is_valid, tells)


def assert_same(found, expected):
    """Scores and what follows from them to rounding, everything else exactly."""
    close = SPREAD * (1e-9 if expected.score.dtype == torch.float64 else 1e-4)
    for name in ("score", "llr", "probability", "statistic"):
        pair = getattr(found, name), getattr(expected, name)
        torch.testing.assert_close(*pair, rtol=0, atol=close, msg=lambda m, name=name: name + m)
    for name in ("number", "available_s", "onset_s", "is_valid", "is_alarm", "is_on"):
        assert torch.equal(getattr(found, name), getattr(expected, name)), name


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


@pytest.mark.parametrize("start_s", [None, 7.0])
def test_bins_shorter_than_a_frame_wait_for_the_first_frame(start_s):
    detector = copy.deepcopy(DETECTORS["all", "causal"])
    detector.channel_filter = ChannelFilter([151, 51, 11, 11], align="causal")
    stream, came, said = stream_of(detector), [], []
    for num, sample in enumerate(signal(200, 4).T, 1):
        found = stream.push(sample[None], None if start_s is None else start_s + (num - 1) / RATE)
        came += [num] * len(found.number)
        said += found.available_s.tolist()
    assert came == [151, 151, 151, 160, 180, 200]
    assert said == pytest.approx([(start_s or 0.0) + num / RATE for num in came], abs=1e-12)


# Fast evidence ---------------------------------------------------------------------------------

ONSET = onset_of(signal(6000, 5), quantile=0.75)


def with_onset(**options):
    return replace(settings_of(**options), onset=ONSET)


def joined_offline(settings, samples, masked=None):
    """Decisions on a whole recording, all hops at once."""
    detector, evidence = DETECTOR, ONSET.evidence
    scores = score_stream(detector, samples, settings.hop_samples)
    decider = Decider(settings, RATE, 100, detector.look_ahead, 51)
    tells = is_usable(scores.score, scores.is_missing, detector.needed_index)
    bins = decider.decide(scores.score, scores.is_valid, tells)
    alone = torch.full((samples.shape[-1] // 10 + 2,), torch.nan, dtype=torch.float64)
    alone[evidence.first_hop + 2 :] = ONSET.score(evidence.blocks_of_recording(samples), masked)
    onset_score = alone.unfold(0, 3, 1).mean(-1).nan_to_num(-1e30)
    return decider.join(bins, onset_score)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("kind", ["", "nan", "now and then", "dead"])
def test_fast_evidence_in_any_cut_is_that_of_the_whole_recording(kind, dtype):
    samples = spoilt(kind, signal(6000, 6).to(dtype))
    samples = torch.cat([samples, signal(3000, 7).to(dtype)], -1)
    settings = with_onset()
    expected = joined_offline(settings, samples)
    assert 0 < int(expected.by_onset.sum()) < int(expected.by_onset.numel()) / 2
    assert len({alarm.raised_by for alarm in expected.alarms}) == 2
    for cuts in (range(37, 9000, 37), [5, 3000, 3001, 8000]):
        found = in_pieces(stream_of(settings=settings, dtype=dtype), samples, cuts)
        assert_same(found, expected)
        torch.testing.assert_close(found.onset_score, expected.onset_score, rtol=0, atol=1e-12)
        assert torch.equal(found.by_onset, expected.by_onset)


@pytest.mark.parametrize("masked", [["PVDF1"], ["PVDF1", "PVDF2"]])
def test_fast_evidence_leaves_out_channels_that_are_masked(masked):
    samples = signal(6000, 6)
    stream = stream_of(settings=with_onset(), masked_channels=masked)
    is_masked = torch.tensor([name in masked for name in DETECTOR.pool.hand.names])
    expected = joined_offline(stream.settings, samples, is_masked).onset_score
    found = in_pieces(stream, samples, range(0, 6000, 130)).onset_score
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-12)
    assert bool((found > -1e30).any()) == (len(masked) < 2)


# What is missing or broken ---------------------------------------------------------------------


def spoilt(kind, samples):
    """A recording of 3 s of which the second one is spoilt, in one channel or all."""
    samples = samples.clone()
    middle = samples[:, 2000:4000]
    match kind:
        case "nan":
            middle[1] = torch.nan
        case "all nan":
            middle[:] = torch.nan
        case "now and then":
            middle[0, ::90] = torch.inf
        case "dead":
            middle[3] = 0.0
        case "rail":
            middle[2] = 5.0
        case "huge":
            middle[:] *= 1e30
        case "larger than float32":
            middle[0] = -1e300
        case "denormal":
            middle[:] *= 1e-40
    return samples


@pytest.mark.parametrize(("rule", "dtype"), [(RULES[0], torch.float32), (RULES[1], torch.float64)])
@pytest.mark.parametrize(
    "kind",
    ["nan", "all nan", "now and then", "dead", "rail", "huge", "larger than float32", "denormal"],
)
def test_broken_samples_are_flagged_and_gone_when_they_are_over(kind, rule, dtype):
    clean = signal(6000, 6)
    samples, settings = spoilt(kind, clean), settings_of(rule)
    stream = stream_of(settings=settings, dtype=dtype)
    found = joined([*(stream.push(part.T) for part in samples.split(123, -1)), stream.flush()])
    assert_same(found, offline(DETECTOR, settings, samples.to(dtype)))
    for entries in found:
        assert torch.as_tensor(entries, dtype=torch.float64).isfinite().all()
    starts = HOP * found.number
    touched = (starts - 25 < 4000) & (starts + 125 > 2000)
    within = (starts - 25 >= 2000) & (starts + 125 <= 4000)
    if kind not in ("huge", "denormal"):  # those are only large or small
        assert not found.is_valid[within].any()
    assert found.is_valid[~touched].all()
    healthy = in_pieces(stream_of(settings=settings, dtype=dtype), clean)
    close = 1e-9 if dtype == torch.float64 else 1e-4
    torch.testing.assert_close(
        found.score[~touched], healthy.score[~touched], rtol=close, atol=close
    )


# Times ------------------------------------------------------------------------------------------


def timed(stream, samples, start_s=0.0, chunk=70, each=False):
    """Push with exact times, of the first sample or of each."""
    parts = []
    for first in range(0, samples.shape[-1], chunk):
        part = samples[:, first : first + chunk].T
        times = start_s + (first + np.arange(len(part))) / RATE
        parts.append(stream.push(part, times if each else float(times[0])))
    return joined([*parts, stream.flush()])


@pytest.mark.parametrize("each", [False, True])
@pytest.mark.parametrize("start_s", [0.0, 3.25, 1.7e9, -40.0])
def test_times_shift_what_comes_out_and_change_nothing_else(each, start_s):
    samples = signal(3000, 6)
    stream = stream_of()
    plain, found = in_pieces(stream_of(), samples), timed(stream, samples, start_s, each=each)
    assert stream.num_gaps == 0
    for name in ("available_s", "onset_s"):
        expected = getattr(plain, name) + start_s
        torch.testing.assert_close(getattr(found, name), expected, rtol=0, atol=1e-6)
    assert len(plain.alarms) > 0
    assert_same(found._replace(available_s=plain.available_s, onset_s=plain.onset_s), plain)


@pytest.mark.parametrize("within", [False, True])
def test_a_long_gap_ends_the_stream_and_begins_another(within, caplog):
    samples = signal(3000, 6)
    times = np.arange(3000) / RATE
    times[1300:] += 101 / RATE
    times[2000:] += 3600.0
    fresh = stream_of()
    parts = [
        [fresh.push(samples[:, a:b].T, float(times[a])), fresh.flush()]
        for a, b in ((0, 1300), (1300, 2000), (2000, 3000))
    ]
    expected = joined([part for pair in parts for part in pair])
    stream = stream_of()
    caplog.set_level(logging.WARNING)
    if within:
        pushed = [stream.push(samples.T, times)]
    else:
        cuts = [0, 500, 1300, 1400, 2000, 2500, 3000]
        pushed = [stream.push(samples[:, a:b].T, times[a:b]) for a, b in pairwise(cuts)]
    found = joined([*pushed, stream.flush()])
    for name in ("available_s", "onset_s"):
        pair = getattr(found, name), getattr(expected, name)
        torch.testing.assert_close(*pair, rtol=0, atol=1e-9)
    assert_same(
        found._replace(available_s=expected.available_s, onset_s=expected.onset_s), expected
    )
    assert (found.number == 0).sum() == 3
    assert stream.num_gaps == 2
    assert [record.getMessage() for record in caplog.records] == [
        "the stream begins anew at 0.7005 s, behind a gap",
        "the stream begins anew at 3601.0505 s, behind a gap",
    ]


@pytest.mark.parametrize(
    "times",
    [
        0.2495,  # the last sample's
        0.0,
        -1e12,
        np.array([0.25, 0.2505, 0.2505]),
        np.array([0.25, 0.2505, 0.2500]),
        np.array([0.25, -7.0, 9.0]),
    ],
)
def test_times_that_go_back_are_refused_and_change_nothing(times):
    stream, twin = stream_of(), stream_of()
    samples = signal(1000, 6)
    for each in (stream, twin):
        each.push(samples[:, :500].T, 0.0)
    with pytest.raises(ValueError, match=r"^time_s goes back: sample \d of these is at .*s, .*$"):
        stream.push(samples[:, 500:503].T, times)
    expected = joined([twin.push(samples[:, 500:].T, 0.25), twin.flush()])
    found = joined([stream.push(samples[:, 500:].T, 0.25), stream.flush()])
    assert_same(found, expected)


def test_a_clock_of_its_own_and_jitter_make_no_gaps(rng):
    """A crystal 20 ppm fast for ten minutes, 24 samples; times good to a fifth of a sample."""
    stream, chunk = stream_of(settings=settings_of(hop=2000)), 2000
    samples, period = signal(chunk).T, (1 - 2e-5) / RATE
    found = []
    for first in range(0, 1_200_000, chunk):
        time_s = 1.7e9 + first * period + rng.uniform(-0.2, 0.2) / RATE
        found.append(stream.push(samples, time_s))
    assert stream.num_gaps == 0
    found = joined(found)
    assert found.is_valid.all()
    exact = 1.7e9 + (found.number.double() * 2000 + 125) * period
    assert (found.available_s - exact).abs().max() < 0.25 / RATE
    assert len(found.number) == 600


def test_time_without_stamps_is_counted_not_added_up():
    """After 1000 s a decision is where arithmetic of whole numbers has it."""
    stream = stream_of(settings=settings_of(hop=1999))
    last = None
    for _ in range(40):
        found = stream.push(signal(50_000)[:, :50_000].T)
        last = found if len(found.number) else last
    number = int(last.number[-1])
    assert float(last.available_s[-1]) == (number * 1999 + 125) / RATE
    assert number == (2_000_000 - 125) // 1999


# What goes in, and a stream's life ---------------------------------------------------------------


def read_only(samples):
    array = samples.numpy().copy()
    array.flags.writeable = False
    return array


FORMS = {
    "tensor": lambda x: x,
    "float32 tensor": lambda x: x.float(),
    "array": lambda x: x.numpy(),
    "float32 array": lambda x: x.float().numpy(),
    "other byte order": lambda x: x.numpy().astype(">f8"),
    "read only": read_only,
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
    found = joined([stream.push(FORMS[form](samples.T)), stream.flush()])
    assert_same(found, expected)
    assert not found.score.requires_grad


@pytest.mark.parametrize("as_array", [False, True])
@pytest.mark.parametrize("size", [1, 10, 200])
def test_what_was_pushed_may_be_overwritten(as_array, size):
    samples = signal(1000, 6)
    stream, buffer, parts = stream_of(), torch.empty(size, 4, dtype=torch.float64), []
    for part in samples.split(size, -1):
        buffer.copy_(part.T)
        parts.append(stream.push(buffer.numpy() if as_array else buffer))
        buffer.fill_(torch.nan)
    assert_same(joined([*parts, stream.flush()]), in_pieces(stream_of(), samples))


def test_what_cannot_be_set_is_refused():
    for options, message in [
        ({"dtype": torch.float16}, r"dtype must be torch.float32 or torch.float64, got .*float16"),
        ({"max_gap_s": -1.0}, r"max_gap_s must be finite and not negative, got -1.0"),
        ({"max_gap_s": float("nan")}, r"max_gap_s must be"),
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
    rest = [joined([x.push(samples[:, 1015:].T), x.flush()]) for x in (stream, twin)]
    assert_same(rest[1], rest[0])
    assert torch.equal(rest[1].score, rest[0].score)
    whole = offline(DETECTOR, settings_of(rule), samples)
    assert torch.equal(joined([*before, rest[0]]).is_alarm, whole.is_alarm)


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


def test_single_samples_are_not_hoarded():
    stream = stream_of()
    most = 0
    for _ in range(1000):
        stream.push(np.zeros((0, 4)))
        stream.push(np.zeros((1, 4)))
        most = max(most, stream.state_bytes)
    assert most <= 4 * 8 * (51 + 2 * 125)

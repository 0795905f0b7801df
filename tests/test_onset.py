"""Evidence of onsets against plain loops over the definition; a stream of it in any pieces."""

import json
import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from oracles import plausible_bins, wavelet_branches
from small_detector import HAND, raw_bins
from small_set import SmallSet, SmallTimeline
from streams import hand_of

from tactslip_torch.data.recording import Recording
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.hand import HandLayout
from tactslip_torch.model.calibration import Platt
from tactslip_torch.model.kernels import QuadraticForm
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.native import reason_unavailable
from tactslip_torch.onset.baselines import (
    VIBRATION_HZ,
    BaselineDetector,
    fast_band_power,
    largest_detail,
)
from tactslip_torch.onset.decisions import AlarmSettings
from tactslip_torch.onset.evidence import Blocks, OnsetClassifier, OnsetEvidence, OnsetStream
from tactslip_torch.onset.rules import NOTHING_YET, KOfN
from tactslip_torch.signals.filtering import ChannelFilter
from tactslip_torch.training.onset import OnsetTraining, kinds_of

RATE = 2000.0
FAST_SCALE, SLOW_SCALE = (0.01, 0.02, 0.03, 0.04), (0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
SCALES = {"fast_compression": FAST_SCALE, "slow_compression": SLOW_SCALE}


def evidence_of(kinds="GFFGFG", rate=RATE, hop=10, **changes):
    return OnsetEvidence(hand_of(kinds), rate, hop, **(SCALES | changes))


def samples_of(evidence, seconds=1.5, seed=0):
    """Noise whose size differs from channel to channel and from hop to hop, on offsets."""
    rng = np.random.default_rng(seed)
    num = round(seconds * evidence.sample_rate_hz)
    loud = np.repeat(rng.uniform(0.1, 3.0, (len(evidence.hand), -(-num // 50))), 50, 1)[:, :num]
    offsets = rng.normal(size=(len(loud), 1))
    return torch.from_numpy(loud * rng.standard_normal(loud.shape) + offsets)


# The definition ----------------------------------------------------------------------------------


def haar(x, seconds, rate):
    """The mean of the latest samples minus that of as many before."""
    width = max(1, round(seconds * rate))
    return np.convolve(x, np.repeat([1.0, -1.0], width) / width)[: len(x)]


def filtered(x, rate, mains, periods):
    t = np.arange(len(x))
    ago = [np.interp(t - n * rate / mains, t, x) for n in range(1, periods + 1)]
    plain = [haar(x, seconds, rate) for seconds in (0.0005, 0.002, 0.004)]
    return np.stack([*plain, haar(x - np.mean(ago, 0), 0.001, rate)])


def oracle(evidence, x, masked=()):
    """Columns of every hop that has its second, by loops; and the number of the first."""
    rate, hop = evidence.sample_rate_hz, evidence.hop_samples

    def blocks(seconds):
        return int(np.ceil(np.round(seconds * rate) / hop))

    def cut(y):
        num = y.shape[-1] // hop
        return y[..., : num * hop].reshape(*y.shape[:-1], num, hop)

    fast, slow = evidence.hand.indices("PVDF"), list(evidence.hand.indices("SG"))
    mains = evidence.mains_hz, evidence.comb_periods
    heard = np.stack([filtered(x[c], rate, *mains) for c in fast])
    power = (cut(heard) ** 2).mean(-1) + np.square(evidence.fast_compression)[
        :, None
    ]  # [F, B, blocks]
    mean = cut(x[slow]).mean(-1)
    windows, second = [blocks(s) for s in (0.01, 0.025, 0.05)], blocks(1.0)
    of_comb = np.ceil(mains[1] * rate / mains[0]) + 2 * max(1, round(0.001 * rate)) - 1
    reach = max(2 * round(0.004 * rate) - 1, of_comb)
    first = int(np.ceil(reach / hop)) + second + windows[-1] - 1
    steps_s = [(10, 10, 10), (25, 25, 25), (25, 50, 50), (50, 100, 100), (50, 50, 200)]
    rows = []
    for b in range(first, power.shape[-1]):
        before = power[..., b + 1 - windows[-1] - second : b + 1 - windows[-1]]
        floor = np.log(np.sqrt(before)).mean(-1)
        levels = [0.5 * np.log(power[..., b + 1 - n : b + 1].mean(-1)) for n in windows]
        in_use = [i for i, c in enumerate(fast) if c not in masked]
        rise = np.concatenate([level - floor for level in levels], -1)[in_use]
        row = [rise.mean(0)] + ([rise.max(0), rise.min(0)] if len(fast) > 1 else [])
        step, way = [], []
        for lengths, scale in zip(
            [*steps_s, (100, 100, 400)], evidence.slow_compression, strict=True
        ):
            late, early, back = (blocks(ms / 1000) for ms in lengths)
            latest = mean[:, b + 1 - late : b + 1].mean(-1)
            other = mean[:, b + 1 - back - early : b + 1 - back].mean(-1)
            step.append(np.log(np.abs(latest - other) + scale))
            way.append(np.sign(latest - other) * np.log1p(np.abs(latest - other) / scale))
        heard = [i for i, c in enumerate(slow) if c not in masked]
        step, way = np.array(step)[:, heard], np.array(way)[:, heard]
        if len(slow):
            for each in (step, way):
                row.append(each.mean(-1))
                row += [each.max(-1), each.min(-1)] if len(slow) > 1 else []
        rows.append(np.concatenate(row))
    return np.array(rows), first


def columns_of(evidence, x, masked=None):
    return evidence.columns(evidence.blocks_of_recording(x), masked)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"hop": 7, "comb_periods": 4, "mains_hz": 60.0},
        {"kinds": "FGF", "rate": 500.0, "hop": 2, "mains_hz": 60.0},
        {"kinds": "F", "rate": 1300.0, "hop": 1},
    ],
    ids=str,
)
def test_columns_are_those_of_the_definition(changes):
    evidence = evidence_of(**changes)
    x = samples_of(evidence, 1.3)
    found, is_usable = columns_of(evidence, x)
    expected, first = oracle(evidence, x.numpy())
    assert evidence.first_hop == first
    assert found.shape == (len(x[0]) // evidence.hop_samples - first, evidence.num_columns)
    assert bool(is_usable.all())
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10)


# Channels that are left out ----------------------------------------------------------------------


@pytest.mark.parametrize("channel", [0, 2])
def test_a_masked_channel_is_as_if_it_were_not_there(channel):
    evidence, rest = evidence_of(), [c for c in range(6) if c != channel]
    x = samples_of(evidence)
    without = evidence_of("".join("GFFGFG"[c] for c in rest))
    found, _ = columns_of(evidence, x, torch.arange(6) == channel)
    torch.testing.assert_close(found, columns_of(without, x[rest])[0], rtol=0, atol=1e-12)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_fast_channel_is_left_out_while_what_is_missing_is_remembered(value):
    evidence, place = evidence_of(), 300
    x = samples_of(evidence, 2.0)
    whole, without = (oracle(evidence, x.numpy(), left_out)[0] for left_out in ((), {2}))
    x[2, place] = value
    found, is_usable = columns_of(evidence, x)
    # filters reach back 40 + 3 samples; what is in block 30 is heard in 30 to 34, and 210 hops on
    number = evidence.first_hop + torch.arange(len(found))
    is_out = (number >= 30) & (number <= 34 + 209)
    expected = torch.where(is_out[:, None], torch.from_numpy(without), torch.from_numpy(whole))
    assert 0 < int(is_out.sum()) < len(found)
    assert bool(is_usable.all())
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-10)


def test_a_living_channel_that_is_quiet_takes_part_in_the_pools():
    """A thousandth as loud as the others, and far above what counts as silent: it is the least."""
    evidence = evidence_of(fast_compression=(1e-6,) * 4, least_rms=((1e-6,) * 4,) * 3)
    x = samples_of(evidence)
    x[2] = x[2, 0] + 1e-3 * (x[2] - x[2, 0])
    found, is_usable = columns_of(evidence, x)
    assert bool(is_usable.all())
    expected, _ = oracle(evidence, x.numpy())
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)
    without, _ = oracle(evidence, x.numpy(), {2})
    assert (np.abs(found.numpy() - without) > 1e-3).any(1).all()
    silent = replace(evidence, least_rms=((1e-6,) * 4, (1.0,) * 4, (1e-6,) * 4))
    np.testing.assert_allclose(columns_of(silent, x)[0], without, rtol=0, atol=1e-6)


# The classifier, whole and in pieces -------------------------------------------------------------


def classifier_of(evidence, seed=1, *, linear=False):
    columns = columns_of(evidence, samples_of(evidence, seed=3))[0]
    rng = np.random.default_rng(seed)
    num = evidence.num_columns
    bend = torch.from_numpy(rng.standard_normal((0, 0) if linear else (num, num)))
    line, constant = torch.from_numpy(rng.standard_normal(num)), torch.tensor(0.5).double()
    head = QuadraticForm(bend + bend.T, line, constant)
    return OnsetClassifier(evidence, FeatureScaler.fit(columns, tail=0.01), head, 1.5, 0.02)


CLASSIFIER = classifier_of(evidence_of(hop=9))
SAMPLES = samples_of(CLASSIFIER.evidence, 2.0, seed=7)
SAMPLES[1, 3100] = torch.nan


BACKENDS = ["torch", *([] if reason_unavailable() else ["native"])]


def in_pieces(stream, samples, cuts, masked=None):
    places = [0, *sorted(cuts), samples.shape[-1]]
    return torch.cat([stream.push(samples[:, a:b], masked) for a, b in pairwise(places)])


@given(
    cuts=st.lists(st.integers(0, 4000), max_size=25),
    dtype=st.sampled_from(["float", "double"]),
    backend=st.sampled_from(BACKENDS),
)
def test_any_cut_gives_the_scores_of_the_recording(cuts, dtype, backend):
    samples = getattr(SAMPLES, dtype)()
    found = in_pieces(OnsetStream(CLASSIFIER, backend=backend), samples, cuts)
    torch.testing.assert_close(found, CLASSIFIER.score_recording(samples), rtol=0, atol=1e-8)


def scored_without_lost_blocks(classifier, samples, masked, most):
    """The classifier on the blocks that are known, as if the others had not been."""
    evidence = classifier.evidence
    power, mean, moves = evidence.blocks_of_recording(samples)
    first = samples.shape[-1] // evidence.hop_samples - power.shape[-1]
    listened = [not masked[c] for c in evidence.hand.fast]
    silence = evidence.silence.T[..., None]  # [F, B, 1]
    is_loud = (power.log() / 2 > silence).any(1) & moves | silence.isinf().all(1)
    alive = power.isfinite().all(1) & is_loud
    is_lost = alive[listened].sum(0) < evidence.min_alive
    found = torch.full((first + len(is_lost),), NOTHING_YET, dtype=torch.float64)
    known, scores, num_lost = [], [math.nan, math.nan], 0
    for block in range(len(is_lost)):
        num_lost += int(is_lost[block])
        if is_lost[block]:
            continue
        known = [] if num_lost > most else known
        num_lost = 0
        known = [*known, block][-evidence.memory :]
        score = math.nan
        if len(known) == evidence.memory:
            own = Blocks(power[..., known], mean[..., known])
            score = float(classifier.score(own, masked))
        scores = [*scores[-2:], score]
        found[first + block] = np.nan_to_num(np.mean(scores), nan=NOTHING_YET)
    return found


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(
    ("kinds", "changes"),
    [
        ("GFFGFG", {"min_alive": 3}),
        ("GFFGFG", {"least_rms": ((2.0,) * 4, (0.05,) * 4, (0.0,) * 4)}),
        ("FGF", {}),
        ("FF", {"min_alive": 2}),
        ("F", {}),
    ],
    ids=str,
)
def test_backends_agree_on_any_hand_with_channels_lost(kinds, changes, backend):
    classifier = classifier_of(evidence_of(kinds, comb_periods=4), linear=kinds == "FF")
    classifier = replace(classifier, evidence=replace(classifier.evidence, **changes))
    samples = samples_of(classifier.evidence, 4.0, seed=4)
    samples[-1, 2500], samples[0, 5000:] = torch.inf, 1.5
    samples[1 % len(kinds) :, 2900 : 2900 + 800] = torch.nan  # longer than the hold
    for masked in (torch.zeros(len(kinds)).bool(), torch.arange(len(kinds)) == len(kinds) - 1):
        for hold in (500, 2000):
            stream = OnsetStream(classifier, hold, backend)
            found = in_pieces(stream, samples.T.clone().T, [7, 3103, 5001], masked)
            most = -(-(classifier.evidence.context + 10 + hold) // 10)
            expected = scored_without_lost_blocks(classifier, samples, masked, most)
            torch.testing.assert_close(found, expected, rtol=0, atol=1e-8)
        is_deaf = kinds in ("F", "FF") and bool(masked.any())
        assert bool((found > NOTHING_YET).any()) != is_deaf


# As plain data, and what is refused --------------------------------------------------------------


def settings_with(classifier):
    return AlarmSettings(50, Platt(1.0, 0.0), KOfN(1, 1), 1.0, None, onset=classifier)


@pytest.mark.parametrize("linear", [False, True])
def test_survives_json(linear):
    made = classifier_of(evidence_of(comb_periods=4, mains_hz=60.0), linear=linear)
    settings = settings_with(made)
    plain = json.loads(json.dumps(settings.to_dict(), allow_nan=False))
    read = AlarmSettings.from_dict(plain, made.evidence.hand, RATE)
    assert read.onset is not None
    assert read.to_dict() == settings.to_dict()
    assert (read.decision_samples, read.onset.evidence.sample_rate_hz) == (10, RATE)
    x = samples_of(made.evidence)
    assert torch.equal(read.onset.score_recording(x), made.score_recording(x))


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_head_in_factors_scores_and_survives_json_as_the_form_it_is(backend):
    made = CLASSIFIER
    factors, signs = made.head.quadratic[:3], torch.tensor([1.0, -1.0, 1.0])
    head = QuadraticForm(factors, made.head.linear, made.head.constant, signs)
    dense = QuadraticForm(head.matrix, head.linear, head.constant)
    in_factors, whole = replace(made, head=head), replace(made, head=dense)
    plain = json.loads(json.dumps(in_factors.to_dict()))
    read = OnsetClassifier.from_dict(plain, made.evidence.hand, RATE)
    expected = whole.score_recording(SAMPLES)
    for one in (in_factors, read):
        found = OnsetStream(one, backend=backend).push(SAMPLES)
        torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9)


def kept(change, hand=HAND):
    """Settings with the classifier after a round to plain data that is changed on the way."""
    plain = settings_with(CLASSIFIER).to_dict()
    change(plain["onset"])
    return AlarmSettings.from_dict(plain, hand, RATE)


BAD_SETTINGS = [
    (lambda: evidence_of("GG"), "needs fast channels, and this hand has none; take onset=deb"),
    (lambda: evidence_of(hop=0), "at least every 5 ms, got 0 samples .* at 2000 Hz"),
    (lambda: evidence_of(fast_compression=(1.0,) * 3), "expected 10 positive and finite scales"),
    (lambda: kept(dict, hand_of("F")), "expected 12 columns of evidence, got 72"),
    (lambda: kept(lambda plain: plain.update(quadratic=[[1.0]])), "part of 72 columns, got 1"),
    (lambda: kept(lambda plain: plain.pop("mains_hz")), "of this version: 'mains_hz'"),
]


@pytest.mark.parametrize(("make", "message"), BAD_SETTINGS)
def test_bad_settings_are_refused_in_one_line(make, message):
    with pytest.raises(ValueError, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)


FILMS = HandLayout.paper24().indices("PVDF")
SCORES = {"fast_band_power": fast_band_power, "largest_detail": largest_detail}


def band_rms(x, rate=2000.0):
    """Root mean square of what is left of a bin if all lines outside the band are taken out."""
    lines, hz = np.fft.rfft(x), np.fft.rfftfreq(len(x), 1 / rate)
    lines[(hz < VIBRATION_HZ[0]) | (hz > VIBRATION_HZ[1]) | (hz == 0)] = 0
    return np.sqrt(np.mean(np.fft.irfft(lines, len(x)) ** 2))


# ------------------------------------------------------------------------------------ the values


@pytest.mark.parametrize("num", [99, 128])
@pytest.mark.parametrize("rate", [2000.0, 700.0])
def test_band_power_is_numpys_for_bins_of_any_length_and_rate(num, rate, rng):
    """At 700 Hz up to half the rate, where an even bin has a line that is no pair."""
    bins = 0.2 + rng.standard_normal((3, 2, num))
    expected = [np.log(max(band_rms(x, rate) for x in bin_)) for bin_ in bins]
    actual = fast_band_power(torch.from_numpy(bins), [0, 1], rate)
    np.testing.assert_allclose(actual, expected, atol=1e-10)


def test_the_largest_detail_is_pywavelets(rng):
    bins = plausible_bins(rng, 6)
    details = [[np.abs(wavelet_branches(x)[1::2]).max() for x in bin_[14:]] for bin_ in bins]
    actual = largest_detail(torch.from_numpy(bins), FILMS)
    np.testing.assert_allclose(actual, np.log(np.max(details, axis=1)), atol=1e-10)


# --------------------------------------------------------------------------------- in the harness
def baseline(name, hand=HAND):
    lengths = [{"SG": 51, "PVDF": 11}[channel.kind] for channel in hand.channels]
    return BaselineDetector(name, FeaturePool(hand), ChannelFilter(lengths))


@pytest.mark.parametrize("name", SCORES)
def test_a_baseline_scores_filtered_bins(name, rng):
    detector = baseline(name)
    films = list(HAND.indices("PVDF"))
    assert detector.needed_index.tolist() == films
    assert detector.look_ahead == 5  # half the films' frame, not the gauges' 25
    samples = raw_bins(20)
    score, is_valid, in_range, is_lost, span = detector.predict_raw(samples)
    assert torch.equal(score, SCORES[name](ChannelFilter([51, 51, 11, 11]).valid(samples), films))
    assert (is_valid & in_range).all()
    assert not is_lost.any()
    filtered = ChannelFilter([51, 51, 11, 11]).valid(samples)[:, films]
    assert torch.equal(span[:, films], filtered.amax(-1) - filtered.amin(-1))
    assert span[:, :2].isnan().all()
    in_32 = detector.predict_raw(samples, given=torch.float32)
    assert in_32.score.dtype == torch.float32
    torch.testing.assert_close(in_32.score.double(), score, rtol=0, atol=1e-4)


@pytest.mark.parametrize("name", SCORES)
def test_a_lost_film_counts_as_silent_and_without_films_there_is_no_score(name):
    detector = baseline(name)
    samples = raw_bins(5)
    whole = detector.predict_raw(samples)
    samples[1, 2, 60] = torch.nan  # a film
    samples[2, 0, 60] = torch.inf  # a gauge, which no score depends on
    samples[3, 3] = 0.1  # a dead film
    samples[4] = torch.nan
    found = detector.predict_raw(samples)
    assert found.is_valid.tolist() == found.in_range.tolist() == [True, True, True, True, False]
    assert torch.equal(found.score.isfinite(), found.is_valid)
    assert found.channels_lost.sum(-1).tolist() == [0, 1, 0, 1, 2]
    filtered = ChannelFilter([51, 51, 11, 11]).valid(samples)
    for row, film in ((1, 3), (3, 2)):
        other = SCORES[name](filtered[row : row + 1], [film])
        torch.testing.assert_close(found.score[row : row + 1], other)
    torch.testing.assert_close(found.score[[0, 2]], whole.score[[0, 2]])


NO_BASELINE = [
    (lambda x: fast_band_power(x, []), "of fast channels needs one"),
    (lambda x: fast_band_power(x, [0], 8.0), "no line of 100 samples"),
    (lambda x: baseline("loudest"), r"baseline must be one of fast.*got 'loudest'"),
    (
        lambda x: baseline("largest_detail", HandLayout(HAND.channels[:2])),
        "of fast channels needs one",
    ),
    (lambda x: baseline("largest_detail").predict_raw(x), "expected samples"),
]


@pytest.mark.parametrize(("call", "message"), NO_BASELINE)
def test_what_is_no_baseline_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call(torch.randn(2, 3, 100))


TRAINING_HZ = 1000.0


def ms(*spans):
    return [t for first, last in spans for t in range(first, last + 1, 5)]


def test_hops_are_learned_as_what_they_are():
    """Edges lie 1 ms off the ends of hops."""
    times = SmallTimeline(
        onsets_s=(1.021, 1.651),
        released_s=((1.001, 1.07), (1.651, 1.66)),
        sliding_s=((1.021, 1.501), (1.651, 1.801)),
        non_slip_s=((0.201, 0.401),),
        slip_s=((2.001, 2.201),),
    )
    expected = {
        "onset paper": ms((1025, 1050), (1655, 1680)),  # 2 to 30 ms behind
        "before": ms((705, 1000), (1605, 1650)),  # 300 ms, but not what is still sliding or unclear
        "slide": ms((1125, 1500), (1755, 1800)),  # from 100 ms on
        "handled paper": ms((205, 400)),
        # unclear: until 100 ms behind onset, slide and slip
        "rest paper": ms((5, 200), (405, 700), (1905, 2000), (2305, 2400)),
    }
    at = np.arange(5, 2401, 5)
    found = kinds_of(times, at / 1000, "paper")
    assert {kind: at[mask].tolist() for kind, mask in found.items()} == expected
    of_onsets = SmallTimeline(onsets_s=(1.021,), sliding_s=((1.021, 1.5),))
    found = kinds_of(of_onsets, at / 1000, "x")
    assert at[found["before"]].tolist() == ms((725, 1020))
    assert at[found["onset x"]].tolist() == ms((1025, 1050))


class Bursts(SmallSet):
    """Noise; on paper a burst at the onset and a little more in the slide, else a knock."""

    sample_rate_hz = TRAINING_HZ

    def __init__(self, materials="abc", cycles=3, burst=4.0):
        super().__init__(materials, cycles)
        self.ids += tuple(replace(recording, scene="taps") for recording in self.ids)
        self.materials, self.burst = materials, burst

    def timeline(self, recording):
        if recording.scene == "taps":
            return SmallTimeline(onsets_s=(), sliding_s=(), non_slip_s=((1.3, 1.4),))
        onset_s = 1.3 + 0.05 * recording.cycle
        return SmallTimeline(onsets_s=(onset_s,), sliding_s=((onset_s, 1.95),))

    def load(self, recording, windows=None):
        times = self.timeline(recording)
        generator = torch.Generator().manual_seed(sum(str(recording).encode()) * 7919)
        noise = torch.randn(2, 2000, generator=generator)
        for start_s, end_s in times.sliding_s:
            onset = round(start_s * TRAINING_HZ)
            noise[:, onset : round(end_s * TRAINING_HZ)] *= 1.3
            noise[:, onset : onset + 40] *= self.burst + 0.2 * ord(recording.material) % 1
        if times.non_slip_s:
            noise[:, 1310:1312] *= 2.5 * self.burst
        truth = (20.0,) * len(times.onsets_s), times.onsets_s, times.sliding_s
        return Recording(noise, TRAINING_HZ, recording.material, *truth)


def fitted(source, ids=None, **numbers):
    ids = source.ids if ids is None else ids
    return OnsetTraining(penalty=1e3, **numbers)(source, ids, num_workers=0)


def hops_of(source, evidence, most=10**6, likeness=None, without=()):
    """Columns and kinds of hops at even places, and 60 of each recording by likeness."""
    columns, kinds = [], []
    for recording in (one for one in source.ids if one.material not in without):
        found, _ = columns_of(evidence, source.load(recording).samples)
        number = evidence.first_hop + 1 + np.arange(len(found))
        ends_s = number * evidence.hop_samples / TRAINING_HZ
        for kind, mask in kinds_of(source.timeline(recording), ends_s, recording.scene).items():
            own = found[torch.from_numpy(mask)]
            if likeness and not kind.startswith("onset"):
                columns.append(own[likeness(own).argsort(descending=True, stable=True)][:60])
                kinds += [f"like {kind}"] * len(columns[-1])
            own = own[np.linspace(0, len(own) - 1, most).astype(int)] if len(own) > most else own
            columns.append(own)
            kinds += [kind] * len(own)
    return torch.cat(columns), np.array(kinds)


def kernel_ridge(columns, kinds):
    """Scores of a machine on hops, whose kinds weigh alike."""
    scaler = FeatureScaler.fit(columns, tail=0.001)
    z, is_onset = scaler(columns).numpy(), np.char.startswith(kinds, "onset")
    weight = np.zeros(len(z))
    for mask in (is_onset, ~is_onset):
        for kind in (of_mask := set(kinds[mask])):
            weight[kinds == kind] = 0.5 / len(of_mask) / (kinds == kind).sum()  # of all: 1
    system = (0.5 + z @ z.T) ** 2 + np.diag(1 / (1e3 * weight))
    beta = np.linalg.solve(system, np.where(is_onset, 1.0, -1.0))
    return lambda hops: torch.from_numpy((0.5 + scaler(hops).numpy() @ z.T) ** 2 @ beta)


@pytest.mark.slow
def test_the_machine_is_kernel_ridge_on_hops_that_a_first_machine_finds_most_like_a_slip():
    source = Bursts(burst=2.0)
    classifier, left_out, counts = fitted(source)
    evidence = classifier.evidence
    first = kernel_ridge(*hops_of(source, evidence, 100))
    fresh, _ = hops_of(Bursts("d"), evidence)
    for without, own in {(): classifier, **left_out}.items():
        columns, kinds = hops_of(source, evidence, 20, first, without)
        score = own.head(own.scaler(fresh))
        expected = kernel_ridge(columns, kinds)(fresh)
        torch.testing.assert_close(score, expected, rtol=1e-6, atol=1e-6)
        if not without:
            assert counts == {kind: int((kinds == kind).sum()) for kind in dict.fromkeys(kinds)}
    assert set(left_out) == set(source.materials)
    assert classifier.threshold == float("inf")


def test_scales_are_a_tenth_of_the_usual_power_and_the_usual_step():
    source = Bursts(cycles=2)
    evidence = fitted(source, comb_periods=2)[0].evidence
    assert evidence.comb_periods == 2
    plain = type(evidence)(source.hand, TRAINING_HZ, 5, comb_periods=2)
    blocks = [plain.blocks_of_recording(source.load(r).samples) for r in source.ids]
    fast = np.median([np.median(own.power[0].sqrt(), -1) for own in blocks], 0)
    assert evidence.fast_compression == pytest.approx(0.1 * fast, rel=0.02)
    means = [own.mean[0, 96:].numpy() for own in blocks]  # the longest step takes 100 blocks
    steps = [np.median(np.abs(m[3:] + m[2:-1] - m[1:-2] - m[:-3])) / 2 for m in means]
    assert evidence.slow_compression[0] == pytest.approx(np.median(steps), rel=0.02)


NOTHING_TO_LEARN = [
    ("taps", {}, "no slip begins in the recordings that onsets are learned from"),
    ("none", {}, "no recording is left to learn onsets from; give onset.streams"),
    ("paper", {"hop_ms": 5.6}, "at least every 5 ms, got 6 samples .* at 1000 Hz"),
]


@pytest.mark.parametrize(("scene", "numbers", "match"), NOTHING_TO_LEARN)
def test_what_nothing_can_be_learned_from_is_refused_in_one_line(scene, numbers, match):
    source = Bursts()
    with pytest.raises(ValueError, match=match) as caught:
        fitted(source, [r for r in source.ids if r.scene == scene], **numbers)
    assert "\n" not in str(caught.value)

"""Evidence of onsets against plain loops over the definition; a stream of it in any pieces."""

import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tactslip_torch.hand import Channel, HandLayout
from tactslip_torch.model.calibration import Platt
from tactslip_torch.model.kernels import QuadraticForm
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.native import why_not
from tactslip_torch.onset.decisions import AlarmSettings
from tactslip_torch.onset.evidence import OnsetClassifier, OnsetEvidence, OnsetStream
from tactslip_torch.onset.rules import NOTHING_YET, KOfN

RATE = 2000.0
FAST_KNEE, SLOW_KNEE = (0.01, 0.02, 0.03, 0.04), (0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
KNEES = {"fast_knee": FAST_KNEE, "slow_knee": SLOW_KNEE}


def hand_of(kinds="SFFSFS"):
    names = {"S": "SG", "F": "PVDF"}
    rows = [Channel(f"{names[k]}{i}", names[k], "index", "distal") for i, k in enumerate(kinds)]
    return HandLayout(tuple(rows))


def evidence_of(kinds="SFFSFS", rate=RATE, hop=10, **changes):
    return OnsetEvidence(hand_of(kinds), rate, hop, **(KNEES | changes))


def samples_of(evidence, seconds=1.5, seed=0):
    """Noise whose size differs from channel to channel and from hop to hop, on offsets."""
    rng = np.random.default_rng(seed)
    num = round(seconds * evidence.sample_rate_hz)
    loud = np.repeat(rng.uniform(0.1, 3.0, (len(evidence.hand), -(-num // 50))), 50, 1)[:, :num]
    return torch.from_numpy(
        loud * rng.standard_normal(loud.shape) + rng.normal(size=(len(loud), 1))
    )


# The definition ----------------------------------------------------------------------------------


def haar(x, seconds, rate):
    """The mean of the latest samples minus that of as many before."""
    width = max(1, round(seconds * rate))
    return np.convolve(x, np.repeat([1.0, -1.0], width) / width)[: len(x)]


def filtered(x, rate, mains, periods):
    t = np.arange(len(x))
    ago = [np.interp(t - n * rate / mains, t, x) for n in range(1, periods + 1)]
    return np.stack(
        [
            *(haar(x, seconds, rate) for seconds in (0.0005, 0.002, 0.004)),
            haar(x - np.mean(ago, 0), 0.001, rate),
        ]
    )


def oracle(evidence, x, masked=()):
    """Columns of every hop that has its second, by loops; and the number of the first."""
    rate, hop = evidence.sample_rate_hz, evidence.hop_samples

    def blocks(seconds):
        return int(np.ceil(np.round(seconds * rate) / hop))

    def cut(y):
        num = y.shape[-1] // hop
        return y[..., : num * hop].reshape(*y.shape[:-1], num, hop)

    fast = [c for c, one in enumerate(evidence.hand.channels) if one.kind == "PVDF"]
    slow = [c for c, one in enumerate(evidence.hand.channels) if one.kind == "SG"]
    mains = evidence.mains_hz, evidence.comb_periods
    heard = np.stack([filtered(x[c], rate, *mains) for c in fast])
    power = (cut(heard) ** 2).mean(-1) + np.square(evidence.fast_knee)[:, None]  # [F, B, blocks]
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
        for lengths, knee in zip([*steps_s, (100, 100, 400)], evidence.slow_knee, strict=True):
            late, early, back = (blocks(ms / 1000) for ms in lengths)
            latest = mean[:, b + 1 - late : b + 1].mean(-1)
            other = mean[:, b + 1 - back - early : b + 1 - back].mean(-1)
            step.append(np.log(np.abs(latest - other) + knee))
            way.append(np.sign(latest - other) * np.log1p(np.abs(latest - other) / knee))
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
    "evidence",
    [
        evidence_of(),
        evidence_of(hop=7, comb_periods=4, mains_hz=60.0),
        evidence_of("FSF", rate=500.0, hop=2, mains_hz=60.0),
        evidence_of("F", rate=1300.0, hop=1),
    ],
    ids=["usual", "60 Hz", "500 Hz", "one channel"],
)
def test_columns_are_those_of_the_definition(evidence):
    x = samples_of(evidence, 1.3)
    found, is_usable = columns_of(evidence, x)
    expected, first = oracle(evidence, x.numpy())
    assert evidence.first_hop == first
    assert found.shape == (len(x[0]) // evidence.hop_samples - first, evidence.num_columns)
    assert bool(is_usable.all())
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10)


@pytest.mark.parametrize("periods", [1, 4])
def test_no_harmonic_of_the_mains_passes_the_comb(periods):
    t = np.arange(4000) / RATE
    for mains in (50.0, 60.0):
        evidence = evidence_of("F", comb_periods=periods, mains_hz=mains, fast_knee=(1e-12,) * 4)
        for harmonic in range(1, int(450 / mains) + 1):
            tone = np.sin(2 * np.pi * mains * harmonic * t + 0.3)
            power = evidence.blocks(torch.from_numpy(tone)[None]).power[0, 3]
            gain = float((power.mean() / np.mean(haar(tone, 0.001, RATE)[10:] ** 2)).sqrt())
            # a fraction p of a sample is interpolated: 1 - p - p exp(-iw), times exp(ipw)
            w, parts = 2 * np.pi * mains * harmonic / RATE, RATE / mains * np.arange(1, periods + 1)
            gains = [(1 - p + p * np.exp(-1j * w)) * np.exp(1j * p * w) for p in parts % 1]
            assert gain == pytest.approx(abs(1 - np.mean(gains)), rel=0.02, abs=1e-9)
            assert gain < (1e-9 if mains == 50 else 0.005 * harmonic**2)
        between = torch.from_numpy(np.sin(2 * np.pi * 1.5 * mains * t))[None]
        assert float(evidence.blocks(between).power[0, 3].mean()) > 1e-3


def test_scale_moves_sizes_of_steps_alone():
    evidence = evidence_of()
    x, num = samples_of(evidence), 3 * 4 * 3
    larger = replace(evidence, **{name: tuple(3 * k for k in own) for name, own in KNEES.items()})
    before, after = columns_of(evidence, x)[0], columns_of(larger, 3 * x)[0]
    torch.testing.assert_close(after[:, :num], before[:, :num], rtol=0, atol=1e-10)
    sizes, ways = slice(num, num + 18), slice(num + 18, None)
    moved = before[:, sizes] + np.log(3.0)
    torch.testing.assert_close(after[:, sizes], moved, rtol=0, atol=1e-10)
    torch.testing.assert_close(after[:, ways], before[:, ways], rtol=0, atol=1e-10)


def test_an_offset_changes_nothing():
    x = samples_of(evidence_of())
    before, after = columns_of(evidence_of(), x)[0], columns_of(evidence_of(), x + 1e6)[0]
    torch.testing.assert_close(after, before, rtol=0, atol=1e-6)


# Channels that are left out ----------------------------------------------------------------------


@pytest.mark.parametrize("channel", [0, 2])
def test_a_masked_channel_is_as_if_it_were_not_there(channel):
    evidence, rest = evidence_of(), [c for c in range(6) if c != channel]
    x = samples_of(evidence)
    without = evidence_of("".join("SFFSFS"[c] for c in rest))
    found, _ = columns_of(evidence, x, torch.arange(6) == channel)
    torch.testing.assert_close(found, columns_of(without, x[rest])[0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(found, oracle(evidence, x.numpy(), {channel})[0], atol=1e-10)


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


def test_a_silent_fast_channel_is_left_out_and_none_at_all_is_told():
    evidence = evidence_of()
    x = samples_of(evidence)
    x[4] = 2.5
    found, is_usable = columns_of(evidence, x)
    np.testing.assert_allclose(found, oracle(evidence, x.numpy(), {4})[0], atol=1e-10)
    assert bool(is_usable.all())
    x[1], x[2, 1500] = 0.0, torch.nan
    assert not bool(columns_of(evidence, x)[1].any())
    score = classifier_of(evidence).score_recording(x)
    assert score.tolist() == [NOTHING_YET] * 300


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


BACKENDS = ["torch", *([] if why_not() else ["native"])]


def in_pieces(stream, samples, cuts, masked=None):
    places = [0, *sorted(cuts), samples.shape[-1]]
    return torch.cat([stream.push(samples[:, a:b], masked) for a, b in pairwise(places)])


def test_a_score_is_that_of_the_machine_on_scaled_columns():
    evidence, first = CLASSIFIER.evidence, CLASSIFIER.evidence.first_hop
    score = CLASSIFIER.score_recording(SAMPLES)
    z = CLASSIFIER.scaler(columns_of(evidence, SAMPLES)[0]).numpy()
    head = CLASSIFIER.head
    expected = np.einsum("ki,ij,kj->k", z, head.quadratic, z) + z @ head.linear.numpy() + 0.5
    assert len(score) == 4000 // 9
    assert score[: first + 2].tolist() == [NOTHING_YET] * (first + 2)
    mean = [np.mean(expected[i - 2 : i + 1]) for i in range(2, len(expected))]
    np.testing.assert_allclose(score[first + 2 :], mean, rtol=1e-10, atol=1e-10)


@given(
    cuts=st.lists(st.integers(0, 4000), max_size=25),
    dtype=st.sampled_from(["float", "double"]),
    backend=st.sampled_from(BACKENDS),
)
def test_any_cut_gives_the_scores_of_the_recording(cuts, dtype, backend):
    samples = getattr(SAMPLES, dtype)()
    found = in_pieces(OnsetStream(CLASSIFIER, backend), samples, cuts)
    torch.testing.assert_close(found, CLASSIFIER.score_recording(samples), rtol=0, atol=1e-8)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("kinds", ["SFFSFS", "FSF", "FF", "F"])
def test_backends_agree_on_any_hand_with_channels_missing(kinds, backend):
    classifier = classifier_of(evidence_of(kinds, comb_periods=4), linear=kinds == "FF")
    samples, evidence = samples_of(classifier.evidence, 3.0, seed=4), classifier.evidence
    samples[-1, 2500], samples[0, 4000:] = torch.inf, 1.5
    for masked in (None, torch.arange(len(kinds)) == len(kinds) - 1):
        found = in_pieces(OnsetStream(classifier, backend), samples.T.clone().T, [7, 4001], masked)
        alone = torch.full((600 + 2,), torch.nan, dtype=torch.float64)
        alone[evidence.first_hop + 2 :] = classifier.score(
            evidence.blocks_of_recording(samples), masked
        )
        expected = alone.unfold(0, 3, 1).mean(-1).nan_to_num(NOTHING_YET)
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-8)
        assert (kinds == "F" and masked is not None) or (found > NOTHING_YET).any()


@pytest.mark.parametrize("size", [9, 50, 63])
def test_memory_does_not_grow(size):
    stream, held = OnsetStream(CLASSIFIER), []
    for start in range(0, 40_000, size):
        stream.push(samples_of(CLASSIFIER.evidence, size / RATE, seed=start))
        held.append(stream.state_bytes)
    assert max(held[: len(held) // 4]) == max(held[len(held) // 4 :]) > 0


# As plain data, and what is refused --------------------------------------------------------------


@pytest.mark.parametrize("linear", [False, True])
def test_survives_json(linear):
    made = classifier_of(evidence_of(comb_periods=4, mains_hz=60.0), linear=linear)
    settings = AlarmSettings(50, Platt(1.0, 0.0), KOfN(1, 1), 1.0, None, onset=made)
    plain = json.loads(json.dumps(settings.to_dict(), allow_nan=False))
    read = AlarmSettings.from_dict(plain, made.evidence.hand, RATE)
    assert read.onset is not None
    assert read.to_dict() == settings.to_dict()
    assert (read.decision_samples, read.onset.evidence.sample_rate_hz) == (10, RATE)
    x = samples_of(made.evidence)
    assert torch.equal(read.onset.score_recording(x), made.score_recording(x))


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"kinds": "SS"}, "needs fast channels, and this hand has none; take onset=debounced"),
        ({"hop": 0}, "a hop of 0 samples at 2000 Hz is no hop of at most 5 ms"),
        ({"hop": 11}, "a hop of 11 samples"),
        ({"fast_knee": (1.0,) * 3}, "expected 10 positive and finite knees"),
        ({"fast_knee": (1.0, 0.0, 1.0, 1.0)}, "expected 10 positive and finite knees"),
        ({"slow_knee": (1.0,) * 5 + (float("inf"),)}, "expected 10 positive and finite knees"),
    ],
)
def test_bad_settings_are_refused_in_one_line(changes, match):
    with pytest.raises(ValueError, match=match) as caught:
        evidence_of(**changes)
    assert "\n" not in str(caught.value)


def test_a_classifier_of_another_hand_or_version_is_refused():
    settings = AlarmSettings(50, Platt(1.0, 0.0), KOfN(1, 1), 1.0, None, onset=CLASSIFIER)
    with pytest.raises(ValueError, match="expected 12 columns of evidence, got 72"):
        AlarmSettings.from_dict(settings.to_dict(), hand_of("F"), RATE)
    plain = settings.to_dict()
    del plain["onset"]["mains_hz"]
    with pytest.raises(ValueError, match="no alarm settings of this version: 'mains_hz'"):
        AlarmSettings.from_dict(plain, CLASSIFIER.evidence.hand, RATE)


# Gradients ---------------------------------------------------------------------------------------


def test_gradients_are_those_of_differences():
    evidence = evidence_of("SFFS", rate=200.0, hop=1)
    x = samples_of(evidence, 1.1)[:, -evidence.context - evidence.memory :].requires_grad_()
    assert torch.autograd.gradcheck(lambda x: columns_of(evidence, x)[0], (x,), fast_mode=True)


def test_gradients_are_finite_where_a_channel_is_silent():
    evidence = evidence_of("SFFS", **{name: (1e-30,) * len(own) for name, own in KNEES.items()})
    x = samples_of(evidence)
    x[2:] = 0.0
    (pull,) = torch.autograd.grad(columns_of(evidence, x.requires_grad_())[0].sum(), x)
    assert bool(pull.isfinite().all())
    assert bool((pull[:2, -200:] != 0).all())
    assert not bool(pull[2:].any())

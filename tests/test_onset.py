"""Evidence of slip against plain loops over the definition; a stream of it in any pieces."""

import json
import math
from dataclasses import replace
from itertools import combinations, pairwise

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from small_set import SmallSet, SmallTimeline
from streams import hand_of

from tactslip_torch.data.recording import Recording
from tactslip_torch.model.calibration import Platt
from tactslip_torch.model.kernels import QuadraticForm
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.native import reason_unavailable
from tactslip_torch.onset.decisions import AlarmSettings
from tactslip_torch.onset.evidence import OnsetClassifier, OnsetEvidence, OnsetStream, Perceptron
from tactslip_torch.onset.rules import NOTHING_YET, KOfN
from tactslip_torch.training.onset import (
    OnsetTraining,
    _Batches,
    _columns_of,
    _Hops,
    _labels_of,
    _weights,
)

RATE = 2000.0
STEP = 1e-3


def evidence_of(kinds="GFFGFG", rate=RATE, hop=10, **changes):
    resolution = {"resolution": (STEP,) * len(kinds)}
    return OnsetEvidence(hand_of(kinds), rate, hop, **(resolution | changes))


def samples_of(evidence, seconds=1.5, seed=0):
    """Noise whose size differs from channel to channel and from hop to hop, on offsets."""
    rng = np.random.default_rng(seed)
    num = round(seconds * evidence.sample_rate_hz)
    loud = np.repeat(rng.uniform(0.1, 3.0, (len(evidence.hand), -(-num // 50))), 50, 1)[:, :num]
    offsets = rng.normal(size=(len(loud), 1))
    return torch.from_numpy(loud * rng.standard_normal(loud.shape) + offsets)


# The definition ----------------------------------------------------------------------------------


def haar(x, seconds, rate, least=1):
    """The mean of the latest samples minus that of as many before."""
    width = max(least, round(seconds * rate))
    return np.convolve(x, np.repeat([1.0, -1.0], width) / width)[: len(x)]


def filtered(x, rate, mains, periods):
    t = np.arange(len(x))
    rows = [haar(x, *of, rate, least) for *of, least in ((0.0005, 1), (0.002, 2), (0.004, 4))]
    if rate >= 4 * mains:
        ago = [np.interp(t - n * rate / mains, t, x) for n in range(1, periods + 1)]
        rows.append(haar(x - np.mean(ago, 0), 0.001, rate))
    return np.stack(rows)


def recursive(values, delay, length):
    """Means of values so many blocks ago, the first one before there are as many."""
    floor, found = values[0], []
    for t in range(len(values)):
        share = max(1 / max(t + 1 - delay, 1), 2 / (length + 1))
        floor = floor + share * (values[max(t - delay, 0)] - floor)
        found.append(floor)
    return np.array(found)


def pools(values, kinds):
    """Statistics of rows over channels."""
    if values.shape[-1] == 1:
        return [values[..., 0]]
    every = {"mean": np.mean, "max": np.max, "min": np.min, "std": np.std}
    return [every[kind](values, -1) for kind in kinds]


def oracle(evidence, x, masked=()):
    """Columns of every block that has its context, by loops over blocks; x ``[C, T]``."""
    rate, hop, hand = evidence.sample_rate_hz, evidence.hop_samples, evidence.hand
    fast = [c for c in hand.fast if c not in masked]
    slow = [c for c in hand.slow if c not in masked]

    def blocks(seconds):
        return max(1, int(np.ceil(np.round(seconds * rate) / hop)))

    def cut(y, first):
        num = y.shape[-1] // hop
        return y[..., : num * hop].reshape(*y.shape[:-1], num, hop)[..., first:, :]

    least = [-(-n // hop) for n in (4, 6, 8)]
    windows = [max(blocks(s), n) for s, n in zip((0.01, 0.025, 0.05), least, strict=True)]
    delay = windows[-1]
    reach = 0
    if hand.fast:
        widths = [max(n, round(s * rate)) for s, n in ((0.0005, 1), (0.002, 2), (0.004, 4))]
        reach = 2 * max(widths) - 1
        if rate >= 4 * evidence.mains_hz:
            of_comb = int(np.ceil(evidence.comb_periods * rate / evidence.mains_hz))
            reach = max(reach, of_comb + 2 * max(1, round(0.001 * rate)) - 1)
    first = -(-reach // hop)
    steps_s = [(10, 10, 10), (25, 25, 25), (25, 50, 50), (50, 100, 100), (50, 50, 200)]
    steps_s += [(100, 100, 400), (200, 200, 600)]
    lengths = list(dict.fromkeys(tuple(blocks(ms / 1000) for ms in step) for step in steps_s))
    mean = cut(x[slow], first).mean(-1)  # [S, m]
    num = mean.shape[-1] if slow else cut(x[:1], first).shape[-2]

    def before(y, length, back, at):
        """Mean of so many values that end so many before; those before the first equal it."""
        places = np.arange(at - back - length + 1, at - back + 1)
        return y[..., np.maximum(places, 0)].mean(-1)

    step = np.array(
        [
            [
                before(mean, late, 0, t) - before(mean, early, back, t)
                for late, early, back in lengths
            ]
            for t in range(num)
        ]
    ).reshape(num, len(lengths), len(slow))
    usual = recursive(np.abs(step), delay, max(blocks(1.0), 3 * delay))
    z = step / (usual + STEP / 3)
    if fast:
        y = np.stack([filtered(x[c], rate, evidence.mains_hz, evidence.comb_periods) for c in fast])
        y = cut(y, first)  # [F, B, m, hop]
        gains = np.square(evidence.filters).sum(1)[:, None] * STEP**2 / 12
        power = (y**2).mean(-1) + gains  # [F, B, m]
        half_logs = np.log(power).transpose(2, 1, 0) / 2
        spans = [max(blocks(s), math.ceil(n * delay)) for s, n in ((1, 3), (0.3, 1.5), (0.1, 0.75))]
        floors = [recursive(half_logs, delay, n) for n in spans]  # [m, B, F] each
    rows = []
    for t in range(num):
        row = []
        if fast:
            level = [np.log(before(power, n, 0, t)).T / 2 for n in windows]  # [B, F]
            rises = np.concatenate([each - floors[0][t] for each in level])
            row += pools(rises, ("mean", "max", "min", "std"))
            quick = [each - floor[t] for each in level[:2] for floor in floors[1:]]
            row += pools(np.concatenate(quick), ("mean", "max"))
            if len(hand.fast) > 1:
                squares = [
                    np.concatenate(
                        [
                            before((y[i] * y[j]).mean(-1), n, 0, t) ** 2
                            / (before(power[i], n, 0, t) * before(power[j], n, 0, t))
                            for n in windows
                        ]
                    )
                    for i, j in combinations(range(len(fast)), 2)
                ]
                risen = np.maximum(rises, 0)
                weights = [risen[:, i] * risen[:, j] for i, j in combinations(range(len(fast)), 2)]
                squares = squares or [np.zeros(len(rises))]
                weights = weights or squares
                by_rises = np.sum(np.multiply(weights, squares), 0) / (np.sum(weights, 0) + 1e-6)
                row += [np.mean(squares, 0), np.max(squares, 0), by_rises]
        if slow:
            size = np.log1p(np.abs(z[t]))
            row += pools(size, ("mean", "max", "min"))
            row += pools(np.sign(z[t]) * size, ("mean", "max", "min"))
            if len(hand.slow) > 1:
                row.append(z[t].sum(-1) / (np.abs(z[t]).sum(-1) + 1e-3))
        rows.append(np.concatenate(row))
    return np.array(rows)


def found_by(evidence, x, masked=()):
    in_use = torch.tensor([c not in masked for c in range(len(evidence.hand))])
    columns, is_usable, _ = evidence.columns(evidence.blocks_of_recording(x), None, in_use)
    return columns, is_usable


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"hop": 7, "comb_periods": 4, "mains_hz": 60.0},
        {"kinds": "FGF", "rate": 500.0, "hop": 2, "mains_hz": 60.0},
        {"kinds": "F", "rate": 1300.0, "hop": 1},
        {"kinds": "GG", "hop": 0},
        {"kinds": "GFF", "rate": 25.0, "hop": 0},
        {"kinds": "G", "rate": 10.0, "hop": 0},
    ],
    ids=str,
)
def test_columns_are_those_of_the_definition(changes):
    evidence = evidence_of(**changes)
    x = samples_of(evidence, 1.3 if evidence.sample_rate_hz > 100 else 12.0)
    found, is_usable = found_by(evidence, x)
    expected = oracle(evidence, x.numpy())  # whose first steps are rounding
    np.testing.assert_allclose(found[1:], expected[1:], rtol=0, atol=1e-9)
    assert found.shape[1] == evidence.num_columns
    first = evidence.first_hop - (x.shape[1] // evidence.hop_samples - len(found))
    assert is_usable.tolist() == [t >= first for t in range(len(found))]


@pytest.mark.parametrize("gain", [1e-3, 30.0])
def test_neither_gain_nor_offset_of_a_channel_matters(gain):
    evidence = evidence_of(resolution=(0.0,) * 6)
    x = samples_of(evidence)
    gains = torch.linspace(1.0, gain, 6).double()[:, None]
    found, _ = found_by(evidence, gains * x + 3.0)
    expected, _ = found_by(evidence, x)
    known = slice(evidence.blind, None)  # before, steps have nothing to be compared with
    torch.testing.assert_close(found[known], expected[known], rtol=0, atol=1e-6)


def test_a_low_rate_says_what_it_takes_away():
    assert evidence_of().limits() == ""
    slow = evidence_of(rate=25.0, hop=0)
    assert (slow.hop_samples, slow.windows, slow.has_comb) == (1, [4, 6, 8], False)
    words = slow.limits()
    assert words.startswith("at 25 Hz there is a decision every 40 ms, power over 160 ms")
    assert "no vibration above 12.5 Hz" in words
    assert "no filter for the mains" in words


def test_more_pairs_than_can_be_taken_are_thinned_out():
    few, many = evidence_of("F" * 6), evidence_of("F" * 40)
    assert few.pairs.T.tolist() == [list(pair) for pair in combinations(range(6), 2)]
    assert 60 < many.pairs.shape[1] <= 120
    assert len(set(many.pairs.flatten().tolist())) > 35


# Channels that are left out ----------------------------------------------------------------------


@pytest.mark.parametrize("channel", [0, 2])
def test_a_masked_channel_is_as_if_it_were_not_there(channel):
    evidence = evidence_of()
    x = samples_of(evidence, 1.0)
    found, _ = found_by(evidence, x, (channel,))
    expected = oracle(evidence, x.numpy(), (channel,))
    np.testing.assert_allclose(found[1:], expected[1:], rtol=0, atol=1e-9)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_fast_channel_is_left_out_while_a_window_holds_what_is_missing(value):
    evidence, place = evidence_of(), 1300
    x = samples_of(evidence, 1.5)
    whole = oracle(evidence, x.numpy())
    x[2, place] = value
    found, is_usable = found_by(evidence, x)
    # filters reach back 43 samples, and windows ten blocks: block 130 to 134, and 9 on
    first = x.shape[1] // 10 - len(found)
    number = first + np.arange(len(found))
    inside = (number >= 130) & (number <= 134 + 9)
    assert bool(is_usable[inside].all())
    before = (number > first) & (number < 130)
    np.testing.assert_allclose(found[before], whole[before], rtol=0, atol=1e-9)
    mask = torch.arange(6) != 2
    columns, _, _ = evidence.columns(evidence.blocks_of_recording(x), None, mask)
    torch.testing.assert_close(found[inside], columns[inside], rtol=0, atol=1e-9)
    # afterwards the floor has missed these blocks, of two hundred
    behind = number > 134 + 9
    assert 0 < np.abs(found[behind].numpy() - whole[behind]).max() < 1.0


def test_a_channel_below_its_least_power_is_left_out():
    evidence = evidence_of(resolution=(1e-9,) * 6)
    x = samples_of(evidence)
    x[2] = x[2, 0] + 1e-3 * (x[2] - x[2, 0])
    silent = replace(evidence, least_rms=((0.0,) * 4, (1.0,) * 4, (0.0,) * 4))
    columns, is_usable = found_by(silent, x)
    assert bool(is_usable[evidence.blind + 1 :].all())
    torch.testing.assert_close(columns, found_by(evidence, x, (2,))[0], rtol=0, atol=1e-9)
    assert (found_by(evidence, x)[0] - columns).abs().max() < 10  # only ratios: it is no louder
    two = replace(silent, min_alive=3)
    assert not found_by(two, x)[1].any()


# The classifier, whole and in pieces -------------------------------------------------------------


def classifier_of(evidence, seed=1, *, head="quadratic"):
    columns, _ = found_by(evidence, samples_of(evidence, max(1.5, 60 / evidence.sample_rate_hz), 3))
    rng, num = np.random.default_rng(seed), evidence.num_columns
    scaler = FeatureScaler.fit(columns, tail=0.01)
    if head == "network":
        torch.manual_seed(seed)
        inputs = num * (1 + len(evidence.lags))
        net = Perceptron.drawn(inputs, (7, 5)).double().requires_grad_(False)
        return OnsetClassifier(evidence, scaler, net, 1.5, 0.5, 0.02)
    bend = rng.standard_normal((0, 0) if head == "linear" else (num, num))
    numbers = bend + bend.T, rng.standard_normal(num), np.array(0.5)
    form = QuadraticForm(*map(torch.from_numpy, numbers))
    return OnsetClassifier(evidence, scaler, form, 1.5, 0.5, 0.02)


CLASSIFIERS = {
    head: classifier_of(evidence_of(hop=9), head=head) for head in ("quadratic", "network")
}
SAMPLES = samples_of(CLASSIFIERS["network"].evidence, 2.0, seed=7)
SAMPLES[1, 3100] = torch.nan


BACKENDS = ["torch", *([] if reason_unavailable() else ["native"])]


def in_pieces(stream, samples, cuts, masked=None):
    places = [0, *sorted(cuts), samples.shape[-1]]
    return torch.cat([stream.push(samples[:, a:b], masked) for a, b in pairwise(places)])


@given(
    cuts=st.lists(st.integers(0, 4000), max_size=25),
    dtype=st.sampled_from(["float", "double"]),
    backend=st.sampled_from(BACKENDS),
    head=st.sampled_from(sorted(CLASSIFIERS)),
)
def test_any_cut_gives_the_scores_of_the_recording(cuts, dtype, backend, head):
    samples, classifier = getattr(SAMPLES, dtype)(), CLASSIFIERS[head]
    found = in_pieces(OnsetStream(classifier, backend=backend), samples, cuts)
    torch.testing.assert_close(found, classifier.score_recording(samples), rtol=0, atol=1e-8)


def head_by_hand(classifier, columns):
    """The score of each row of columns, with the rows of before that a network sees."""
    low, high = classifier.scaler.minimum.numpy(), classifier.scaler.maximum.numpy()
    z = np.clip(2 * (columns - low) / (high - low) - 1, -1, 1)
    head = classifier.head
    if isinstance(head, QuadraticForm):
        bend = 0.0 if head.is_linear else np.einsum("ki,ij,kj->k", z, head.quadratic.numpy(), z)
        return bend + z @ head.linear.numpy() + float(head.constant)
    rows = [z, *(z[np.maximum(np.arange(len(z)) - lag, 0)] for lag in classifier.evidence.lags)]
    z = np.concatenate(rows, 1)
    for number, (weight, bias) in enumerate(zip(head.weights, head.biases, strict=True)):
        z = z @ weight.numpy().T + bias.numpy()
        z = z / (1 + np.exp(-z)) if number < len(head.weights) - 1 else z
    return z[:, 0]


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("head", ["quadratic", "linear", "network"])
def test_a_score_is_the_mean_of_three_hops_of_the_head(backend, head):
    classifier = classifier_of(evidence_of(), head=head)
    x = samples_of(classifier.evidence, 1.0, seed=5)
    score = head_by_hand(classifier, oracle(classifier.evidence, x.numpy()))
    blind = classifier.evidence.blind
    expected = (score[blind:-2] + score[blind + 1 : -1] + score[blind + 2 :]) / 3
    found = OnsetStream(classifier, backend=backend).push(x).numpy()
    is_known = found > NOTHING_YET
    assert is_known.tolist() == [t >= classifier.evidence.first_hop + 2 for t in range(len(found))]
    np.testing.assert_allclose(found[is_known], expected, rtol=1e-9, atol=1e-9)


def scored_without_lost_blocks(classifier, samples, masked, most):
    """The classifier on the blocks that are known, as if the others had not been."""
    evidence = classifier.evidence
    blocks = evidence.blocks_of_recording(samples)
    first = samples.shape[-1] // evidence.hop_samples - len(blocks.means)
    if evidence.hand.fast:
        own = blocks.logs.sum(1).isfinite() & ~masked[list(evidence.hand.fast)]
        own &= blocks.moves & (blocks.logs > evidence.silence).any(1)
        is_lost = own.sum(-1) < evidence.min_alive
    else:
        own = blocks.means.isfinite() & ~masked
        is_lost = own.sum(-1) < evidence.min_alive
    found = torch.full((first + len(is_lost),), NOTHING_YET, dtype=torch.float64)
    memory, scores, num_lost = None, [math.nan, math.nan], 0
    for block in range(len(is_lost)):
        num_lost += int(is_lost[block])
        if is_lost[block]:
            continue
        memory = None if num_lost > most else memory
        num_lost = 0
        score, memory = classifier.scores(blocks.only(slice(block, block + 1)), memory, ~masked)
        scores = [*scores[-2:], float(score)]
        found[first + block] = np.nan_to_num(np.mean(scores), nan=NOTHING_YET)
    return found


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(
    ("kinds", "changes", "head"),
    [
        ("GFFGFG", {"min_alive": 3}, "network"),
        ("GFFGFG", {"least_rms": ((2.0,) * 4, (0.05,) * 4, (0.0,) * 4)}, "quadratic"),
        ("FGF", {}, "network"),
        ("FF", {"min_alive": 2}, "linear"),
        ("F", {}, "quadratic"),
        ("GGG", {}, "network"),
    ],
    ids=str,
)
def test_backends_agree_on_any_hand_with_channels_lost(kinds, changes, head, backend):
    classifier = classifier_of(evidence_of(kinds, comb_periods=4), head=head)
    classifier = replace(classifier, evidence=replace(classifier.evidence, **changes))
    samples = samples_of(classifier.evidence, 4.0, seed=4)
    samples[-1, 2500], samples[0, 5000:] = torch.inf, 1.5
    samples[1 % len(kinds) :, 2900 : 2900 + 800] = torch.nan  # longer than the hold
    samples[:, 6500:6540] = samples[:, 6500:6501].clone()  # a logger that repeats a sample
    for masked in (torch.zeros(len(kinds)).bool(), torch.arange(len(kinds)) == len(kinds) - 1):
        for hold in (500, 2000):
            stream = OnsetStream(classifier, hold, backend)
            found = in_pieces(stream, samples.T.clone().T, [7, 3103, 5001], masked)
            most = -(-(classifier.evidence.context + 10 + hold) // 10)
            expected = scored_without_lost_blocks(classifier, samples, masked, most)
            torch.testing.assert_close(found, expected, rtol=0, atol=1e-8)
        is_deaf = kinds in ("F", "FF") and bool(masked.any())
        assert bool((found > NOTHING_YET).any()) != is_deaf


def test_samples_that_a_logger_repeats_are_no_evidence():
    classifier = CLASSIFIERS["quadratic"]
    samples = samples_of(classifier.evidence, 1.5, seed=2)
    samples[:, 2000:2040] = samples[:, 2000:2001].clone()
    found = OnsetStream(classifier).push(samples)
    assert (found[223:226] == NOTHING_YET).all()  # whole blocks of nine within
    assert (found[227:] > NOTHING_YET).all()


def test_scores_have_gradients_down_to_the_samples():
    classifier = classifier_of(evidence_of(), head="network")
    x = samples_of(classifier.evidence, 0.6).requires_grad_()
    score, _ = classifier.scores(classifier.evidence.blocks_of_recording(x))
    score[-1].backward()
    assert bool((x.grad[:, -10:] != 0).all())
    step = torch.zeros_like(x.data)
    step[2, -3] = 1e-5
    high, low = (
        classifier.scores(classifier.evidence.blocks_of_recording(x.data + way * step))[0][-1]
        for way in (1, -1)
    )
    torch.testing.assert_close(x.grad[2, -3], (high - low) / 2e-5, rtol=1e-4, atol=1e-9)


# As plain data, and what is refused --------------------------------------------------------------


def settings_with(classifier):
    return AlarmSettings(50, Platt(1.0, 0.0), KOfN(1, 1), 1.0, None, onset=classifier)


@pytest.mark.parametrize("head", ["quadratic", "linear", "network"])
def test_survives_json(head):
    made = classifier_of(evidence_of(comb_periods=4, mains_hz=60.0), head=head)
    made = OnsetClassifier.from_dict(made.to_dict(), made.evidence.hand, RATE)  # to float32
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
    made = CLASSIFIERS["quadratic"]
    factors, signs = made.head.quadratic[:3], torch.tensor([1.0, -1.0, 1.0])
    head = QuadraticForm(factors, made.head.linear, made.head.constant, signs)
    dense = QuadraticForm(head.matrix, head.linear, head.constant)
    in_factors, whole = replace(made, head=head), replace(made, head=dense)
    expected = whole.score_recording(SAMPLES)
    found = OnsetStream(in_factors, backend=backend).push(SAMPLES)
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9)
    plain = json.loads(json.dumps(in_factors.to_dict()))
    assert plain == whole.to_dict()


def kept(change, hand=None):
    """Settings with the classifier after a round to plain data that is changed on the way."""
    plain = settings_with(CLASSIFIERS["network"]).to_dict()
    change(plain["onset"])
    return AlarmSettings.from_dict(plain, hand or hand_of("GFFGFG"), RATE)


BAD_SETTINGS = [
    (lambda: evidence_of(rate=9.0, hop=0), "at least 10 samples a second, got 9 Hz; take onset="),
    (lambda: evidence_of(hop=11), "at least every 5 ms or every sample, got 11 samples .* 2000 Hz"),
    (lambda: evidence_of(resolution=(1.0,)), r"resolution must be finite, at least 0 and \[6\]"),
    (lambda: evidence_of(least_rms=((1.0,) * 4,)), r"least_rms must be .* and \[3, 4\]"),
    (lambda: evidence_of(is_still=(True,)), "is_still must be of 3 channels, got 1"),
    (
        lambda: kept(lambda plain: plain.update(minimum=[0.0], maximum=[1.0])),
        "expected .* columns .* got 1 .*; another version made this alarm, train again",
    ),
    (lambda: kept(lambda plain: plain.pop("mains_hz")), "of this version: 'mains_hz'"),
    (lambda: Perceptron([torch.ones(2, 3)], [torch.ones(2)]), "end in one output, got .*2, 3"),
]


@pytest.mark.parametrize(("make", "message"), BAD_SETTINGS)
def test_bad_settings_are_refused_in_one_line(make, message):
    with pytest.raises(ValueError, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)


TRAINING_HZ = 1000.0


def ms(*spans):
    return [t for first, last in spans for t in range(first, last + 1, 5)]


def test_hops_are_learned_as_what_they_are():
    """Edges lie 1 ms off the ends of hops."""
    times = SmallTimeline(
        onsets_s=(1.021, 2.251),
        released_s=((1.001, 1.07), (2.251, 2.26)),
        sliding_s=((1.021, 1.501), (2.251, 2.401)),
        slip_s=((3.001, 3.201),),
        unlabelled_s=((4.001, 4.101),),
    )
    at = np.arange(5, 5001, 5)
    label = _labels_of(times, at / 1000)
    # from half of the load to 300 ms behind it, or the end of the slide
    assert at[label > 0].tolist() == ms((1025, 1320), (2255, 2400))
    left_out = ms((1005, 1020), (1325, 1750), (2405, 2650), (3005, 3450), (4005, 4350))
    assert at[label == 0].tolist() == left_out
    # 300 ms before a first release
    assert at[label == -2].tolist() == ms((705, 1000), (1955, 2250))
    plain = SmallTimeline(onsets_s=(1.021,), sliding_s=((1.021, 1.5),))
    label = _labels_of(plain, at / 1000)  # no release is known
    assert at[label > 0].tolist() == ms((1025, 1320))
    assert at[label == 0].tolist() == ms((1325, 1750))


class Bursts(SmallSet):
    """Noise; on paper a burst at the onset and a little more in the slide, else a knock."""

    sample_rate_hz = TRAINING_HZ

    def __init__(self, materials="abc", cycles=3, burst=()):
        super().__init__(materials, cycles)
        self.ids += tuple(replace(recording, scene="taps") for recording in self.ids)
        self.materials, self.burst = materials, dict(burst)

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
            noise[:, onset : round(end_s * TRAINING_HZ)] *= 2.0
            noise[:, onset : onset + 40] *= self.burst.get(recording.material, 4.0)
        if times.non_slip_s:
            noise[:, 1310:1312] *= 10.0
        truth = (20.0,) * len(times.onsets_s), times.onsets_s, times.sliding_s
        return Recording(noise, TRAINING_HZ, recording.material, *truth)


def fitted(source, ids=None, **numbers):
    ids = source.ids if ids is None else ids
    return OnsetTraining(**({"epochs": 4} | numbers))(source, ids, num_workers=0)


@pytest.fixture(scope="module")
def learned():
    return fitted(Bursts("abcdef", 2), folds=2)


def test_validation_chooses_the_head_and_each_material_is_left_out_once(learned):
    classifier, left_out, report = learned
    heads = report["heads"]
    assert set(heads) == {"quadratic", "network"}
    best = max(heads, key=lambda name: heads[name]["found"])
    assert report["head"] == best
    assert isinstance(classifier.head, Perceptron) == (best == "network")
    assert set(left_out) == set("abcdef")
    assert len({id(left_out[name]) for name in "abc"}) == 1
    assert left_out["a"] is not left_out["d"]
    assert report["slips"] == 12
    assert (classifier.threshold, classifier.hint) == (math.inf, math.inf)


def test_a_slip_of_a_new_material_scores_above_all_that_is_none(learned):
    classifier, _, _ = learned
    source = Bursts("xyz", 2)
    slips, others = [], []
    for recording in source.ids:
        score = classifier.score_recording(source.load(recording).samples).numpy()
        label = _labels_of(source.timeline(recording), (1 + np.arange(len(score))) * 0.005)
        known = score > NOTHING_YET
        slips += [score[known & (label > 0)].max()] if (label > 0).any() else []
        others.append(score[known & (label < 0)].max())
    assert len(slips) == 6
    assert np.median(slips) > np.median(others)
    assert min(slips) > np.median(others)


def test_a_classifier_does_not_see_what_it_was_fitted_without(learned):
    _, left_out, _ = learned
    loud = Bursts("abcdef", 2, burst={"a": 9.0})
    _, other, _ = fitted(loud, folds=2)
    same, changed = ((left_out[name].to_dict(), other[name].to_dict()) for name in ("b", "d"))
    assert same[0]["head"] == same[1]["head"]
    assert changed[0]["head"] != changed[1]["head"]


def test_the_same_seed_fits_the_same_classifier(learned):
    again, _, report = fitted(Bursts("abcdef", 2), folds=2)
    assert again.to_dict() == learned[0].to_dict()
    assert report == learned[2]


def test_resolution_is_the_smallest_step_of_a_channel():
    source = Bursts("ab", 1)
    evidence = fitted(source, epochs=1)[0].evidence
    expected = [
        min(
            float(d[d > 0].min())
            for d in (source.load(r).samples[c].diff().abs() for r in source.ids)
        )
        for c in range(2)
    ]
    assert evidence.resolution == pytest.approx(expected)


@pytest.mark.parametrize("kinds", ["GFF", "GG"])
def test_training_reads_the_columns_that_a_stream_has(kinds):
    evidence = evidence_of(kinds)
    x = samples_of(evidence, 1.0)
    x[:, 700:720] = torch.nan
    found, is_usable = _columns_of(evidence, x)
    first = x.shape[1] // 10 - len(found)
    lost = np.isnan(found).any(1)
    assert lost[70 - first : 72 - first].all()
    blocks = evidence.blocks_of_recording(x)
    known = blocks.only(np.flatnonzero(~lost))
    columns, usable, _ = evidence.columns(known)
    np.testing.assert_allclose(found[~lost], columns, rtol=0, atol=1e-9)
    assert is_usable[~lost].tolist() == usable.tolist()


def test_kinds_without_slip_weigh_as_they_are_told_to():
    kinds = np.array(["arm"] * 10 + ["taps"] * 40 + ["slip"] * 5 + ["slip"] * 5)
    is_slip = np.arange(60) >= 55
    weights = _weights(kinds, is_slip, {"arm": 4.0}).astype(float)
    of_kind = {name: weights[(kinds == name) & ~is_slip].sum() for name in ("arm", "taps", "slip")}
    assert of_kind["arm"] == pytest.approx(4 * of_kind["taps"])
    assert of_kind["taps"] == pytest.approx(of_kind["slip"])
    assert weights[is_slip].sum() == pytest.approx(sum(of_kind.values()) / 2)
    assert weights.mean() == pytest.approx(1)


@pytest.mark.parametrize("given", [{}, {"before": 3.0}])
def test_what_comes_before_a_slip_is_a_kind_where_it_has_a_weight(given):
    label = np.array([-1] * 40 + [-2] * 10 + [1] * 10, np.int8)
    one, none = np.zeros(60, int), np.zeros((60, 2), np.float16)
    hops = _Hops(
        none, label, one, one, one, np.array(["a"]), np.array(["slip"]), [(0.0,)], [(1.0,)]
    )
    scaler = FeatureScaler(torch.zeros(2).double(), torch.ones(2).double())
    batches = _Batches(hops, np.arange(60), scaler, [], given, 0)
    weight = np.array([batches._weight[batches._known == n].sum() for n in range(60)])
    usual, before = weight[:40].sum(), weight[40:50].sum()
    if given:
        assert before == pytest.approx(3 * usual)
    else:  # as every other hop
        assert before / usual == pytest.approx(10 / 40)


NOTHING_TO_LEARN = [
    ("taps", {}, "no slip begins in the recordings that slips are learned from"),
    ("none", {}, "no recording is left to learn slips from; give onset.worlds"),
    ("paper", {"head": "forest"}, "must be one of auto, quadratic, network, got 'forest'"),
]


@pytest.mark.parametrize(("scene", "numbers", "match"), NOTHING_TO_LEARN)
def test_what_nothing_can_be_learned_from_is_refused_in_one_line(scene, numbers, match):
    source = Bursts()
    with pytest.raises(ValueError, match=match) as caught:
        fitted(source, [r for r in source.ids if r.scene == scene], **numbers)
    assert "\n" not in str(caught.value)

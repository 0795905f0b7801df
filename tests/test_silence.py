"""Where nothing is sensed nothing is said: lost samples, dead hands, and what comes after them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from streams import onset_of

from tactslip_torch import (
    SlipClassifier,
    SlipDetector,
    StreamingDetector,
    TactileFeatures,
    sample_recording,
)
from tactslip_torch.features.sensing import (
    Sensing,
    StuckChannels,
    least_alive,
    longest_run_of,
    most_stuck_samples,
    run_lengths,
)
from tactslip_torch.hand import Channel, HandLayout
from tactslip_torch.onset.decisions import AlarmSettings, joined_decisions, score_stream
from tactslip_torch.onset.evidence import OnsetStream
from tactslip_torch.onset.rules import Cusum, KOfN

RATE = 2000.0
REACH = 150  # samples that a decision of the shipped detector rests on
SLIP_S = 1.2934
QUIET = slice(200, 2000)
"""Nothing slips; in the first .1 s and behind 1 s scores are close to 0."""
N = 6000  # samples of a hand that senses nothing


@pytest.fixture(scope="module")
def detector():
    return SlipDetector.pretrained()


@pytest.fixture(scope="module")
def volts():
    """The sample recording ``[T, C]``: quiet, then one slip."""
    return sample_recording().samples.T.contiguous()


@pytest.fixture(scope="module")
def rules(detector, volts):
    """Alarms of every kind, with thresholds of both signs, by name."""
    usual = AlarmSettings.of(detector)
    onset = onset_of(volts.T.double(), detector.pool.hand, seed=27)  # that finds the slip
    quiet = volts[: round(SLIP_S * RATE)].T.double()
    blocks = onset.evidence.blocks_of_recording(quiet)
    least = 0.1 * blocks.logs.exp().median(0).values.mT
    evidence = replace(onset.evidence, least_rms=tuple(map(tuple, least.tolist())))
    onset = replace(onset, evidence=evidence)
    # lost blocks are missing in the floor of a second, so later scores differ by some hundredths:
    # the threshold lies where no score of the recording is near
    scores = OnsetStream(onset).push(volts.T.double())
    near = scores[(scores - float(OnsetStream(onset).push(quiet).max()) - 2.0).abs() < 0.5]
    near = near.sort().values
    widest = int(near.diff().argmax())
    onset = replace(onset, threshold=float(near[widest : widest + 2].mean()))
    return {
        "debounced": usual,
        "k of n below 0": replace(usual, threshold=-0.5),
        "one of one": replace(usual, rule=KOfN(1, 1), threshold=-0.25),
        "cusum": replace(usual, rule=Cusum(0.5, 0.5, 9.0), threshold=3.0),
        "onset": replace(usual, rule=Cusum(3.0, 0.5, 30.0), threshold=15.0, onset=onset),
    }


def decided(detector, settings, samples, piece=500):
    """All decisions on samples ``[T, C]``, the alarms' times, and what is told of the hand."""
    stream, parts = StreamingDetector(detector, settings), []
    for part in samples.split(piece):
        parts.append(stream.push(part))
    parts.append(stream.flush())
    made = joined_decisions(parts)
    return made, [alarm.alarm_s for alarm in made.alarms], stream.take_events()


def without(samples, start, num):
    lost = samples.clone()
    lost[start : start + num] = torch.nan
    return lost


RULES = ("debounced", "k of n below 0", "one of one", "cusum", "onset")


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("num_places", [8, pytest.param(120, marks=pytest.mark.slow)])
def test_lost_samples_raise_no_alarm_but_what_fast_channels_alone_say_and_lose_none(
    detector, volts, rules, rule, num_places
):
    _, clean, _ = decided(detector, rules[rule], volts)
    assert clean, "the slip must be found without losses"
    # frames of slow channels are longer, so at a loss fast ones are known earlier and longer
    slow = [c.adapting == "slow" for c in detector.pool.hand.channels]
    alone, _, _ = decided(detector, rules[rule], volts.masked_fill(torch.tensor(slow), torch.nan))
    rng, by_fast = np.random.default_rng(num_places), 0
    for case in range(num_places):
        num = int(rng.integers(1, 401)) if case else 1
        near_slip = case % 3 == 0 and rule != "onset"  # whose evidence is the lost moment itself
        start = rng.uniform(SLIP_S - 0.2, SLIP_S + 0.3) if near_slip else rng.uniform(0, 0.9)
        lost = without(volts, round(start * RATE), num)
        made, alarms, _ = decided(detector, rules[rule], lost)
        assert not (made.is_alarm & ~made.is_valid).any()
        is_fast = made.channels_lost.any(1) & made.score.isfinite()
        assert torch.equal(made.score[is_fast], alone.score[is_fast])
        is_told = is_fast & (made.score >= 0)  # slip, by fast channels alone, lost or not
        # a sum may need one decision more, as the evidence behind the loss may be weaker
        reach = (num + REACH + 50 * (rule == "cusum")) / RATE + 1e-9
        for found in alarms:
            if not any(abs(found - own) <= reach for own in clean):
                told_s = made.available_s[is_told]
                assert ((found - told_s).abs() <= reach).any(), (start, num, found)
                by_fast += 1
        for own in clean:  # what was raised in quiet may be lost
            is_near = (made.available_s >= own) & (made.available_s <= own + reach)
            assert made.is_on[is_near].any() or own < SLIP_S - 0.1, (start, num, own)
    assert by_fast <= num_places // 100  # none of 8 places, one of 120


def noise(size, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return size * torch.randn(N, 24, generator=generator)


def hand_of(kind, quiet):
    """Samples ``[N, 24]`` of a hand of which nothing, or not enough, can be known."""
    usual = quiet.repeat(-(-N // len(quiet)), 1)[:N].clone()
    match kind:
        case "zero" | "constant" | "rail" | "low rail" | "nan":
            value = {"zero": 0.0, "constant": 1.234, "rail": 5.0, "low rail": -5.0}.get(kind)
            return torch.full((N, 24), torch.nan if value is None else value)
        case "frozen":
            return quiet[-1].expand(N, 24)
        case "noise":
            return noise(1e-4)
        case "noise on an offset":
            return quiet.mean(0) + noise(3e-5)
        case "a thousandth":
            return usual * 1e-3
        case "fast channels off":
            usual[:, 14:] = 0.0
    return usual


DEAD = (
    *("zero", "constant", "rail", "low rail", "nan", "frozen", "noise", "noise on an offset"),
    *("a thousandth", "fast channels off"),
)


@pytest.mark.parametrize("is_behind", [False, True])
@pytest.mark.parametrize("kind", DEAD)
def test_a_hand_that_senses_nothing_has_no_probability_and_no_alarm(
    detector, volts, rules, kind, is_behind
):
    quiet = volts[QUIET]
    samples = hand_of(kind, quiet)
    begins = len(quiet) if is_behind else 0
    whole = torch.cat([quiet[:begins], samples, quiet])
    for rule in ("debounced", "onset"):
        made, alarms, events = decided(detector, rules[rule], whole)
        # what a drawn head makes of the jump from one hand to the other is its own
        jump_s = (begins / RATE, begins / RATE + 0.05) if rule == "onset" else (0.0, 0.0)
        assert not [at for at in alarms if not jump_s[0] < at <= jump_s[1]], rule
        first_s = (begins + REACH + 2 * 200) / RATE  # stuck after 200 samples
        inside = (made.available_s > first_s) & (made.available_s < (begins + N) / RATE)
        assert inside.sum() > 20
        assert not made.is_valid[inside].any(), rule
        assert made.score[inside].isnan().all()
        assert made.probability[inside].isnan().all()
        assert any("not valid" in event.text for event in events)
        assert made.is_valid[made.available_s > (begins + N + 2400) / RATE].all()


def test_half_of_the_fast_channels_and_a_third_of_the_gain_are_valid(detector, volts, rules):
    half, quiet = volts[QUIET].clone(), volts[QUIET]
    half[:, 14:19] = 0.0
    for samples, num_lost in ((half, 5), (0.3 * quiet, 0)):
        made, alarms, _ = decided(detector, rules["debounced"], samples)
        assert made.is_valid.all()
        assert made.in_range.all()
        assert not alarms
        assert (made.channels_lost.sum(-1) == num_lost).all()
    half[:, 19] = 0.0  # four of ten are left
    assert not decided(detector, rules["debounced"], half)[0].is_valid.any()


def test_gains_that_set_the_threshold_are_in_range_and_others_are_not(detector, volts, rules):
    quiet = volts[QUIET]
    spans = score_stream(detector, quiet.T, 50).span
    levels = Sensing.fit(torch.cat([300 * spans, 3000 * spans]), 1, 1)
    for rule in ("debounced", "onset"):
        of_training, settings = rules[rule], replace(rules[rule], levels=levels)
        for gain, by_training, by_levels in ((1, True, False), (1000, False, True)):
            for own, is_in in ((of_training, by_training), (settings, by_levels)):
                made = decided(detector, own, gain * quiet)[0]
                known = made.in_range[made.available_s > 0.3]
                assert known.any() == known.all() == is_in, (rule, gain)
    again = AlarmSettings.from_dict(
        settings.to_dict(), detector.pool.hand, detector.pool.sample_rate_hz
    )
    assert again.levels == levels


def test_one_dead_channel_leaves_a_decision_valid_and_is_named(detector, volts, rules):
    for dead in (0.0, 5.0, torch.nan):
        lost = volts.clone()
        lost[:, 16] = dead
        made, alarms, events = decided(detector, rules["debounced"], lost)
        assert made.is_valid.all()
        assert set(map(made.names_lost, range(len(made.score)))) == {("PVDF3",)}
        assert [event.text for event in events] == ["channels lost: PVDF3"]
        assert len(alarms) == 1


def test_an_alarm_stands_over_a_short_loss_and_ends_in_a_long_one(detector, volts, rules):
    settings = rules["debounced"]
    at = round(1.6 * RATE)  # an alarm stands
    hold = round(settings.hold_s * RATE)
    for num, stands in ((hold, True), (2 * hold, False)):
        made, _, _ = decided(detector, settings, without(volts, at, num))
        behind = int(np.searchsorted(made.available_s.numpy(), (at + num) / RATE))
        assert bool(made.is_on[behind]) == stands


def test_a_hand_whose_unit_is_another_is_told_once(detector, volts, rules):
    quiet = volts[QUIET].repeat(4, 1)
    for factor, said in (
        (1e-3, "a thousandth"),
        (40.0, "times"),
        (1e3, "a thousand times"),
        (1.0, None),
    ):
        _, _, events = decided(detector, rules["debounced"], factor * quiet)
        told = [event.text for event in events if "levels" in event.text]
        assert len(told) == (said is not None)
        assert said is None or said in told[0]
    made, _, _ = decided(detector, rules["debounced"], 1e3 * quiet)
    assert made.is_valid.all()
    assert not made.in_range.any()


# Stuck channels ----------------------------------------------------------------------------------


def naive_stuck(x, most):
    """Sample by sample: NaN from the one behind ``most`` equal ones on."""
    marked = x.copy()
    for channel in range(len(x)):
        run = 0
        for i, value in enumerate(x[channel]):
            run = run + 1 if i and value == x[channel, i - 1] else 1
            if run > most:
                marked[channel, i] = np.nan
    return marked


@given(st.integers(0, 2**32 - 1), st.integers(1, 6), st.integers(1, 40))
def test_a_stuck_channel_is_missing_however_its_samples_come(seed, most, piece):
    rng = np.random.default_rng(seed)
    x = rng.choice([0.0, 1.0, np.nan], (3, 60), p=[0.6, 0.3, 0.1])
    mark = StuckChannels(most)
    parts = [mark(part) for part in np.split(x, range(piece, 60, piece), axis=1)]
    np.testing.assert_array_equal(np.concatenate(parts, 1), naive_stuck(x, most))


def test_stuck_is_longer_than_twice_what_training_had_within_limits():
    x = torch.tensor([[0.0, 1, 1, 1, 2, 3], [4, 4, 4, 4, 4, 4]])
    assert run_lengths(x).tolist() == [[1, 1, 2, 3, 1, 1], [1, 2, 3, 4, 5, 6]]
    assert longest_run_of(run_lengths(x)) == 3  # a channel that never moves does not count
    assert most_stuck_samples(2000.0, 3) == 200  # .1 s
    assert most_stuck_samples(2000.0, 300) == 600
    assert most_stuck_samples(2000.0, 30000) == 2000  # 1 s
    assert most_stuck_samples(10.0, 30000) == 20
    assert most_stuck_samples(2000.0) == 2000
    assert most_stuck_samples(500.0, 1, has_fast=False) == 5  # .01 s
    assert most_stuck_samples(100.0, 3, has_fast=False) == 6


# Other hands -------------------------------------------------------------------------------------


def test_least_alive_never_asks_for_all_of_several():
    assert [least_alive(num) for num in (1, 2, 3, 5, 10)] == [1, 1, 1, 2, 5]
    assert [least_alive(num, 1.0) for num in (1, 2, 10)] == [1, 1, 9]


def windows(num_channels, num_samples, seed=0, whole=False):
    rng = np.random.default_rng(seed)
    y = np.arange(80) % 2
    x = rng.standard_normal((80, num_channels, num_samples)) * (1 + 3 * y[:, None, None]) + 5
    return (np.round(x) if whole else x), y


def hand(adapting):
    channels = [Channel(f"C{i}", f"{a}taxel", "any", "any", a) for i, a in enumerate(adapting)]
    return HandLayout(tuple(channels))


@pytest.mark.parametrize(
    ("made", "num_lost", "is_valid"),
    [
        (hand(["fast"]), 0, True),
        (hand(["fast"]), 1, False),
        (hand(["slow"] * 4), 2, True),  # without fast ones the slow ones count
        (hand(["slow"] * 4), 3, False),
        (hand(["slow"] * 4 + ["fast"] * 2), 4, True),  # the slow ones do not count
        (hand(["fast"] * 3 + ["slow"]), 2, True),
        (hand(["fast"] * 3 + ["slow"]), 3, False),
    ],
)
def test_channels_that_count_must_be_alive_on_any_hand(made, num_lost, is_valid):
    x, y = windows(len(made), 100)
    classifier = SlipClassifier(features=TactileFeatures(RATE, made, use="pooled")).fit(x, y)
    lost = x.copy()
    lost[:, :num_lost] = 7.0
    assert classifier.predict_valid(x).all()
    assert (classifier.predict_valid(lost) == is_valid).all()
    if not is_valid:
        assert (classifier.predict(lost) == 0).all()
        assert (classifier.decision_function(lost) == 0).all()
        assert (classifier.predict_proba(lost) == 0.5).all()


@pytest.mark.parametrize("level", [0.0, 99.0])
@pytest.mark.parametrize("apart", [0, 25], ids=["at once", "one after the other"])
def test_unplugging_a_hand_without_fast_channels_raises_no_alarm(level, apart):
    rng, slow = np.random.default_rng(3), hand(["slow"] * 4)
    y = np.arange(200) % 2
    x = 50 + rng.standard_normal((200, 4, 25)) * (1 + 3 * y[:, None, None])
    detector = SlipClassifier(features=TactileFeatures(500.0, slow)).fit(x, y).detector_
    samples = torch.from_numpy(50 + rng.standard_normal((1500, 4)))
    slips = samples.clone()
    slips[750:] = 50 + 4 * (slips[750:] - 50)
    for channel in range(4):
        samples[750 + apart * channel :, channel] = level
    settings = AlarmSettings.of(detector)
    assert len(decided(detector, settings, slips)[1]) == 1
    made, alarms, _ = decided(detector, settings, samples)
    assert alarms == []
    assert not made.is_valid[-1]


def test_short_windows_of_whole_counts_are_never_silent():
    x, y = windows(3, 5, whole=True)
    x[3:6] = 1.0
    assert (
        SlipClassifier(features=TactileFeatures(25.0, wavelet="haar"))
        .fit(x, y)
        .predict_valid(x)
        .all()
    )


def test_windows_with_missing_samples_are_predicted_and_not_fitted():
    x, y = windows(4, 100)
    classifier = SlipClassifier(RATE).fit(x, y)
    missing = x.copy()
    missing[0], missing[1, 0], missing[2, :, 5] = np.nan, np.nan, np.inf
    assert classifier.predict_valid(missing)[:4].tolist() == [False, True, False, True]
    assert np.isfinite(classifier.decision_function(missing)).all()
    with pytest.raises(ValueError, match="X holds NaN: window 0, channel 0, sample 0"):
        classifier.fit(missing, y)

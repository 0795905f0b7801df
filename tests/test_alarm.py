"""The stages behind the fit: who calibrates, which rate is kept; evaluated streams set nothing."""

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hydra.utils import instantiate
from small_detector import small_detector
from small_set import RATE_HZ, SMALL_HAND
from test_commands import composed

from tactslip_torch.commands.train import train
from tactslip_torch.data.recording import Recording, RecordingId, RecordingSource
from tactslip_torch.features.cache import cache_key
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.model.calibration import Isotonic, Platt
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.kernels import QuadraticForm
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.onset.decisions import KEY, AlarmSettings, Decider
from tactslip_torch.onset.rules import Cusum, KOfN
from tactslip_torch.onset.streaming import StreamingDetector
from tactslip_torch.report.results import alarm_figure, alarm_table, scene_rows
from tactslip_torch.signals.filtering import ChannelFilter
from tactslip_torch.training.alarm import (
    FIRST_TRANSITION,
    LEAST,
    MOST,
    OURS,
    CalibratedAlarm,
    DebouncedAlarm,
    Stream,
    Timing,
    decide,
    labelled,
    score_streams,
    watched,
)

RULES = {
    "cusum": {"name": "cusum", "drift": 0.5, "evidence": 0.4},
    "k_of_n": {"name": "k_of_n", "k": 2, "n": 3},
}
TRAINED = [RecordingId(m, 0, s) for m in ("a", "b") for s in ("paper", "held")]
TIMING = Timing(RATE_HZ, 20, 100, 25)


def times_of(duration_s=3.0, slides=(), released_s=()):
    return SimpleNamespace(
        duration_s=duration_s,
        onsets_s=tuple(start for start, _ in slides),
        sliding_s=tuple(slides),
        speeds_mm_s=(20.0,) * len(slides),
        released_s=released_s,
    )


class Streams:
    """Noise that is louder in slides, with a knock now and then; two materials seen, one not."""

    is_simulated = True
    hand = SMALL_HAND
    sample_rate_hz = RATE_HZ

    def __init__(self, gain_of=None, cycles=6) -> None:
        self.ids = tuple(
            RecordingId(material, cycle, scene)
            for scene in ("paper", "held", "taps")
            for material in ("a", "b", "new")
            for cycle in range(cycles)
        )
        self.gain_of = gain_of or (lambda recording: 1.0)

    def timeline(self, recording):
        return times_of(slides=((2.1, 2.9),) if recording.scene == "paper" else ())

    def key(self, recording):
        return {"id": str(recording)}

    def load(self, recording, windows=None):
        times = self.timeline(recording)
        generator = torch.Generator().manual_seed(sum(str(recording).encode()) * 7919)
        noise = torch.randn(2, round(times.duration_s * RATE_HZ), generator=generator)
        for start_s, end_s in times.sliding_s:
            noise[:, round(start_s * RATE_HZ) : round(end_s * RATE_HZ)] *= 2.0
        knock = int(torch.randint(300, 4000, (1,), generator=generator))
        noise[1, knock : knock + 60] *= 3.0
        noise *= self.gain_of(recording)
        return Recording(
            noise, RATE_HZ, recording.material, times.speeds_mm_s, times.onsets_s, times.sliding_s
        )


def loudness_detector() -> SlipDetector:
    """One feature: the spread of the fast channel; positive above some 1.5 times that of rest."""
    pool = FeaturePool(SMALL_HAND)
    place = [str(name) for name in pool.names].index("PVDF1 A1 time std")
    scaler = FeatureScaler(torch.zeros(1).double(), torch.ones(1).double())
    head = QuadraticForm(torch.zeros(1, 1).double(), 4 * torch.ones(1).double(), torch.tensor(1.04))
    info = {
        "train_materials": ["a", "b"],
        "train_recordings": {str(r): cache_key({"id": str(r)}) for r in TRAINED},
    }
    return SlipDetector(pool, ChannelFilter([51, 11]), [place], scaler, head.double(), info)


def stage(streams=None, **changes) -> CalibratedAlarm:
    values = {
        "streams": streams or Streams(),
        "hop_ms": 25.0,
        "false_alarms_per_hour": 300.0,
        "hours": 10.0,
        "slip_free": "held",
        "rules": RULES,
        "rule": "cusum",
    }
    return CalibratedAlarm(**(values | changes))


class Backwards:
    """A baseline that scores low in slips."""

    def __init__(self, detector: SlipDetector) -> None:
        self.pool, self.channel_filter = detector.pool, detector.channel_filter
        self.needed_index, self.look_ahead = detector.needed_index, detector.look_ahead
        self._detector = detector

    def predict(self, bins, *, given=None):
        found = self._detector.predict(bins, given=given)
        return found._replace(score=-found.score)


@pytest.fixture(scope="module")
def calibrated():
    """A detector with its alarm, and the report; a baseline that is backwards is left out."""
    detector = loudness_detector()
    found = stage()(detector, {"quiet": Backwards(loudness_detector())}, num_workers=0)
    assert "quiet" not in found["methods"]
    return detector, found


def quiet_of(detector):
    return [r for r in stage().roles(detector)["calibrate"] if r.scene == "held"]


# ------------------------------------------------------------------------------- who calibrates
def test_half_of_the_fresh_cycles_calibrate_and_nothing_trained_on_has_a_role():
    roles = stage().roles(loudness_detector())
    assert not set(TRAINED) & {r for own in roles.values() for r in own}
    calibrate, test, unseen = roles["calibrate"], roles["test"], roles["unseen"]
    assert {r.scene for r in calibrate} == {"paper", "held"}
    assert {r.material for r in unseen} == {"new"}
    assert len(unseen) == 18
    for material in ("a", "b"):
        for scene in ("paper", "held"):
            own = sorted(r.cycle for r in calibrate if (r.material, r.scene) == (material, scene))
            others = sorted(r.cycle for r in test if (r.material, r.scene) == (material, scene))
            assert (own, others) == ([1, 3, 5], [2, 4])
    assert sum(r.scene == "taps" for r in test) == 12


def test_hours_bound_the_slip_free_recordings_of_each_role_and_too_few_are_told(caplog):
    roles = stage(hours=4.5 / 3600).roles(loudness_detector())  # recordings of 3 s
    assert [sum(r.scene == "held" for r in own) for own in roles.values()] == [2, 2, 2]
    assert not caplog.text
    stage(hours=1.0).roles(loudness_detector())
    assert "calibrate has 0.01 h of held, onset.hours=1 were asked for" in caplog.text
    with pytest.raises(ValueError, match="no recording of scene paper that was not trained on"):
        stage(Streams(cycles=1)).roles(loudness_detector())


@pytest.mark.parametrize(
    ("made", "changes", "match"),
    [
        (stage, {"rule": "best"}, "onset.rule must be one of cusum, k_of_n, got 'best'"),
        (stage, {"calibration": "none"}, "calibration must be one of platt, isotonic, got 'none'"),
        (stage, {"hop_ms": 0.0}, "onset.hop_ms must be a positive finite number, got 0"),
        (stage, {"hop_ms": 0.3}, r"onset\.hop_ms=0\.3 is 0\.6 samples at 2000 Hz"),
        (stage, {"hours": math.inf}, "onset.hours must be a positive finite number, got inf"),
        (stage, {"rules": {"cusum": {"name": "sum"}}}, "no sequential rule is called 'sum'"),
        (stage, {"rules": {"cusum": {"drift": 1.0}}}, "no sequential rule is called None"),
        (stage, {"level": 2.0}, "onset.level must lie between 0 and 1, got 2"),
        (stage, {"slip_share": 0.0}, "onset.slip_share must lie between 0 and 1, got 0"),
        (stage, {"rearm_s": -1.0}, "onset.rearm_s must be a finite number of at least 0, got -1"),
        (stage, {"slip_free": "heldd"}, "onset.slip_free must be a scene of .* held, paper, taps"),
        (DebouncedAlarm, {"k": 4}, "k must lie between 1 and n"),
        (DebouncedAlarm, {"k": "a"}, "onset.k must be a positive whole number, got 'a'"),
        (DebouncedAlarm, {"n": 2.5}, "onset.n must be a positive whole number, got 2.5"),
        (DebouncedAlarm, {"probability": "abc"}, "onset.probability must lie .*, got 'abc'"),
        (DebouncedAlarm, {"hop_ms": "abc"}, "onset.hop_ms must be a positive .*, got 'abc'"),
    ],
)
def test_bad_settings_are_refused_in_one_line(made, changes, match):
    with pytest.raises(ValueError, match=match) as caught:
        made(**changes)
    assert "\n" not in str(caught.value)


# ------------------------------------------------------------------------------ which rate is kept
def test_alarms_of_calibrating_streams_are_those_of_the_curve_and_keep_the_rate(calibrated):
    detector, found = calibrated
    settings = AlarmSettings.of(detector)
    curve = settings.metadata["threshold_curve"]
    assert found["settings"]["metadata"]["threshold_curve"] == curve
    assert 3 <= len(curve) <= 25
    thresholds, rates = zip(*curve, strict=True)
    assert list(thresholds) == sorted(set(thresholds))
    assert list(rates) == sorted(set(rates), reverse=True)
    assert LEAST <= rates[-1] <= rates[0] <= MOST
    rate = found["settings"]["metadata"]["calibrated"]["rate"]
    assert rate["alarms"] <= math.floor(300.0 * rate["hours"])
    middle = curve[len(curve) // 2]
    for threshold, expected in (middle, (settings.threshold, rate["per_hour"])):
        rule = replace(settings.rule, ceiling=max(settings.rule.ceiling, threshold))
        alarms = hours = 0
        for recording in quiet_of(detector):
            live = StreamingDetector(detector, replace(settings, rule=rule, threshold=threshold))
            for made in (live.push(Streams().load(recording).samples.T), live.flush()):
                alarms += len(made.alarms)
                hours += len(made.number) * live.hop_s / 3600
        assert alarms / hours == pytest.approx(expected)


def test_evaluated_streams_set_nothing():
    few, plain = {"rules": {"cusum": RULES["cusum"]}}, loudness_detector()
    roles = stage(Streams(cycles=3)).roles(plain)
    evaluated, calibrating = {*roles["test"], *roles["unseen"]}, set(roles["calibrate"])
    thresholds = []
    for louder in (set(), evaluated, calibrating):
        source = Streams(lambda r, of=louder: 1.3 if r in of else 1.0, cycles=3)
        stage(source, **few)(plain, num_workers=0)
        thresholds.append(plain.info[KEY]["threshold"])
    assert thresholds[0] == thresholds[1] != thresholds[2]


def test_slips_are_found_in_time_and_all_is_told_in_plain_json(calibrated, tmp_path):
    detector, found = calibrated
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    ours = found["events"]["test stream"]["cusum"]
    assert ours["num_onsets"] == ours["num_found"] + ours["num_early"] == 4
    assert 0 < ours["delay_ms"]["median"]["value"] < 500
    assert set(found["events"]["unseen stream"]) == {*RULES, FIRST_TRANSITION}
    assert found["scenes"]["taps"]["trained"] is False
    assert found["scenes"]["taps"]["test"]["cusum"]["quiet_hours"] == pytest.approx(36 / 3600)
    assert found["streams"]["calibrate"]["held"] == pytest.approx(
        {"recordings": 6, "hours": 18 / 3600, "slips": 0}
    )
    assert found["reliability"]["test stream"]["ece"] < 0.2
    assert set(found["reliability"]["test stream"]["per_material"]) == {"a", "b"}
    settings = AlarmSettings.of(detector)
    assert settings.rule.ceiling == pytest.approx(1.5 * settings.threshold)
    detector.save(tmp_path / "detector.pt")
    assert AlarmSettings.of(SlipDetector.load(tmp_path / "detector.pt")) == settings
    with pytest.raises(ValueError, match=r"no alarm threshold; train with \+exp=onset"):
        AlarmSettings.of(loudness_detector())
    metrics = {"simulated": True, "events": found["events"], "alarm": found}
    assert alarm_table(metrics).startswith("SIMULATED")
    row = next(row for row in scene_rows(metrics) if row["scene"] == "taps")
    assert (row["materials"], row["trained on"]) == ("seen", False)
    alarm_figure(metrics, tmp_path / "alarm.png")
    assert (tmp_path / "alarm.png").stat().st_size > 10_000


def test_the_papers_rule_is_left_out_where_its_hop_cannot_be():
    detector, timing = loudness_detector(), Timing(RATE_HZ, 40, 100, 25)
    made = stage(hop_ms=20.0)
    own = score_streams(made.streams, made.roles(detector)["calibrate"], {OURS: detector}, 40, 0)
    assert set(made.methods(own, {OURS: timing})) == set(RULES)


def test_evidence_left_open_is_hop_by_bin():
    rules = {"open": {"name": "cusum", "evidence": None}, "cusum": RULES["cusum"]}
    made = stage(rules=rules).made_rules(100)
    assert (made["open"].evidence, made["cusum"].evidence) == (0.5, 0.4)


# -------------------------------------------------------------------------- streams and decisions
def stream_of(score, slides=(), number=0, duration_s=2.0, is_usable=None) -> Stream:
    score = torch.as_tensor(score, dtype=torch.float32)
    valid = torch.ones(len(score), dtype=torch.bool)
    usable = valid if is_usable is None else torch.tensor(is_usable)
    recording = RecordingId("a", number, "held")
    return Stream(recording, times_of(duration_s, slides), score, valid, usable)


def settings_of(rule=None, hop=20, **changes) -> AlarmSettings:
    values = {"threshold": 1.0, "target_per_hour": 1.0, "lead_s": 0.01} | changes
    return AlarmSettings(hop, Platt(2.0, 0.1), rule or KOfN(2, 3), **values)


def knocked(number: int) -> Stream:
    """10 s without slip, with double knocks, which a sum without ceiling takes for one."""
    rng = np.random.default_rng(number)
    score = -1.0 + 0.2 * rng.standard_normal(1000)
    for start in rng.integers(0, 900, 2):
        for knock in (start, start + 45):
            score[knock : knock + 12] = rng.uniform(0.5, 3.0)
    return stream_of(score, number=number, duration_s=10.0)


def test_the_rule_of_the_file_keeps_the_rate_not_one_like_it():
    """A sum that gets its ceiling after its threshold was set re-arms sooner, and alarms more."""
    streams = [knocked(number) for number in range(30)]
    made = stage(false_alarms_per_hour=100.0, rearm_s=0.05, refractory_s=0.0)
    settings = made.calibrated(Cusum(1.0, 0.2), Platt(2.0, 0.0), streams, TIMING)

    def alarms(settings):
        return sum(int(own.is_alarm.sum()) for _, own in decide(streams, settings, TIMING))

    allowed = math.floor(100.0 * 30 * 10 / 3600)
    assert settings.metadata["calibrated"]["rate"]["alarms"] == alarms(settings) <= allowed
    assert alarms(replace(settings, threshold=0.8 * settings.threshold)) > allowed


def test_a_calibration_that_ends_bounds_the_threshold():
    flat = Isotonic((-1.0, 0.4), (-3.0, 2.0))  # every knock is beyond its last knot
    made = stage(false_alarms_per_hour=1.0, rearm_s=0.05, refractory_s=0.0)
    streams = [knocked(number) for number in range(5)]
    settings = made.calibrated(KOfN(2, 3), flat, streams, TIMING)
    assert settings.threshold <= 2.0  # slips can still be found,
    told = settings.metadata["calibrated"]
    assert told["reached"] is False  # and it is told that the rate is not kept
    assert told["rate"]["alarms"] > 0


def test_a_threshold_that_is_never_reached_is_refused():
    rule = Cusum(1.0, 0.2, 7.5)
    assert settings_of(rule, threshold=7.5).threshold == 7.5
    with pytest.raises(ValueError, match=r"threshold 7\.6 lies above 7\.5, .* lower it"):
        settings_of(rule, threshold=7.6)


@pytest.mark.parametrize("rule", [KOfN(2, 3), Cusum(0.2, 0.5, 4.0)], ids=lambda rule: rule.name)
def test_streams_are_decided_together_as_each_alone(rule):
    rng = np.random.default_rng(0)
    streams = [stream_of(rng.standard_normal(n), number=i) for i, n in enumerate((30, 41, 30, 1))]
    found = {s.recording: made for s, made in decide(streams, settings_of(rule), TIMING)}
    assert len(found) == len(streams)
    for stream in streams:
        alone = Decider(settings_of(rule), RATE_HZ, 100, 25).decide(stream.score, stream.is_valid)
        for ours, theirs in zip(found[stream.recording], alone, strict=True):
            torch.testing.assert_close(ours, theirs, rtol=1e-6, atol=1e-6)


def test_a_longer_hop_leaves_decisions_out():
    score, coarse = np.random.default_rng(1).standard_normal(23), TIMING._replace(hop_samples=100)
    ((_, made),) = decide([stream_of(score)], settings_of(hop=100), TIMING)
    ((_, thinned),) = decide([stream_of(score[::5])], settings_of(hop=100), coarse)
    assert torch.equal(made.statistic, thinned.statistic)
    assert made.available_s[1] - made.available_s[0] == pytest.approx(0.05)


def test_a_score_that_tells_nothing_is_neutral():
    usable = [True, False, True, True]
    ((_, made),) = decide([stream_of([3, 3, 3, -3], is_usable=usable)], settings_of(), TIMING)
    assert (made.llr != 0).tolist() == usable


def test_bins_over_the_edge_of_a_slide_have_no_label():
    score = torch.arange(60.0)
    kept, is_slip = labelled([stream_of(score, [(0.2, 0.4)])], TIMING)
    expected = {}
    for number in range(60):
        start, end = number * 0.01, number * 0.01 + 0.05
        inside = start >= 0.2 - 1e-9 and end <= 0.4 + 1e-9
        if inside or end <= 0.2 + 1e-9 or start >= 0.4 - 1e-9:
            expected[number] = inside
    assert dict(zip(kept.tolist(), is_slip.tolist(), strict=True)) == expected


SLIDES = [(0.3, 0.5), (0.8, 1.0)]


def test_alarms_their_ends_and_first_slip_decisions_by_a_plain_loop():
    rng = np.random.default_rng(2)
    stream = stream_of(np.repeat(rng.standard_normal(40), 3), SLIDES)
    ((_, made),) = decide([stream], settings_of(), TIMING)
    seen = watched(stream, made)
    alarms = [i for i in range(120) if made.is_alarm[i]]
    assert len(alarms) >= 2
    assert seen.alarms_s == tuple((i * 20 + 125) / RATE_HZ for i in alarms)
    for raised, end in zip(alarms, seen.alarm_ends_s, strict=True):
        off = [i for i in range(raised, 120) if not made.is_on[i]]
        assert end == (made.available_s[off[0]] if off else math.inf)
    decisions = list(zip(made.available_s.tolist(), made.llr.tolist(), strict=True))
    for onset, first in zip((0.3, 0.8), seen.first_positive_s, strict=True):
        assert first == next(t for t, llr in decisions if t >= onset and llr > 0)
    released_s = ((0.1, 0.35), (0.62, 0.8))
    told = watched(stream._replace(times=times_of(2.0, SLIDES, released_s)), made)
    assert told.released_s == released_s
    for (release, _), first in zip(released_s, told.first_positive_s, strict=True):
        assert first == next(t for t, llr in decisions if t >= release and llr > 0)


# ------------------------------------------------------------------------------ without a rate
def test_debounced_settings_are_kept_in_the_file_with_no_rate(tmp_path):
    detector = small_detector(3)
    detector.info["calibration"] = Platt(2.0, -0.5).to_dict()
    DebouncedAlarm(k=1, n=4, probability=0.8, slip_share=0.25)(detector)
    detector.save(tmp_path / "a.pt")
    settings = AlarmSettings.of(SlipDetector.load(tmp_path / "a.pt"))
    assert settings.target_per_hour is None
    assert settings.calibration == Platt(2.0, -0.5)
    assert settings.rule == KOfN(1, 4)
    assert settings.hop_samples == detector.pool.bin_samples // 2
    # at the threshold, odds of slip are those of its fraction times the likelihood ratio
    odds = math.exp(settings.threshold) * 0.25 / 0.75
    assert odds / (1 + odds) == pytest.approx(0.8)
    detector.info = {}
    with pytest.raises(ValueError, match=r"training chose nothing; give several recipe\.penalties"):
        DebouncedAlarm()(detector)


def test_a_debounced_hop_is_half_a_bin_or_so_many_milliseconds():
    assert DebouncedAlarm().hop_samples(2000.0, 100) == 50
    assert DebouncedAlarm().hop_samples(2000.0, 1) == 1
    assert DebouncedAlarm(hop_ms=2.5).hop_samples(2000.0, 100) == 5
    with pytest.raises(ValueError, match=r"onset\.hop_ms=0\.3 is 0\.6 samples"):
        DebouncedAlarm(hop_ms=0.3).hop_samples(2000.0, 100)


# --------------------------------------------------------------------------------- the experiment
@pytest.mark.slow
def test_the_experiment_has_ten_hours_to_set_the_alarm_and_as_many_to_check_it():
    config = composed("+exp=onset")
    source: RecordingSource = instantiate(config.data, _convert_="all")
    (fold,) = instantiate(config.split, _convert_="all")(source.ids)
    trained = fold.having("train")
    info = {
        "train_materials": sorted({r.material for r in trained}),
        "train_recordings": {str(r): cache_key(source.key(r)) for r in trained},
    }
    whole: CalibratedAlarm = instantiate(config.onset, _convert_="all")
    roles = whole.roles(SimpleNamespace(info=info))
    assert {r.material for r in roles["unseen"]} == {"iron", "cloth", "copper", "wood"}
    used = {recording for own in roles.values() for recording in own}
    assert len(used) == sum(map(len, roles.values()))
    for recording in used.intersection(trained):  # of the same name, but another recording
        assert cache_key(whole.streams.key(recording)) != cache_key(source.key(recording))
    for own in roles.values():
        quiet = [r for r in own if r.scene == "held"]
        assert sum(whole.streams.timeline(r).duration_s for r in quiet) >= 36_000
    assert {"taps", "machine", "mains_bursts", "dead_channel"} <= {r.scene for r in roles["test"]}


def test_one_alarm_for_several_detectors_is_refused_before_the_fit(tmp_path):
    config = composed("onset=alarms", "split=leave_one_material_out", "data.cycles=2")
    with pytest.raises(ValueError, match="sets the alarm of one detector, this split makes 10"):
        train(config, tmp_path)


@pytest.mark.slow
def test_training_sets_the_alarm_of_the_file_it_leaves(tmp_path, capsys):
    dropped = ("taps", "grips", "machine", "mains_bursts", "pulled", "arm_motion")
    config = composed(
        "onset=alarms",
        "data.cycles=2",
        "data.materials=[M1,M6,iron]",
        "split.seen=[M1,M6]",
        "split.unseen=[iron]",
        "split.train_fraction=0.5",
        "recipe.num_features=20",
        "recipe.penalties=[0.01]",
        "recipe.sample_bins=60",
        "onset.streams.cycles=4",
        "onset.streams.extra_scenes.held.cycles=2",
        "onset.streams.extra_scenes.held.tail_s=4.0",
        "onset.streams.extra_scenes.dead_channel.cycles=1",
        "onset.hop_ms=25.0",
        *(f"~onset.streams.extra_scenes.{name}" for name in dropped),
        "cache=off",
        "num_workers=0",
        "export=false",
    )
    train(config, tmp_path)
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    settings = AlarmSettings.of(SlipDetector.load(tmp_path / "detector.pt"))
    assert metrics["alarm"]["settings"] == settings.to_dict()
    assert settings.metadata["simulated"] is True
    assert {"test", "unseen", "test stream", "unseen stream"} <= set(metrics["events"])
    assert metrics["alarm"]["scenes"]["dead_channel"]["test"]["cusum"]["num_onsets"] > 0
    assert "asked for: 1 false alarms an hour of held" in capsys.readouterr().out
    assert {"alarm.png", "events.png"} <= {path.name for path in tmp_path.iterdir()}

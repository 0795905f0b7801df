"""Stages behind the fit: who calibrates, which budgets are kept; evaluated streams set nothing."""

import json
import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from drawing import assert_png
from hydra.utils import instantiate
from small_detector import small_detector
from small_set import RATE_HZ, SMALL_HAND, NoiseRecordings
from test_commands import composed

from tactslip_torch.commands.train import train
from tactslip_torch.data.recording import RecordingId, RecordingSource, Timeline
from tactslip_torch.features.cache import cache_key
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.model.calibration import Platt
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.kernels import QuadraticForm
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.onset.decisions import KEY, AlarmSettings, Decider, score_stream
from tactslip_torch.onset.events import EventRules, LatencyParts, recording_events
from tactslip_torch.onset.evidence import OnsetClassifier, OnsetEvidence
from tactslip_torch.onset.rules import NOTHING_YET, Cusum, KOfN
from tactslip_torch.report.results import _alarm_figure, _alarm_table, _confounder_rows
from tactslip_torch.signals.filtering import ChannelFilter
from tactslip_torch.simulation import CONFOUNDERS
from tactslip_torch.training import alarm
from tactslip_torch.training.onset import OnsetTraining

RULE = {"name": "cusum", "drift": 0.5, "evidence": 0.4}
LEARNED = OnsetTraining(head="quadratic", epochs=3, folds=2)
TRAINED = [RecordingId(m, 0, s) for m in ("a", "b") for s in ("paper", "held")]
TIMING = alarm.Timing(RATE_HZ, 20, 100, 25)
SCENES = ("paper", "held", "taps")
BARE = {"held": 1e6}


def times_of(slides=(), duration_s=3.0, **stretches) -> Timeline:
    onsets_s, speeds_mm_s = tuple(start for start, _ in slides), (20.0,) * len(slides)
    truth = onsets_s, onsets_s, speeds_mm_s, tuple(slides)
    return Timeline(*truth, duration_s=duration_s, **stretches)


class Streams(NoiseRecordings):
    """Noise with a burst at onsets, louder in slides, with two knocks in taps; one material new."""

    materials = ("a", "b", "new")

    is_simulated = True

    def __init__(self, gain_of=None, cycles=6, scenes=SCENES, **_) -> None:
        self.ids = tuple(
            RecordingId(material, cycle, scene)
            for scene in scenes
            for material in self.materials
            for cycle in range(cycles)
        )
        self.gain_of = gain_of or (lambda recording: 1.0)

    def timeline(self, recording):
        if recording.scene == "taps":
            return times_of(non_slip_s=((1.2, 1.3), (2.0, 2.1)))
        return times_of(slides=((2.1, 2.9),) if recording.scene == "paper" else ())

    def shape(self, noise, time_s, recording, generator):
        times = self.timeline(recording)
        for start_s, end_s in times.sliding_s:
            onset = round(start_s * RATE_HZ)
            noise[:, onset : round(end_s * RATE_HZ)] *= 2.0
            noise[:, onset : onset + 60] *= 2.0
        for start_s, _ in times.non_slip_s:
            knock = round(start_s * RATE_HZ) + 20
            noise[1, knock : knock + 60] *= 3.0
        noise *= self.gain_of(recording)


class Worlds(Streams):
    """What is learned from: other noise, of two materials."""

    materials = ("a", "b")

    def __init__(self, gain_of=None, cycles=2, **_) -> None:
        super().__init__(gain_of, cycles)

    def seed(self, recording):
        return 3 + super().seed(recording)


def loudness_detector() -> SlipDetector:
    """One feature: the spread of the fast channel; positive above some 1.5 times that of rest."""
    pool, one = FeaturePool(SMALL_HAND), torch.ones(1).double()
    place = [str(name) for name in pool.names].index("PVDF1 A1 time std")
    head = QuadraticForm(torch.zeros(1, 1).double(), 4 * one, torch.tensor(1.04)).double()
    info = {
        "train_materials": ["a", "b"],
        "train_recordings": {str(r): cache_key({"id": str(r)}) for r in TRAINED},
    }
    layer, scaler = ChannelFilter([51, 11]), FeatureScaler(0 * one, one)
    return SlipDetector(pool, layer, [place], scaler, head, info)


def stage(streams=None, **changes) -> alarm.CalibratedAlarm:
    values = {"streams": streams or Streams(), "worlds": Worlds(), "classifier": LEARNED}
    values |= {"rule": RULE, "hop_ms": 25.0, "slip_free": "held", "with_slips": "paper"}
    values |= {"check_hours": {"others": 10.0}, "hint_per_hour": 3000.0}
    values |= {"budget": {"confounders": 3000.0, "held": 2000.0}}
    values |= {"hours": {"held": 11 / 3600, "paper": 8 / 3600, "others": 8 / 3600}}
    return alarm.CalibratedAlarm(**(values | changes))


@pytest.fixture(scope="module")
def calibrated():
    """A detector with its alarm, and the report; beside it the same score at another hop."""
    detector = loudness_detector()
    return detector, stage()(detector, {"loud": loudness_detector()}, num_workers=0)


# ------------------------------------------------------------------------------- who calibrates
def test_fresh_recordings_calibrate_then_test_and_held_out_ones_test_alone():
    """Of 3 s each: 4 of held make up 11 s, and 3 of others 8 s; the first cycle was trained on."""
    made = stage(check_hours={"others": 17 / 3600, "held": 8 / 3600})
    found = {
        role: {scene: [(r.cycle, r.material) for r in own if r.scene == scene] for scene in SCENES}
        for role, own in made.roles(loudness_detector()).items()
    }

    def pairs(*cycles):
        return [(cycle, material) for cycle in cycles for material in "ab"]

    new = [(cycle, "new") for cycle in range(6)]
    test = {
        "paper": [(2, "b"), *pairs(3, 4), (5, "a")],  # until 17 s are there
        "held": pairs(3, 4)[:3],  # until 8 s are there
        "taps": [(1, "b"), *pairs(2, 3), (4, "a")],
    }
    assert found == {
        "calibrate": {"paper": pairs(1, 2)[:3], "held": pairs(1, 2), "taps": pairs(0, 1)[:3]},
        "test": test,
        "unseen": {"paper": new, "held": new[:3], "taps": new},
    }


def test_too_few_hours_are_told_and_a_scene_without_any_is_refused(caplog):
    stage().roles(loudness_detector())
    assert not caplog.text
    of_others = {"paper": 8 / 3600, "others": 8 / 3600}
    stage(hours={"held": 1.0, **of_others}).roles(loudness_detector())
    assert "0.01 h of held are left to calibrate on, onset.hours asks for 1: give" in caplog.text
    few = stage(Streams(cycles=1), budget=BARE, hours={"held": 0.0, **of_others})
    with pytest.raises(ValueError, match="0 h of held cannot show"):
        few.roles(loudness_detector())
    few = stage(
        Streams(cycles=1), budget={**BARE}, hours={"others": 1.0, "paper": 0.0, "held": 1.0}
    )
    few.streams.ids = tuple(r for r in few.streams.ids if r.cycle or r.scene != "held")
    with pytest.raises(ValueError, match="0 h of held cannot show"):
        few.roles(loudness_detector())


BEYOND_THE_HOURS = [
    ({"held": 10.0}, r"0\.00333 h of held cannot show a rate of at most 10 .* 0\.3 h"),
    ({"held": 2000.0, "confounders": 100.0}, r"0\.0025 h of confounders cannot .* least 0\.03 h"),
    ({"held": 2000.0, "taps": 100.0}, r"0\.0025 h of taps cannot show .* least 0\.03 h"),
]


@pytest.mark.parametrize(("budget", "match"), BEYOND_THE_HOURS)
def test_a_budget_that_cannot_be_shown_is_refused_before_anything_is_read(budget, match):
    source = Streams()
    source.load = None
    with pytest.raises(ValueError, match=match):
        stage(source, budget=budget)(loudness_detector(), num_workers=0)


REFUSED = [
    (stage, {"hop_ms": 0.0}, "onset.hop_ms must be a positive finite number, got 0"),
    (stage, {"hop_ms": 0.3}, r"onset\.hop_ms=0\.3 is 0\.6 samples at 2000 Hz"),
    (OnsetTraining, {"epochs": 0}, "epochs must be a positive whole number, got 0"),
    (stage, {"hint_per_hour": 0.0}, "onset.hint_per_hour must be a positive finite number, got 0"),
    (stage, {"rule": {"name": "sum"}}, "no sequential rule is called 'sum'"),
    (stage, {"rearm_s": -1.0}, "rearm_s must be a finite number of at least 0, got -1"),
    (stage, {"slip_free": "heldd"}, "no scene 'heldd', it has held, paper, taps; take it out"),
    (stage, {"budget": BARE | {"tap": 1.0}}, "onset.streams has no scene 'tap'"),
    (stage, {"budget": BARE | {"taps": 0.0}}, "onset.budget.taps must be a positive finite number"),
    (stage, {"budget": {"taps": 1.0}}, "onset.budget must say what held may have, an hour"),
    (alarm.DebouncedAlarm, {"k": 4}, "k must lie between 1 and n"),
    (alarm.DebouncedAlarm, {"k": "a"}, "onset.k must be a positive whole number, got 'a'"),
]


@pytest.mark.parametrize(("made", "changes", "match"), REFUSED)
def test_bad_settings_are_refused_in_one_line(made, changes, match):
    with pytest.raises(ValueError, match=match):
        made(**changes)


# --------------------------------------------------------------------------- budgets of the file
def recounted(detector, settings, scenes):
    """False alarms and quiet hours of what calibrates, one by one, by the rules of events."""
    alarms, hours, source = 0, 0.0, Streams()
    latency = LatencyParts(detector.look_ahead / RATE_HZ, 0.05)
    roles, none = stage().roles(detector), torch.empty(0)
    _, left_out, _ = LEARNED(Worlds(), Worlds().ids, 0)
    for recording in (one for one in roles["calibrate"] if one.scene in scenes):
        samples = source.load(recording).samples
        scores = score_stream(detector, samples, settings.hop_samples)
        decider = Decider(settings, RATE_HZ, 100, detector.look_ahead)
        bins = decider.decide(scores.score, scores.is_valid)
        made = decider.join(bins, left_out[recording.material].score_recording(samples))
        stream = alarm.Stream(recording, source.timeline(recording), none, none, none)
        found = recording_events(alarm.event_record(stream, made), EventRules(), latency)
        alarms += len(found.false_alarms_s)
        hours += float((made.onset_score > NOTHING_YET).sum()) * 0.005 / 3600
    return alarms, hours


def test_the_alarm_of_the_file_keeps_every_budget_and_a_lower_threshold_does_not(calibrated):
    detector, _ = calibrated
    settings = AlarmSettings.of(detector)
    rows = {row["scene"]: row for row in settings.metadata["budget"]}
    # 10.9 s at 2000 an hour are 6.1 alarms, and one shows up to 1560; 8.2 s at 3000: 6.8, two 2770
    assert {scene: row["allowed"] for scene, row in rows.items()} == {"held": 1, "confounders": 2}
    for scene, scenes in {"held": ("held",), "confounders": ("taps",)}.items():
        row = rows[scene]
        alarms, hours = recounted(detector, settings, scenes)
        assert row["alarms"] == alarms <= row["allowed"]
        assert row["amount"] == pytest.approx(hours)
        assert row["bound"] <= row["limit"]
    lower = settings.at_threshold(settings.onset.threshold - 0.5)
    counts = {scene: recounted(detector, lower, (scene,))[0] for scene in ("held", "taps")}
    assert counts["held"] > 1 or counts["taps"] > 2
    assert settings.onset.hint <= settings.onset.threshold
    hinted = settings.at_threshold(settings.onset.hint)
    alarms, hours = recounted(detector, hinted, ("taps",))
    assert alarms <= 3000 * hours
    told = settings.metadata["calibrated"]
    assert told["rate"]["alarms"] == rows["held"]["alarms"]


def test_thresholds_of_the_curve_give_its_rates(calibrated):
    detector, found = calibrated
    settings = AlarmSettings.of(detector)
    curve = settings.metadata["threshold_curve"]
    assert found["settings"]["metadata"]["threshold_curve"] == curve
    assert 1 <= len(curve) <= 25
    thresholds, rates = zip(*curve, strict=True)
    assert list(thresholds) == sorted(set(thresholds))
    assert list(rates) == sorted(set(rates), reverse=True)
    assert alarm.LEAST <= rates[-1] <= rates[0] <= alarm.MOST
    for threshold, rate in curve:
        alarms, hours = recounted(detector, settings.at_threshold(threshold), ("held",))
        assert alarms / hours == pytest.approx(rate)


def test_evaluated_streams_set_nothing():
    plain, made = loudness_detector(), []
    roles = stage().roles(plain)
    evaluated = {*roles["test"], *roles["unseen"]}
    learning = set(Worlds().ids[:2])
    for louder in (set(), evaluated, set(roles["calibrate"])):
        source = Streams(lambda r, of=louder: of_time if r in of else 1.0)
        stage(source)(plain, num_workers=0)
        made.append(plain.info[KEY])
    worlds = Worlds(lambda r: of_time if r in learning else 1.0)
    stage(worlds=worlds)(plain, num_workers=0)
    none, of_evaluated, of_calibrating, of_learning = *made, plain.info[KEY]
    assert of_evaluated == none
    assert of_calibrating["onset"]["threshold"] != none["onset"]["threshold"]
    assert of_calibrating["onset"]["head"] == none["onset"]["head"]
    assert of_learning["onset"]["head"] != none["onset"]["head"]
    assert of_calibrating["levels"] != none["levels"] == of_learning["levels"]


def test_slips_are_found_in_time_and_all_is_told_in_plain_json(calibrated, tmp_path):
    detector, found = calibrated
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    own = alarm.SLIPPING_NOW
    assert (found["rule"], found["methods"][own]["onset"]) == (own, True)
    ours = found["events"]["test stream"][own]
    assert ours["num_onsets"] == 7
    assert ours["num_found"] >= 5
    assert 0 < ours["delay_ms"]["median"]["value"] < 200
    assert set(found["events"]["unseen stream"]) == {
        alarm.SLIPPING_NOW,
        "cusum",
        alarm.FIRST_TRANSITION,
        "loud",
    }
    taps, streams = found["scenes"]["taps"], found["streams"]
    assert (taps.keys(), taps["trained"]) == ({"trained", "test", "unseen"}, True)
    assert taps["test"][alarm.SLIPPING_NOW]["quiet_hours"] == pytest.approx(27 / 3600)
    assert set(streams) == {"calibrate", "test", "unseen"}
    held = {"recordings": 4, "hours": 12 / 3600, "slips": 0}
    assert streams["calibrate"]["held"] == pytest.approx(held)
    assert found["classifier"]["slips"] == 4
    rows = {(r["role"], r["scene"], r["method"]): r for r in found["budget"]}
    assert rows["test", "held", own]["limit"] == 2000
    assert rows["unseen", "taps", own]["limit"] is None
    assert found["reliability"]["test stream"]["ece"] < 0.2
    assert set(found["reliability"]["test stream"]["per_material"]) == {"a", "b"}
    settings = AlarmSettings.of(detector)
    detector.save(tmp_path / "detector.pt")
    read = AlarmSettings.of(SlipDetector.load(tmp_path / "detector.pt"))
    assert read.to_dict() == settings.to_dict() == found["settings"]
    with pytest.raises(ValueError, match=r"no alarm threshold; train .*onset=debounced"):
        AlarmSettings.of(loudness_detector())
    metrics = {"simulated": True, "events": found["events"], "alarm": found}
    assert _alarm_table(metrics).startswith("SIMULATED")
    row = next(row for row in _confounder_rows(metrics) if row["scene"] == "taps")
    assert (row["materials"], row["trained on"]) == ("seen", True)
    _alarm_figure(metrics, tmp_path / "alarm.png")
    assert_png(tmp_path / "alarm.png")


def test_the_papers_rule_is_left_out_where_its_hop_cannot_be():
    detector, timing = loudness_detector(), alarm.Timing(RATE_HZ, 40, 100, 25)
    made, onset = stage(hop_ms=20.0), onset_of()
    calibrate = made.roles(detector)["calibrate"]
    own = alarm.score_streams(
        made.streams, calibrate, {alarm.OURS: detector}, {alarm.OURS: 40}, onset, 0
    )
    assert set(made.methods(own, {alarm.OURS: timing}, onset)) == {alarm.SLIPPING_NOW, "cusum"}


# -------------------------------------------------------------------------- streams and decisions
def onset_of() -> OnsetClassifier:
    """A machine that nobody trained."""
    evidence = OnsetEvidence(SMALL_HAND, RATE_HZ)
    ones = torch.ones(evidence.num_columns, dtype=torch.float64)
    head = QuadraticForm(torch.zeros(0, 0).double(), ones, torch.tensor(0.0).double())
    return OnsetClassifier(evidence, FeatureScaler(-ones, ones), head, math.inf)


def stream_of(
    score, slides=(), number=0, duration_s=2.0, scene="held", onset=(), **times
) -> alarm.Stream:
    score = torch.as_tensor(score, dtype=torch.float32)
    valid, recording = torch.ones(len(score)) > 0, RecordingId("a", number, scene)
    hops = torch.as_tensor(onset, dtype=torch.float64)
    return alarm.Stream(recording, times_of(slides, duration_s, **times), score, valid, hops)


of_time = torch.linspace(1.0, 1.5, round(3.0 * RATE_HZ))
"""A gain that rises, as one that stays is no evidence."""


def knocked(number: int) -> np.ndarray:
    """Scores of 10 s without slip, with double knocks, one to a sum without ceiling."""
    rng = np.random.default_rng(number)
    score = -1.0 + 0.2 * rng.standard_normal(1000)
    for start in rng.integers(0, 900, 2):
        for knock in (start, start + 45):
            score[knock : knock + 12] = rng.uniform(0.5, 3.0)
    return score


def scored_streams(num=24):
    """Double knocks of bins, noise of the classifier's scores, and slips that it finds late."""
    streams, rng = [], np.random.default_rng(5)
    for number in range(num):
        scene = ("held", "taps", "paper")[number % 3]
        onset = rng.standard_normal(2000)
        told = {"onset": onset, "number": number, "scene": scene}
        if scene == "taps":
            onset[rng.integers(0, 2000, 5)] += 3
        if scene == "paper":
            told["slides"] = [(4.0, 5.0)]
            onset[802] = 30.0  # the hop that ends at 4.015 s
        streams.append(stream_of(knocked(number), duration_s=10.0, **told))
    return streams


@pytest.mark.parametrize("onset", [True, False])
@pytest.mark.parametrize("rule", [Cusum(1.0, 0.2), KOfN(2, 3)], ids=lambda rule: rule.name)
def test_thresholds_are_the_lowest_that_keep_every_budget(rule, onset):
    streams = scored_streams()
    made = stage(budget={"held": 400.0, "confounders": 500.0}, rearm_s=0.05, refractory_s=0.0)
    classifier = onset_of() if onset else None
    settings = made.calibrated(rule, Platt(2.0, 0.0), streams, TIMING, classifier)
    latency = LatencyParts(25 / RATE_HZ, 0.05)

    def alarms(settings):
        counts = dict.fromkeys(SCENES, 0)
        for stream in streams:
            decider = Decider(settings, RATE_HZ, 100, 25)
            bins = decider.decide(stream.score, stream.is_valid)
            seen = decider.join(bins, stream.onset_score) if onset else bins
            found = recording_events(alarm.event_record(stream, seen), EventRules(), latency)
            counts[stream.recording.scene] += len(found.false_alarms_s)
        return {"held": counts["held"], "confounders": counts["taps"]}

    # 80 s at 400 an hour: 8.9, 4 show 9.15 and 3 show 7.75; at 500: 11.1, 5 show 10.5, 6 show 11.8
    allowed = {"held": 3, "confounders": 5}
    assert {row["scene"]: row["allowed"] for row in settings.metadata["budget"]} == allowed
    told = {row["scene"]: row["alarms"] for row in settings.metadata["budget"]}
    assert told == alarms(settings)
    assert all(told[scene] <= most for scene, most in allowed.items())
    if not onset:
        assert settings.rule.ceiling in (math.inf, pytest.approx(1.5 * settings.threshold))
        return
    values = torch.cat([stream.onset_score for stream in streams])
    below = float(values[values < settings.onset.threshold].max())
    fewer = alarms(settings.at_threshold(below))
    assert any(fewer[scene] > most for scene, most in allowed.items())
    assert settings.onset.lead_s == pytest.approx(0.015)


def test_a_sum_that_is_never_positive_in_quiet_does_not_stand_for_ever():
    quiet = [stream_of(np.full(194, -5.0), number=n, onset=np.zeros(400)) for n in range(2)]
    made = stage(budget={"held": 1e5})
    settings = made.calibrated(Cusum(1.0, 0.2), Platt(2.0, 0.0), quiet, TIMING)
    assert settings.threshold > 0


def test_a_threshold_that_is_never_reached_is_refused():
    with pytest.raises(ValueError, match=r"threshold 7\.6 lies above 7\.5, .* lower it"):
        AlarmSettings(20, Platt(2.0, 0.1), Cusum(1.0, 0.2, 7.5), 7.6, target_per_hour=1.0)


def test_bins_over_the_edge_of_a_slide_have_no_label():
    kept, is_slip = alarm._labelled([stream_of(torch.arange(60.0), [(0.2, 0.4)])], TIMING)
    starts, expected = np.arange(60) * 0.01, {}
    for number, (start, end) in enumerate(zip(starts, starts + 0.05, strict=True)):
        inside = start >= 0.2 - 1e-9 and end <= 0.4 + 1e-9
        if inside or end <= 0.2 + 1e-9 or start >= 0.4 - 1e-9:
            expected[number] = inside
    assert dict(zip(kept.tolist(), is_slip.tolist(), strict=True)) == expected


# ------------------------------------------------------------------------------ without a rate
def test_debounced_settings_are_kept_in_the_file_with_no_rate(tmp_path):
    detector = small_detector(3)
    detector.info["calibration"] = Platt(2.0, -0.5).to_dict()
    alarm.DebouncedAlarm(k=1, n=4, probability=0.8, slip_share=0.25)(detector)
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
    with pytest.raises(
        ValueError, match=r"scores of recordings left out, .* several recipe\.penalties"
    ):
        alarm.DebouncedAlarm()(detector)


def test_enough_labelled_slips_of_ones_own_get_a_classifier_and_fewer_keep_the_rule(caplog):
    source = Worlds()
    detector = loudness_detector()
    detector.info["train_recordings"] = {str(recording): "" for recording in source.ids}
    detector.info["calibration"] = Platt(2.0, -0.5).to_dict()
    made = alarm.DebouncedAlarm(classifier=LEARNED, fewest_slips=4)
    made(detector)
    report = made.fit(detector, source, num_workers=0)
    settings = AlarmSettings.of(detector)
    assert (report["slips"], settings.target_per_hour) == (4, None)
    assert settings.onset.threshold == report["heads"]["quadratic"]["threshold"]
    again, _, _ = LEARNED(source, source.ids, 0)
    assert settings.onset.to_dict()["head"] == again.to_dict()["head"]
    few = loudness_detector()
    few.info |= {"calibration": detector.info["calibration"]}
    made(few)
    assert made.fit(few, source, num_workers=0) == {}  # two of these slips were trained on
    assert AlarmSettings.of(few).onset is None
    assert (
        "2 labelled slips are too few for a classifier of slipping now, which needs 4"
        in caplog.text
    )


def test_a_debounced_hop_is_half_a_bin_or_so_many_milliseconds():
    assert alarm.DebouncedAlarm().hop_samples(2000.0, 100) == 50
    assert alarm.DebouncedAlarm().hop_samples(2000.0, 1) == 1
    assert alarm.DebouncedAlarm(hop_ms=2.5).hop_samples(2000.0, 100) == 5


# --------------------------------------------------------------------------------- the experiment
@pytest.mark.slow
def test_the_experiment_has_ten_hours_to_set_the_alarm_and_all_scenes_to_check_it(caplog):
    config = composed("+exp=onset")
    source: RecordingSource = instantiate(config.data, _convert_="all")
    (fold,) = instantiate(config.split, _convert_="all")(source.ids)
    trained = fold.having("train")
    info = {
        "train_materials": sorted({r.material for r in trained}),
        "train_recordings": {str(r): cache_key(source.key(r)) for r in trained},
    }
    whole: alarm.CalibratedAlarm = instantiate(config.onset, _convert_="all")
    roles = whole.roles(SimpleNamespace(info=info))
    assert not caplog.text  # there are as many hours as were asked for
    assert {r.material for r in roles["unseen"]} == {"iron", "cloth", "copper", "wood"}
    used = {recording for own in roles.values() for recording in own}
    assert len(used) == sum(map(len, roles.values()))
    for recording in used.intersection(trained):  # of the same name, but another recording
        assert cache_key(whole.streams.key(recording)) != cache_key(source.key(recording))
    quiet = [r for r in roles["calibrate"] if r.scene == "held"]
    assert sum(whole.streams.timeline(r).duration_s for r in quiet) >= 36_000
    of_learning = {json.dumps(dict(whole.worlds.key(r)), sort_keys=True) for r in whole.worlds.ids}
    for recording in whole.streams.ids[:300]:
        assert json.dumps(dict(whole.streams.key(recording)), sort_keys=True) not in of_learning
    kinds = {recording.scene for recording in whole.worlds.ids}
    assert len(whole.worlds.ids) >= 1400
    assert sum(recording.scene == "slip" for recording in whole.worlds.ids) >= 800
    for own in roles.values():
        assert {recording.scene for recording in own} == kinds == {"slip", *CONFOUNDERS}


def test_one_alarm_for_several_detectors_is_refused_before_the_fit(tmp_path):
    config = composed("onset=alarms", "split=leave_one_material_out", "data.cycles=2")
    with pytest.raises(ValueError, match="sets the alarm of one detector, this split makes 10"):
        train(config, tmp_path)


@pytest.mark.slow
def test_training_sets_the_alarm_of_the_file_it_leaves(tmp_path, capsys):
    replaced = {
        "streams": "{_target_: test_alarm.Streams}",
        "worlds": "{_target_: test_alarm.Worlds}",
        "budget": "{held: 2000, confounders: 3000}",
        "hours": "{held: 0.003, paper: 0.002, others: 0.002}",
        "check_hours": "{others: 0.1}",
    }
    config = composed(
        *("data._target_=test_alarm.Streams", "+data.scenes=[paper]", "data.cycles=2"),
        *("split.seen=[a,b]", "split.unseen=[new]", "split.train_fraction=0.5"),
        *("onset=alarms", "onset.classifier.epochs=2", "onset.classifier.head=quadratic"),
        *("onset.with_slips=paper", "onset.hint_per_hour=3000"),
        *(f"~onset.{key}" for key in replaced),
        *(f"+onset.{key}={value}" for key, value in replaced.items()),
        *("recipe=paper", "recipe.num_features=10", "cache=off", "num_workers=0", "export=false"),
    )
    train(config, tmp_path)
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    settings = AlarmSettings.of(SlipDetector.load(tmp_path / "detector.pt"))
    assert metrics["alarm"]["settings"] == settings.to_dict()
    assert settings.metadata["simulated"] is True
    assert {"test", "unseen", "test stream", "unseen stream"} <= set(metrics["events"])
    assert metrics["events"]["test stream"][alarm.SLIPPING_NOW]["num_onsets"] > 0
    assert "budget of false alarms, at 95 % confidence: held 2000 " in capsys.readouterr().out
    assert {"alarm.png", "events.png"} <= {path.name for path in tmp_path.iterdir()}

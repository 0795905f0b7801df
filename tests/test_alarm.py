"""The stage behind the fit: who calibrates, what is promised; judged streams set nothing."""

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from small_set import RATE_HZ, SMALL_HAND

from tactslip_torch.commands.entry import conf_dir
from tactslip_torch.commands.train import train
from tactslip_torch.data.recording import Recording, RecordingId, RecordingSource
from tactslip_torch.features.cache import cache_key
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.model.calibration import Isotonic, Platt
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.kernels import QuadraticForm
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.onset.decisions import Decider
from tactslip_torch.onset.rules import Cusum, KOfN
from tactslip_torch.onset.settings import KEY, AlarmSettings
from tactslip_torch.onset.streaming import StreamingDetector
from tactslip_torch.report.results import alarm_figure, alarm_table, scene_rows
from tactslip_torch.signals.filtering import ChannelFilter
from tactslip_torch.training.alarm import (
    FIRST_TRANSITION,
    FITS,
    LEAST,
    MOST,
    OURS,
    CalibratedAlarm,
    labelled,
)
from tactslip_torch.training.stream_evaluation import (
    Clock,
    Stream,
    decide,
    slip_bins,
    watch,
    watched,
)

RULES = {
    "cusum": {"name": "cusum", "drift": 0.5, "evidence": 0.4},
    "k_of_n": {"name": "k_of_n", "k": 2, "n": 3},
}


class Times:
    """Of a slide from 2.1 s to 2.9 s in 3 s, or of 3 s without one."""

    duration_s = 3.0

    def __init__(self, slides: bool) -> None:
        self.onsets_s = self.annotated_onsets_s = (2.1,) if slides else ()
        self.sliding_s = ((2.1, 2.9),) if slides else ()
        self.speeds_mm_s = (20.0,) if slides else ()
        self.non_slip_s = () if slides else ((0.0, 3.0),)
        self.slip_s = self.missing_s = ()


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
        return Times(recording.scene == "paper")

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
    """One feature: the spread of the film; positive above some 1.5 times that of rest."""
    pool = FeaturePool(SMALL_HAND)
    place = [str(name) for name in pool.names].index("PVDF1 A1 time std")
    scaler = FeatureScaler(torch.zeros(1).double(), torch.ones(1).double())
    head = QuadraticForm(torch.zeros(1, 1).double(), 4 * torch.ones(1).double(), torch.tensor(1.04))
    info = {
        "train_materials": ["a", "b"],
        "train_recordings": {str(r): cache_key({"id": str(r)}) for r in TRAINED},
    }
    return SlipDetector(pool, ChannelFilter([51, 11]), [place], scaler, head.double(), info)


TRAINED = [RecordingId(m, 0, s) for m in ("a", "b") for s in ("paper", "held")]


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


@pytest.fixture(scope="module")
def told():
    detector = loudness_detector()
    found = stage()(detector, {}, num_workers=0)
    return detector, found


# ------------------------------------------------------------------------------------- who is who
def test_half_of_the_fresh_cycles_calibrate_and_nothing_trained_on_has_a_role():
    roles = stage().roles(loudness_detector())
    assert not set(TRAINED) & {r for own in roles.values() for r in own}
    calibrate, test, unseen = roles["calibrate"], roles["test"], roles["unseen"]
    assert {r.scene for r in calibrate} == {"paper", "held"}
    assert {r.material for r in calibrate} == {"a", "b"} == {r.material for r in test}
    assert {r.material for r in unseen} == {"new"}
    assert len(unseen) == 18
    for material in ("a", "b"):
        for scene in ("paper", "held"):
            own = sorted(r.cycle for r in calibrate if (r.material, r.scene) == (material, scene))
            others = sorted(r.cycle for r in test if (r.material, r.scene) == (material, scene))
            assert (own, others) == ([1, 3, 5], [2, 4])
    assert sum(r.scene == "taps" for r in test) == 12


def test_hours_bound_the_quiet_of_each_role():
    roles = stage(hours=4.5 / 3600).roles(loudness_detector())  # recordings of 3 s
    assert [sum(r.scene == "held" for r in own) for own in roles.values()] == [2, 2, 2]


def test_nothing_left_to_calibrate_on_is_said():
    with pytest.raises(ValueError, match="no recording of scene paper that was not trained on"):
        stage(slip_free="held", streams=Streams(cycles=1)).roles(loudness_detector())


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"rule": "best"}, r"onset\.rule must be one of cusum, k_of_n, got 'best'"),
        ({"calibration": "none"}, r"onset\.calibration must be one of platt, isotonic, got 'none'"),
        ({"hop_ms": 0.0}, r"onset\.hop_ms must be positive, got 0"),
        ({"hop_ms": 0.3}, r"onset\.hop_ms=0\.3 is 0\.6 samples at 2000 Hz"),
        ({"false_alarms_per_hour": -1.0}, r"onset\.false_alarms_per_hour must be positive"),
        ({"hours": math.inf}, r"onset\.hours must be positive"),
        ({"rules": {"cusum": {"name": "sum"}}}, "no sequential rule is called 'sum'"),
        ({"rules": {"cusum": {"drift": 1.0}}}, "no sequential rule is called None"),
        ({"level": 2.0}, r"onset\.level must lie between 0 and 1, got 2"),
        ({"slip_share": 0.0}, "slip_share must lie between 0 and 1, got 0"),
        ({"rearm_s": -1.0}, "rearm_s must not be negative, got -1"),
        ({"slip_free": "heldd"}, "onset.slip_free must be a scene of .* held, paper, taps, got"),
    ],
)
def test_bad_settings_are_refused_in_one_line(changes, match):
    with pytest.raises(ValueError, match=match) as caught:
        stage(**changes)
    assert "\n" not in str(caught.value)


# --------------------------------------------------------------------- what other thresholds give
def test_the_curve_is_what_the_rule_of_the_file_does_at_other_thresholds(told):
    detector, found = told
    settings = AlarmSettings.of(detector)
    curve = settings.facts["threshold_curve"]
    assert found["settings"]["facts"]["threshold_curve"] == curve
    assert json.loads(json.dumps(curve)) == curve
    assert 3 <= len(curve) <= 25
    thresholds, rates = zip(*curve, strict=True)
    assert list(thresholds) == sorted(set(thresholds))
    assert list(rates) == sorted(set(rates), reverse=True)
    assert LEAST <= rates[-1] <= rates[0] <= MOST
    own = stage().roles(detector)["calibrate"]
    quiet = [recording for recording in own if recording.scene == "held"]
    for threshold, rate in curve[:: len(curve) // 3]:
        alarms = hours = 0
        for recording in quiet:
            stream = StreamingDetector(detector, replace(settings, threshold=threshold))
            for made in (stream.push(Streams().load(recording).samples.T), stream.flush()):
                alarms += len(made.alarms)
                hours += len(made.number) * stream.hop_s / 3600
        assert alarms / hours == pytest.approx(rate)


# ------------------------------------------------------------------------------- what is promised
def test_the_threshold_keeps_the_promise_where_it_was_set(told):
    detector, found = told
    settings = AlarmSettings.of(detector)
    roles = stage().roles(detector)
    quiet = [r for r in roles["calibrate"] if r.scene == "held"]
    alarms, hours, found_hours = 0, 0.0, 0.0
    for stream in watch(Streams(), quiet, {OURS: detector}, 50, 0):
        decider = Decider(settings, RATE_HZ, 100, detector.look_ahead)
        score, valid = (torch.from_numpy(part[OURS]) for part in (stream.score, stream.is_valid))
        alarms += len(decider.decide(score, valid).alarms)
        found_hours += len(score) * 0.025 / 3600
        hours += stream.duration_s / 3600
    assert alarms <= math.floor(300.0 * hours)
    assert found["streams"]["calibrate"]["held"]["hours"] == pytest.approx(hours)
    rate = found["settings"]["facts"]["calibrated"]["rate"]
    assert (rate["alarms"], rate["hours"]) == (alarms, pytest.approx(found_hours))


def test_judged_streams_set_nothing(told):
    detector, _ = told
    judged = {r for role in ("test", "unseen") for r in stage().roles(detector)[role]}
    other = loudness_detector()
    stage(Streams(lambda r: 7.0 if r in judged else 1.0))(other, {}, num_workers=0)
    assert other.info[KEY] == detector.info[KEY]
    third = loudness_detector()
    stage(Streams(lambda r: 1.0 if r in judged else 1.3))(third, {}, num_workers=0)
    assert third.info[KEY]["threshold"] != detector.info[KEY]["threshold"]


def test_slips_are_found_in_time_and_all_is_said_in_plain_json(told, tmp_path):
    detector, found = told
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    ours = found["events"]["test stream"]["cusum"]
    assert ours["num_onsets"] == 4
    assert ours["num_found"] + ours["num_early"] == 4
    assert 0 < ours["delay_ms"]["median"]["value"] < 500
    assert set(found["events"]["unseen stream"]) == {*RULES, FIRST_TRANSITION}
    assert found["scenes"]["taps"]["trained"] is False
    assert found["scenes"]["taps"]["test"]["cusum"]["quiet_hours"] == pytest.approx(36 / 3600)
    assert found["reliability"]["test stream"]["ece"] < 0.2
    settings = AlarmSettings.of(detector)
    assert isinstance(settings.rule, Cusum)
    assert settings.rule.ceiling == pytest.approx(1.5 * settings.threshold)
    metrics = {"simulated": True, "events": found["events"], "alarm": found}
    assert "cusum" in alarm_table(metrics)
    assert alarm_table(metrics).startswith("SIMULATED")
    row = next(row for row in scene_rows(metrics) if row[0] == "taps")
    assert row[1:3] == ["seen", "no"]
    alarm_figure(metrics, tmp_path / "alarm.png")
    assert (tmp_path / "alarm.png").stat().st_size > 10_000


def knocked(number: int) -> Stream:
    """Quiet of 30 s with double knocks, which a sum without ceiling takes for one."""
    rng = np.random.default_rng(number)
    score = -1.0 + 0.2 * rng.standard_normal(3000)
    for start in rng.integers(0, 2900, 6):
        for knock in (start, start + 45):
            score[knock : knock + 12] = rng.uniform(0.5, 3.0)
    stream = stream_of(score, number=number, duration_s=30.0)
    return replace(stream, recording=RecordingId("a", number, "held"))


@pytest.mark.parametrize("seed", range(2))
def test_the_rule_of_the_file_keeps_the_rate_not_one_like_it(seed):
    """A sum that gets its ceiling after its threshold was set re-arms sooner, and alarms more."""
    streams = [knocked(20 * seed + number) for number in range(20)]
    made = stage(false_alarms_per_hour=100.0, rearm_s=0.05, refractory_s=0.0)
    method = made.calibrated(OURS, Cusum(1.0, 0.2), Platt(2.0, 0.0), streams, CLOCK)
    made = [made for _, made in decide(streams, OURS, method.settings, CLOCK)]
    alarms = sum(int(one.is_alarm.sum()) for one in made)
    allowed = math.floor(100.0 * sum(len(one.number) for one in made) * 0.01 / 3600)
    assert method.threshold.rate.alarms == alarms <= allowed
    lower = replace(method.settings, threshold=0.8 * method.settings.threshold)
    more = sum(int(one.is_alarm.sum()) for _, one in decide(streams, OURS, lower, CLOCK))
    assert more > allowed


def test_a_calibration_that_ends_bounds_the_threshold():
    streams = [knocked(number) for number in range(10)]
    flat = Isotonic((-1.0, 0.4), (-3.0, 2.0))  # every knock is beyond its last knot
    made = stage(false_alarms_per_hour=1.0, rearm_s=0.05, refractory_s=0.0)
    method = made.calibrated(OURS, KOfN(2, 3), flat, streams, CLOCK)
    assert method.settings.threshold <= 2.0  # slips can still be found,
    assert method.threshold.reached is False  # and it is said that the rate is not kept
    assert method.threshold.rate.alarms > 0


def test_a_threshold_that_is_never_reached_is_refused():
    rule = Cusum(1.0, 0.2, 7.5)
    assert settings_of(rule, threshold=7.5).threshold == 7.5
    with pytest.raises(ValueError, match=r"threshold 7\.6 lies above 7\.5, .* lower it"):
        settings_of(rule, threshold=7.6)


def test_fewer_hours_than_asked_for_are_said(caplog):
    stage(hours=1.0).roles(loudness_detector())
    assert "calibrate has 0.01 h of held, onset.hours=1 were asked for" in caplog.text


def test_the_papers_rule_is_left_out_where_its_hop_cannot_be():
    found = stage(hop_ms=20.0)(loudness_detector(), {}, num_workers=0)
    assert set(found["methods"]) == set(RULES)


def test_evidence_left_open_is_hop_by_bin():
    rules = {"open": {"name": "cusum", "evidence": None}, "cusum": RULES["cusum"]}
    made = stage(rules=rules).made_rules(100)
    assert (made["open"].evidence, made["cusum"].evidence) == (0.5, 0.4)


def test_settings_go_with_the_detector_file(told, tmp_path):
    detector, _ = told
    detector.save(tmp_path / "detector.pt")
    assert AlarmSettings.of(SlipDetector.load(tmp_path / "detector.pt")) == AlarmSettings.of(
        detector
    )
    with pytest.raises(ValueError, match=r"no alarm threshold; train with \+exp=onset"):
        AlarmSettings.of(loudness_detector())


class Backwards:
    """A rival that is quiet in slips."""

    def __init__(self, detector: SlipDetector) -> None:
        self.pool, self.channel_filter = detector.pool, detector.channel_filter
        self.needed_index, self.look_ahead = detector.needed_index, detector.look_ahead
        self._detector = detector

    def predict(self, bins, *, given=None):
        found = self._detector.predict(bins, given=given)
        return found._replace(score=-found.score)


def test_a_rival_whose_scores_are_backwards_is_left_out(caplog):
    detector = loudness_detector()
    found = stage()(detector, {"quiet": Backwards(loudness_detector())}, num_workers=0)
    assert "quiet" not in found["methods"]
    assert "quiet is left out: slip has the lower scores" in caplog.text


# ------------------------------------------------------------------------------------ watching
CLOCK = Clock(RATE_HZ, 20, 100, 25)


def stream_of(score, sliding_s=(), number=0, duration_s=2.0, is_usable=None) -> Stream:
    score = np.asarray(score, dtype=np.float32)
    valid = np.ones(len(score), dtype=bool)
    return Stream(
        RecordingId("a", number),
        duration_s,
        tuple(start for start, _ in sliding_s),
        tuple(sliding_s),
        (20.0,) * len(sliding_s),
        {OURS: score},
        {OURS: valid},
        {OURS: valid if is_usable is None else is_usable},
    )


def settings_of(rule=None, hop=20, **changes) -> AlarmSettings:
    values = {"threshold": 1.0, "target_per_hour": 1.0, "lead_s": 0.01} | changes
    return AlarmSettings(hop, Platt(2.0, 0.1), rule or KOfN(2, 3), **values)


def test_streams_are_decided_together_as_each_alone():
    rng = np.random.default_rng(0)
    streams = [stream_of(rng.standard_normal(n), number=i) for i, n in enumerate((30, 41, 30, 1))]
    for rule in (KOfN(2, 3), Cusum(0.2, 0.5, 4.0)):
        settings = settings_of(rule)
        found = {s.recording: made for s, made in decide(streams, OURS, settings, CLOCK)}
        assert set(found) == {s.recording for s in streams}
        for stream in streams:
            decider = Decider(settings, RATE_HZ, 100, 25)
            alone = decider.decide(
                torch.from_numpy(stream.score[OURS]), torch.from_numpy(stream.is_valid[OURS])
            )
            for ours, theirs in zip(found[stream.recording], alone, strict=True):
                torch.testing.assert_close(ours, theirs, rtol=1e-6, atol=1e-6)  # bools: equal


def test_a_longer_hop_leaves_decisions_out():
    score, coarse = np.random.default_rng(1).standard_normal(23), Clock(RATE_HZ, 100, 100, 25)
    ((_, made),) = decide([stream_of(score)], OURS, settings_of(hop=100), CLOCK)
    ((_, thinned),) = decide([stream_of(score[::5])], OURS, settings_of(hop=100), coarse)
    torch.testing.assert_close(made.statistic, thinned.statistic, rtol=0, atol=0)
    assert made.available_s[1] - made.available_s[0] == pytest.approx(0.05)


def test_what_tells_nothing_is_neutral_and_what_is_doubtful_counts():
    usable = np.array([True, False, True, True])
    ((_, made),) = decide([stream_of([3, 3, 3, -3], is_usable=usable)], OURS, settings_of(), CLOCK)
    assert (made.llr != 0).tolist() == usable.tolist()


def test_bins_that_straddle_are_of_no_kind():
    stream = stream_of(np.zeros(60), [(0.2, 0.4)])
    is_clear, is_slip = slip_bins(stream, CLOCK, 60)
    for number in range(60):
        start, end = number * 0.01, number * 0.01 + 0.05
        inside = start >= 0.2 - 1e-9 and end <= 0.4 + 1e-9
        outside = end <= 0.2 + 1e-9 or start >= 0.4 - 1e-9
        assert (bool(is_clear[number]), bool(is_slip[number])) == (inside or outside, inside)


def test_alarms_ends_and_first_words_by_a_plain_loop():
    rng = np.random.default_rng(2)
    stream = stream_of(np.repeat(rng.standard_normal(40), 3), [(0.3, 0.5), (0.8, 1.0)])
    ((_, made),) = decide([stream], OURS, settings_of(), CLOCK)
    seen = watched(stream, made)
    alarms = [i for i in range(120) if made.is_alarm[i]]
    assert len(alarms) >= 2
    assert seen.alarms_s == tuple((i * 20 + 125) / RATE_HZ for i in alarms)
    for raised, end in zip(alarms, seen.alarm_ends_s, strict=True):
        off = [i for i in range(raised, 120) if not made.is_on[i]]
        assert end == (made.available_s[off[0]] if off else math.inf)
    for onset, first in zip((0.3, 0.8), seen.first_positive_s, strict=True):
        later = [
            float(t)
            for t, x in zip(made.available_s, made.llr, strict=True)
            if t >= onset and x > 0
        ]
        assert first == later[0]


def test_the_papers_rule_alarms_at_every_change_to_slip():
    score = np.random.default_rng(3).standard_normal(100)
    clock = Clock(RATE_HZ, 100, 100, 25)
    changes = {"calibration": Platt(1.0, 0.0), "rearm_s": 0, "refractory_s": 0}
    settings = replace(settings_of(KOfN(1, 1), 100, threshold=1e-30), **changes)
    ((_, made),) = decide([stream_of(score)], OURS, settings, clock)
    is_slip = score >= 0
    assert (
        made.is_alarm.tolist()
        == (is_slip & ~np.roll(is_slip, 1) | (is_slip & (np.arange(100) == 0))).tolist()
    )


@pytest.mark.parametrize("fit", FITS)
def test_probabilities_are_fitted_to_clear_bins_alone(fit):
    score = np.random.default_rng(4).standard_normal(60)
    score[20:36] += 1.0
    stream = stream_of(score, [(0.2, 0.4)])
    kept, is_slip = labelled([stream], OURS, CLOCK)
    is_clear, truth = slip_bins(stream, CLOCK, 60)
    assert kept.tolist() == score.astype(np.float32)[is_clear].tolist()
    assert is_slip.tolist() == truth[is_clear].tolist()
    assert FITS[fit](kept, is_slip).llr(torch.tensor([0.5])).isfinite().all()


# --------------------------------------------------------------------------------- the experiment
def composed(*overrides):
    with initialize_config_dir(version_base="1.3", config_dir=str(conf_dir())):
        return compose("train", list(overrides))


@pytest.mark.slow
def test_the_experiment_has_ten_hours_to_set_the_alarm_and_as_many_to_check_it():
    config = composed("+exp=onset")
    source: RecordingSource = instantiate(config.data, _convert_="all")
    (fold,) = instantiate(config.split, _convert_="all")(source.ids)
    trained = fold.having("train")
    assert {r.scene for r in trained} == {"paper", "held", "knocked", "arm_motion"}
    detector = SimpleNamespace(
        info={
            "train_materials": sorted({r.material for r in trained}),
            "train_recordings": {str(r): cache_key(source.key(r)) for r in trained},
        }
    )
    whole: CalibratedAlarm = instantiate(config.onset, _convert_="all")
    roles = whole.roles(detector)
    assert {r.material for r in roles["unseen"]} == {"iron", "cloth", "copper", "wood"}
    judged = {recording for own in roles.values() for recording in own}
    assert len(judged) == sum(map(len, roles.values()))
    for recording in trained:
        if recording in judged:  # of the same name, but another recording
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
        "split.train_share=0.5",
        "recipe.num_features=20",
        "recipe.penalties=[0.01]",
        "recipe.sample_bins=60",
        "onset.streams.cycles=4",
        "onset.streams.others.held.cycles=2",
        "onset.streams.others.held.tail_s=4.0",
        "onset.streams.others.dead_channel.cycles=1",
        "onset.hop_ms=25.0",
        *(f"~onset.streams.others.{name}" for name in dropped),
        "cache=off",
        "num_workers=0",
        "export=false",
    )
    train(config, tmp_path)
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    settings = AlarmSettings.of(SlipDetector.load(tmp_path / "detector.pt"))
    assert metrics["alarm"]["settings"] == settings.to_dict()
    assert settings.facts["simulated"] is True
    assert {"test", "unseen", "test stream", "unseen stream"} <= set(metrics["events"])
    assert metrics["alarm"]["scenes"]["dead_channel"]["test"]["cusum"]["num_onsets"] > 0
    assert "asked for: 1 false alarms an hour of held" in capsys.readouterr().out
    assert {"alarm.png", "events.png"} <= {path.name for path in tmp_path.iterdir()}
    live = StreamingDetector(SlipDetector.load(tmp_path / "detector.pt"))
    assert (
        len(live.push(torch.randn(1000, 24)).number)
        == (1000 - 100 - live.detector.look_ahead) // 50 + 1
    )

"""A detector calibrated on recordings of its use: the rate holds, what is worse is not written."""

import csv
import json
import sys
from dataclasses import replace

import hosts
import numpy as np
import pytest
import torch
from contract import names
from contract.recordings import CHANNELS, RATE_HZ, SLIDE_S, of_set, samples_of, write_recording
from contract.running import train
from drawing import assert_png

from tactslip_torch.data.labels import LabelRule
from tactslip_torch.data.recording import RecordingId, Timeline
from tactslip_torch.deploy.export import export_detector, read_sidecar
from tactslip_torch.model.calibration import Platt
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.onset.decisions import AlarmSettings, Decider, score_stream
from tactslip_torch.onset.rules import Budget, Cusum, KOfN
from tactslip_torch.training import refit
from tactslip_torch.training.alarm import Stream, Timing
from tactslip_torch.training.calibrate import Calibrator, Change, decision_threshold, in_stretches
from tactslip_torch.training.refit import BINS, KeptBins

TIMING = Timing(1000.0, 500, 1000, 0)
"""A decision every half second, on the second before."""
SETTINGS = AlarmSettings(500, Platt(1.0, 0.0), KOfN(1, 1), 0.0, None, rearm_s=1.0, refractory_s=1.0)


def calibrator(settings=SETTINGS, per_hour=None, **changes):
    return Calibrator(settings, TIMING, LabelRule(bin_ms=1000.0), per_hour, **changes)


def stream_of(score, name="a", cycle=0, **times):
    """Scores of valid decisions as those of a recording without slip, unless ``times`` say more."""
    duration_s = (len(score) + 1) * TIMING.hop_s
    times = times or {"non_slip_s": ((0.0, duration_s),)}
    score = torch.as_tensor(score, dtype=torch.float32)
    valid, none = score.isfinite(), torch.empty(0).double()
    truth = Timeline(**times, duration_s=duration_s)
    return Stream(RecordingId(name, cycle), truth, score, valid, none)


def bunched_scores(rng, hours, bunches_per_hour=30.0, mean_size=2.5, spacing_s=8.0):
    """Decisions of noise in which disturbances come in bunches of like height."""
    num = round(hours * 3600 / TIMING.hop_s)
    score = rng.normal(-4.0, 0.5, num)
    for _ in range(rng.poisson(bunches_per_hour * hours)):
        at, height = rng.uniform(0, num), rng.exponential(2.0)
        for _ in range(rng.geometric(1 / mean_size)):
            if at < num:
                score[int(at)] = max(score[int(at)], height + rng.normal(0.0, 0.3))
            at += 2.0 / TIMING.hop_s + rng.exponential(spacing_s / TIMING.hop_s)
    return score


# The rate ----------------------------------------------------------------------------------------


def broken_rates(*, sees_bunches):
    """How often the rate stated on 5 h is exceeded in the other 25 h of the same use."""
    per_hour, num_sets = 10.0, 40
    rng, made = np.random.default_rng(3), calibrator(per_hour=per_hour)
    pieces = in_stretches(stream_of(bunched_scores(rng, 30.0)), TIMING, 300)
    scored = [made.scored(piece) for piece in pieces]
    broken = 0
    for _ in range(num_sets):
        order = rng.permutation(len(scored)).tolist()
        own, rest = ([scored[i] for i in part] for part in (order[:50], order[50:]))
        budget = made.budget(made.dispersion(own) if sees_bunches else 1.0)
        alarm = made.fit(own, budget).alarm
        alarms = sum(len(one.alarms.alarms(alarm, 1000.0)[0]) for one in rest)
        broken += alarms / sum(one.hours for one in rest) > per_hour
    return broken / num_sets


def test_a_stated_rate_holds_although_false_alarms_come_in_bunches():
    assert broken_rates(sees_bunches=True) <= 0.05
    assert broken_rates(sees_bunches=False) > 0.1  # the bunches matter


@pytest.mark.parametrize("size", [1, 3, 8])
def test_alarms_in_bunches_tell_as_much_as_there_are_bunches(size):
    single, bunched = Budget("", 5.0), Budget("", 5.0, dispersion=size)
    assert bunched.bound(4 * size, 10.0) == pytest.approx(size * single.bound(4, 10.0))


def test_the_dispersion_of_alarms_one_by_one_is_about_one_and_of_bunches_their_size():
    made, rng = calibrator(per_hour=10.0), np.random.default_rng(0)
    alone, of_six = np.full((2, 50_000), -4.0)
    places = rng.permutation(500)[:250] * 100
    alone[places] = rng.normal(2.0, 0.1, 250)
    for at in rng.permutation(500)[:50] * 100:
        of_six[at : at + 60 : 10] = 2.0 + rng.normal(0.0, 0.1) + 0.001 * rng.random(6)
    assert made.dispersion([made.scored(stream_of(alone))]) < 2
    assert 4 < made.dispersion([made.scored(stream_of(of_six))]) < 16


def test_lost_samples_and_what_has_no_label_are_no_hours_without_slip():
    score = np.full(7200, -1.0)
    score[:1800] = np.nan
    stretches = ((0.0, 1800.0), (2700.0, 3600.5))
    made = calibrator(per_hour=1.0).scored(stream_of(score, non_slip_s=stretches))
    assert made.hours == pytest.approx(0.5, abs=0.001)


@pytest.mark.parametrize(
    ("rule", "offset"),
    [(KOfN(2, 3), 5.0), (Cusum(0.5, 0.5), 2.0), (Cusum(0.5, 0.5, 0.1), 2.0)],  # one set before
    ids=str,
)
def test_every_rule_keeps_the_rate_on_what_it_was_set_on(rule, offset):
    settings = AlarmSettings(
        500, Platt(1.0, offset), rule, 0.0, None, rearm_s=1.0, refractory_s=1.0
    )
    made = calibrator(settings, per_hour=10.0)
    score = bunched_scores(np.random.default_rng(1), 2.0, mean_size=1.0)
    one = made.scored(stream_of(score))
    alarm = made.fit([one], made.budget()).alarm
    decider = Decider(alarm, 1000.0, TIMING.bin_samples, 0)
    found = decider.decide(one.stream.score, one.stream.is_valid)
    allowed = Budget("", 10.0).allowed(one.hours)
    assert 0 < len(found.alarms) <= allowed
    assert alarm.target_per_hour == 10.0
    assert alarm.metadata["budget"][0]["alarms"] == len(found.alarms)


def test_stretches_are_quiet_where_their_recording_is():
    score = torch.arange(60.0)
    quiet = (0.0, 6.0), (9.0, 12.0)
    first, second, third = in_stretches(stream_of(score, non_slip_s=quiet), TIMING, 3)
    assert torch.equal(torch.cat([first.score, second.score, third.score]), score)
    assert first.times.non_slip_s == ((0.0, 6.0), (9.0, 10.0))
    assert second.times.non_slip_s == ((0.0, 2.0),)
    assert (third.times.non_slip_s, third.times.duration_s) == ((), 10.0)


# The decision threshold --------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(5))
def test_no_threshold_has_a_smaller_balanced_error(seed):
    rng = np.random.default_rng(seed)
    is_slip = rng.random(60) < 0.3
    scores = np.round(rng.normal(1.5 * is_slip, 1.0), 1)  # with ties

    def error(threshold):
        return (scores[is_slip] < threshold).mean() + (scores[~is_slip] >= threshold).mean()

    found = decision_threshold(torch.from_numpy(scores), torch.from_numpy(is_slip))
    assert error(found) == pytest.approx(min(map(error, [*scores, scores.max() + 1])))


def test_a_threshold_of_bins_wants_both_kinds():
    with pytest.raises(ValueError, match="slip and of non-slip"):
        decision_threshold(torch.ones(3), torch.ones(3).bool())


def test_a_moved_threshold_moves_every_score_and_no_alarm(general):
    """Of an alarm that was set for a rate before: its llr has another line, the same alarms."""
    detector = SlipDetector.load(general.file)
    samples = torch.from_numpy(samples_of("D", 1).T.copy())
    before = score_stream(detector, samples, 50)
    middle = float(before.score.median())
    settings = AlarmSettings(50, Platt(3.0, 0.5 - 3.0 * middle), KOfN(2, 3), 0.7, 5.0)
    timing = Timing(float(RATE_HZ), 50, 100, detector.look_ahead)
    made = Calibrator(settings, timing, LabelRule(), None)
    change = Change(0.25, Platt(2.0, -1.0), settings)
    made.apply(change, detector, {"more": 1})
    after = score_stream(detector, samples, 50)
    torch.testing.assert_close(after.score, before.score - 0.25, rtol=0, atol=2e-5)
    assert AlarmSettings.of(detector).metadata["more"] == 1
    assert detector.calibration[0] == Platt(2.0, -1.0)
    alarms = [
        [alarm.alarm_s for alarm in Decider(own, float(RATE_HZ), 100, 0).decide(*of[:2]).alarms]
        for own, of in ((settings, before), (AlarmSettings.of(detector), after))
    ]
    assert alarms[0] == alarms[1] != []


# The command -------------------------------------------------------------------------------------


def write_use(folder, num=6, *, label="non-slip", with_slips=False, gain=1.0):
    """Recordings that the detector was not trained on: held still and, if wanted, slipping."""
    folder.mkdir()
    rows = [["file", "material", "trial", "label", "sliding_s"]]
    for trial in range(num):
        for name, slips in (("E", False), *((("F", True),) if with_slips else ())):
            samples = gain * samples_of(name, 50 + trial)
            still = samples[: round(SLIDE_S[0] * RATE_HZ)]
            samples = samples if slips else np.concatenate([still, still[::-1]] * 2)
            path = write_recording(folder / f"{name}_{trial}.csv", samples.astype(np.float32))
            slide = f"{SLIDE_S[0]}-{SLIDE_S[1]}" if slips else ""
            rows.append([path.name, name, trial, "" if slips else label, slide])
    with (folder / names.MANIFEST).open("w", newline="") as file:
        csv.writer(file).writerows(rows)
    return folder


def told(model, root, *more):
    return [f"model={model}", *of_set(root), "hydra.run.dir=run", "num_workers=0", *more]


def moved(detector, by):
    """The detector with its decision threshold at another score."""
    settings = AlarmSettings.of(detector)
    made = Calibrator(settings, Timing(2000.0, 50, 100, 0), LabelRule(), None)
    made.apply(Change(by, settings.calibration, settings), detector, {})
    return detector


@pytest.fixture(scope="module")
def calibrated(command, general, tmp_path_factory):
    """Of a detector that calls all slip: what was printed, folder and report."""
    place = tmp_path_factory.mktemp("calibrated")
    moved(SlipDetector.load(general.file), -3.0).save(place / "off.pt")
    root = write_use(place / "use", with_slips=True)
    printed = command.well(place, "calibrate", *told(place / "off.pt", root, "per_hour=2000"))
    return printed, place / "run", json.loads((place / "run" / "calibration.json").read_text())


def test_the_file_says_on_what_its_alarm_was_set(calibrated, general):
    printed, run, report = calibrated
    detector, first = SlipDetector.load(run / names.DETECTOR), printed.splitlines()[0]
    known, alarm = detector.info["calibrated"], report["alarm"]
    assert "0.0015 h" in first  # 3.0 / 2000
    assert (known["alarm"]["per_hour"], known["alarm"]["confidence"]) == (2000, 0.95)
    assert known["alarm"]["bound"] <= 2000
    assert set(known["recordings"]) == {f"{n}/{i}" for n in "EF" for i in range(6)}
    settings = AlarmSettings.of(detector)
    assert settings.target_per_hour == 2000
    assert settings.threshold == alarm["after"] != AlarmSettings.of(general.detector).threshold
    assert_png(run / "calibration.png")
    rows = report["left_out"]
    assert sum(row["after"]["slips"] for row in rows) == 6
    assert sum(row["before"]["hours"] for row in rows) == pytest.approx(alarm["hours"])


@pytest.mark.onnx
def test_an_exported_stream_has_the_calibrated_threshold(calibrated, tmp_path):
    _, run, report = calibrated
    detector = SlipDetector.load(run / names.DETECTOR)
    (graph,) = export_detector(detector, tmp_path, ["stream"], source=run / names.DETECTOR)
    sidecar = read_sidecar(graph)
    assert sidecar["threshold"] == report["alarm"]["after"]
    assert sidecar["target_false_alarms_per_hour"] == 2000
    samples = samples_of("D", 1)
    saved = hosts.saved(tmp_path / "recording.npy", samples)
    host = names.HOSTS["python"].format(python=sys.executable, export=hosts.EXPORT).split()
    ran = hosts.run_host(host, graph, names.HOST_OPTIONS["every"], saved)
    hosts.assert_same(ran, hosts.truth(samples, detector=detector))


def test_a_threshold_that_is_off_is_moved_and_bins_are_right_again(calibrated):
    _, run, report = calibrated
    bins = report["bins"]
    assert bins["before"] == pytest.approx(0.5, abs=0.1)
    assert bins["after"] > 0.8
    detector = SlipDetector.load(run / names.DETECTOR)
    samples = torch.from_numpy(samples_of("F", 50).T.copy())
    score = score_stream(detector, samples, 50).score
    ends = np.array(SLIDE_S) * RATE_HZ / 50
    slip, rest = score[int(ends[0]) + 2 : int(ends[1]) - 3], score[: int(ends[0]) - 3]
    assert ((slip >= 0).float().mean() + (rest < 0).float().mean()) / 2 > 0.8


def test_what_is_not_better_is_not_written(command, calibrated, tmp_path):
    """The same recordings again: no threshold of some of them is better for the others."""
    _, run, _ = calibrated
    model = run / names.DETECTOR
    printed = command.well(tmp_path, "calibrate", *told(model, run.parent / "use"))
    assert "stays as it is" in printed
    assert not (tmp_path / "run" / names.DETECTOR).exists()


REFUSED = {
    "few hours": ({}, ["per_hour=100"], "0.03 h 0.008 h 374"),
    "nothing to set": ({}, [], "per_hour=RATE slip"),
    "no label": ({"label": ""}, ["per_hour=2000"], "label slip_free=true"),
    "no hours, all slip": ({"label": "slip"}, [], "all labelled bins are slip; per_hour=RATE"),
    "no flag": ({}, ["per_hour=2000", "slip_free=no"], "slip_free must be true or false, got 'no'"),
    "no rate": ({}, ["per_hour=-1"], "per_hour positive -1"),
    "no confidence": ({}, ["per_hour=2000", "confidence=2"], "error: confidence 2"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_mistake_is_one_line_and_nothing_is_written(command, general, tmp_path, case):
    words, more, expected = REFUSED[case]
    root = write_use(tmp_path / "use", **words)
    ran = command(tmp_path, "calibrate", *told(general.file, root, *more))
    assert (ran.status, ran.err.count("\n")) == (2, 1)
    assert [word for word in expected.split() if word not in ran.err] == []
    assert not (tmp_path / "run" / names.DETECTOR).exists()


def test_recordings_of_the_training_are_left_out(command, general, recordings, tmp_path):
    known = set(general.detector.info[names.TRAINING_RECORDINGS].values())
    printed = command.well(tmp_path, "calibrate", *told(general.file, recordings))
    report = json.loads((tmp_path / "run" / "calibration.json").read_text())
    assert f"{len(known)} recordings are left out" in printed
    used = set(report["recordings"].values())
    assert used
    assert not known & used
    everything = told(general.file, recordings, "use_trained=true")
    command.well(tmp_path, "calibrate", *everything)
    report = json.loads((tmp_path / "run" / "calibration.json").read_text())
    assert report["trained_on"]
    assert known <= set(report["recordings"].values())


def test_a_user_may_say_that_nothing_slips(command, general, tmp_path):
    root = write_use(tmp_path / "use", label="")
    given = told(general.file, root, "per_hour=2000", "slip_free=true")
    command.well(tmp_path, "calibrate", *given)
    alarm = SlipDetector.load(tmp_path / "run" / names.DETECTOR).info["calibrated"]["alarm"]
    assert alarm["hours"] == pytest.approx(6 * 4.8 / 3600, rel=0.05)


def test_without_a_label_there_is_nothing_to_evaluate(command, general, tmp_path):
    root = write_use(tmp_path / "use", num=1, label="")
    ran = command(tmp_path, "evaluate", *told(general.file, root))
    assert ran.status == 2
    assert "no recording has a label" in ran.err


def test_another_hand_is_refused(command, general, tmp_path):
    root = write_use(tmp_path / "use")
    fewer = [
        f"model={general.file}",
        *names.settings(data="files", root=root, channels=CHANNELS[:2]),
    ]
    ran = command(tmp_path, "calibrate", *fewer, "per_hour=2000", "hydra.run.dir=run")
    assert ran.status == 2
    assert "channels" in ran.err


# The refit ---------------------------------------------------------------------------------------


def odd_samples(trial, *, slips=True):
    """Of an object whose slip is no louder than its rest, but lower in frequency."""
    rng = np.random.default_rng([ord("G"), trial])
    samples = 0.16 * rng.standard_normal((3 * RATE_HZ, len(CHANNELS)))
    low = np.apply_along_axis(np.convolve, 0, samples, np.ones(8) / np.sqrt(8), "same")
    slide = slice(*(round(end * RATE_HZ) for end in SLIDE_S))
    if slips:
        samples[slide] = low[slide]
    return (samples + 1).astype(np.float32)


def loud_samples(trial):
    """Of an object whose slip is so loud that nothing misses it."""
    rng = np.random.default_rng([ord("H"), trial])
    samples = 0.1 * rng.standard_normal((3 * RATE_HZ, len(CHANNELS)))
    samples[slice(*(round(end * RATE_HZ) for end in SLIDE_S))] *= 4
    return (samples + 1).astype(np.float32)


def write_new(folder, trials, samples_of_trial=odd_samples, num_quiet=0):
    """Recordings of a new object, all of which slip but for the last ones, which are quiet."""
    folder.mkdir()
    rows = [["file", "material", "trial", "label", "sliding_s"]]
    slide = f"{SLIDE_S[0]}-{SLIDE_S[1]}"
    for trial in trials:
        path = write_recording(folder / f"G_{trial}.csv", samples_of_trial(trial))
        rows.append([path.name, "G", trial, "", slide])
    for trial in range(1000, 1000 + num_quiet):
        path = write_recording(folder / f"G_{trial}.csv", odd_samples(trial, slips=False))
        rows.append([path.name, "G", trial, "non-slip", ""])
    with (folder / names.MANIFEST).open("w", newline="") as file:
        csv.writer(file).writerows(rows)
    return folder


def accuracy_on_odd(detector, trials):
    """Balanced, of decisions that are wholly slip or not, on recordings nothing was fitted to."""
    right = {True: [], False: []}
    bin_samples, hop = detector.pool.bin_samples, 50
    for trial in trials:
        samples = torch.from_numpy(odd_samples(trial).T.copy())
        score = score_stream(detector, samples, hop).score
        start = torch.arange(len(score)) * hop / RATE_HZ
        end = start + bin_samples / RATE_HZ
        slips = (start >= SLIDE_S[0]) & (end <= SLIDE_S[1])
        rests = (end <= SLIDE_S[0]) | (start >= SLIDE_S[1])
        known = score.isfinite()
        right[True].append(score[slips & known] >= 0)
        right[False].append(score[rests & known] < 0)
    return sum(float(torch.cat(each).float().mean()) for each in right.values()) / 2


@pytest.fixture(scope="module")
def refitted(command, general, tmp_path_factory):
    """With recordings of a new object: what was printed, the folder and the report."""
    place = tmp_path_factory.mktemp("refitted")
    root = write_new(place / "odd", range(6))
    printed = command.well(place, "calibrate", *told(general.file, root, "refit=true"))
    return printed, place / "run", json.loads((place / "run" / "calibration.json").read_text())


def test_a_refit_with_recordings_of_a_new_object_finds_its_slip(refitted, general):
    printed, run, report = refitted
    tried = report["refit"]
    assert tried["after"] > tried["before"] + 0.1
    assert "the detector is refitted" in printed
    detector, others = SlipDetector.load(run / names.DETECTOR), range(90, 94)
    assert accuracy_on_odd(detector, others) > accuracy_on_odd(general.detector, others) + 0.15
    before, after = (
        sum(row[when]["slip_right"] + row[when]["other_right"] for row in report["left_out"])
        for when in ("before", "after")
    )
    assert after > before
    assert AlarmSettings.of(detector).calibration == detector.calibration[0]
    assert_png(run / "calibration.png")


def test_a_refitted_detector_says_what_it_was_trained_on(command, refitted, tmp_path):
    """So its own recordings do not calibrate it, and its bins are those of a further refit."""
    _, run, _ = refitted
    detector = SlipDetector.load(run / names.DETECTOR)
    assert detector.info["train_materials"] == ["A", "B", "C", "G"]
    kept = KeptBins.load(run / BINS, detector)
    assert set(kept.sample.group_names) == {"A", "B", "C", "G"}
    root = run.parent / "odd"
    ran = command(tmp_path, "calibrate", *told(run / names.DETECTOR, root, "refit=true"))
    assert (ran.status, "no recording is left" in ran.err) == (2, True)


def test_a_refit_that_is_not_better_is_not_written(command, general, tmp_path):
    """Slips so loud that a threshold is right everywhere: that is moved, the machine stays."""
    root = write_new(tmp_path / "loud", range(3), loud_samples)
    printed = command.well(tmp_path, "calibrate", *told(general.file, root, "refit=true"))
    report = json.loads((tmp_path / "run" / "calibration.json").read_text())
    assert report["refit"]["before"] == 1.0
    assert "not refitted, as that is not better" in printed
    assert report["bins"]["is_set"]
    detector = SlipDetector.load(tmp_path / "run" / names.DETECTOR)
    assert torch.equal(detector.head.linear, general.detector.head.linear)
    assert detector.info["train_materials"] == ["A", "B", "C"]
    kept = KeptBins.load(tmp_path / "run" / BINS, detector)  # those of before
    assert set(kept.sample.group_names) == {"A", "B", "C"}


def test_an_alarm_of_a_refit_is_set_for_a_rate_and_must_be_again(command, general, tmp_path):
    root = write_new(tmp_path / "new", range(4), num_quiet=3)
    given = told(general.file, root, "refit=true", "per_hour=2000")
    command.well(tmp_path, "calibrate", *given)
    model = tmp_path / "run" / names.DETECTOR
    detector = SlipDetector.load(model)
    assert detector.info["refitted"]["is_set"]
    alarm = detector.info["calibrated"]["alarm"]
    assert alarm["bound"] <= 2000 == AlarmSettings.of(detector).target_per_hour
    ran = command(tmp_path, "calibrate", *told(model, root, "refit=true"))
    assert (ran.status, "per_hour=RATE" in ran.err) == (2, True)


def of_general(general, folder):
    """A copy of the detector and its bins."""
    folder.mkdir()
    for name in (names.DETECTOR, BINS):
        (folder / name).write_bytes((general.folder / name).read_bytes())
    return folder


def broken_bins(content, case):
    """Bytes of a file of bins that were damaged."""
    if case == "cut":
        return content[: len(content) // 2]
    if case == "a byte":
        place = len(content) // 2
        return content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :]
    return b"no archive"


@pytest.mark.parametrize("case", ["cut", "a byte", "no archive", "gone", "of another detector"])
def test_bins_that_are_damaged_or_not_there_are_refused_in_a_line(
    command, general, refitted, tmp_path, case
):
    model, expected = of_general(general, tmp_path / "model"), "is damaged"
    if case == "gone":
        (model / BINS).unlink()
        expected = "keep_bins=false"
    elif case == "of another detector":
        (model / BINS).write_bytes((refitted[1] / BINS).read_bytes())
        expected = "another detector"
    else:
        (model / BINS).write_bytes(broken_bins((model / BINS).read_bytes(), case))
    before = {path.name: path.read_bytes() for path in model.iterdir()}
    odd = refitted[1].parent / "odd"
    ran = command(tmp_path, "calibrate", *told(model / names.DETECTOR, odd, "refit=true"))
    assert (ran.status, ran.err.count("\n")) == (2, 1)
    assert expected in ran.err
    assert BINS in ran.err
    assert {path.name: path.read_bytes() for path in model.iterdir()} == before
    assert not (tmp_path / "run" / names.DETECTOR).exists()


@pytest.mark.parametrize(
    ("trials", "more", "expected"),
    [
        ([0], [], "two or more"),
        ([0, 1], ["use_trained=true"], "use_trained"),
        ([0, 1], ["labels.bin_ms=100"], "bin_ms"),
    ],
)
def test_a_refit_refuses_what_cannot_be_tried(command, general, tmp_path, trials, more, expected):
    root = write_new(tmp_path / "odd", trials)
    ran = command(tmp_path, "calibrate", *told(general.file, root, "refit=true", *more))
    assert (ran.status, ran.err.count("\n")) == (2, 1)
    assert expected in ran.err
    assert not (tmp_path / "run" / names.DETECTOR).exists()


def test_kept_bins_fitted_again_give_the_same_machine(general):
    """All training bins of this small set are in the sample."""
    kept = KeptBins.load(general.folder / BINS, general.detector)
    again, _ = kept.refitted(general.detector, [])
    assert again.selected == general.detector.selected
    torch.testing.assert_close(again.head.linear, general.detector.head.linear)
    torch.testing.assert_close(again.scaler.minimum, general.detector.scaler.minimum)
    assert again.calibration[0].slope == pytest.approx(general.detector.calibration[0].slope)


def test_kept_bins_hold_no_pickle_and_are_read_as_they_were_written(general, tmp_path):
    with np.load(general.folder / BINS, allow_pickle=False) as content:
        kinds = {name: content[name].dtype.kind for name in content.files}
    assert "O" not in kinds.values()
    assert kinds["features"] == "f"
    kept = KeptBins.load(general.folder / BINS, general.detector)
    kept.save(tmp_path / BINS)
    again = KeptBins.load(tmp_path / BINS, general.detector)
    assert again.recipe == kept.recipe
    assert again.selected == kept.selected
    for name in ("features", "is_slip", "weight", "recording"):
        assert torch.equal(getattr(again.sample, name), getattr(kept.sample, name))


def test_a_file_of_bins_is_never_larger_than_its_cap(general, tmp_path, monkeypatch):
    """What is left stands for all bins, of each group and class."""
    kept = KeptBins.load(general.folder / BINS, general.detector)
    most = (general.folder / BINS).stat().st_size // 3
    monkeypatch.setattr(refit, "MOST_BYTES", most)
    kept.save(tmp_path / BINS)
    assert most / 2 < (tmp_path / BINS).stat().st_size <= most
    fewer = KeptBins.load(tmp_path / BINS, general.detector).sample
    assert len(fewer.is_slip) < len(kept.sample.is_slip) / 2
    for one in kept.sample.stratum.unique():
        stands_for = fewer.weight[fewer.stratum == one].sum()
        torch.testing.assert_close(stands_for, kept.sample.weight[kept.sample.stratum == one].sum())


def test_a_kept_bin_counts_as_many_as_it_stands_for(general):
    """The machine of bins of weight 4 is that of each of them four times, in recordings apart."""
    kept = KeptBins.load(general.folder / BINS, general.detector)
    pool, bins = kept.pool(general.detector), kept.sample.by_recording()
    recipe = replace(kept.recipe, views=("simple",), penalties=(1.0,), drop_channels=0.0)

    def scores(some):
        fit = recipe.fit(some, pool)
        return fit.head(fit.selection(kept.sample.features))

    four = [replace(of, weight=4 * of.weight) if of.group == "A" else of for of in bins]
    apart = [
        replace(of, name=f"{of.name} {part}")
        for of in bins
        for part in range(4 if of.group == "A" else 1)
    ]
    alike, wanted, plain = scores(four), scores(apart), scores(bins)
    assert (alike - wanted).norm() < 0.2 * (plain - wanted).norm()


def test_no_bins_are_kept_of_the_papers_recipe_or_where_that_is_not_wanted(
    command, general, paper, tmp_path
):
    assert not (paper.folder / BINS).exists()
    words = {"keep_bins": False, "recipe.views": ["simple"], "recipe.penalties": [1.0]}
    made = train(command, tmp_path, general.overrides, **words)
    assert not (made.folder / BINS).exists()

"""``detect`` as a command: what it detects, what it leaves, and what it says of bad input."""

import json

import numpy as np
import pytest
import torch
from contract.test_commands import table as rows_of
from drawing import assert_png
from small_detector import HAND, small_detector
from test_commands import composed as composed_of

from tactslip_torch import HandLayout, Recording
from tactslip_torch.commands import detect as module
from tactslip_torch.commands.detect import detect
from tactslip_torch.commands.stopping import one_line
from tactslip_torch.data.folder import recording_files
from tactslip_torch.data.formats import FORMATS, Samples
from tactslip_torch.model.calibration import Platt
from tactslip_torch.onset.decisions import AlarmSettings, Decider, score_stream
from tactslip_torch.onset.rules import KOfN
from tactslip_torch.report.onset import COLUMNS, OverviewRow, Traces, overview_figure

RATE_HZ = 2000.0
SETTINGS = AlarmSettings(20, Platt(1.0, 0.0), KOfN(2, 3), 2.0, target_per_hour=1.0, lead_s=0.02)
QUIET_V, LOUD_V = 0.02, 0.5
LOUD = ((2.0, 3.0), (5.0, 5.6))
NOTHING = {"speeds_mm_s": (), "onsets_s": (), "sliding_s": ()}
SEED = 10  # of a small detector that calls loud films slip and quiet ones not


def volts(duration_s=8.0, loud=LOUD, seed=0):
    """Quiet noise, loud for some stretches, in float32."""
    generator = torch.Generator().manual_seed(seed)
    samples = torch.randn(4, round(duration_s * RATE_HZ), generator=generator)
    size = torch.full((samples.shape[1],), QUIET_V)
    for start, end in loud:
        size[round(start * RATE_HZ) : round(end * RATE_HZ)] = LOUD_V
    return samples * size + torch.tensor([1.0, 1.0, 0.0, 0.0])[:, None]


def recording(samples=None, **changes):
    truth = {"onsets_s": (2.0, 5.0), "sliding_s": LOUD, "speeds_mm_s": (20.0, 40.0)}
    values = {"material": "M1", "provenance": {"simulated": True}, "sample_rate_hz": RATE_HZ}
    return Recording(volts() if samples is None else samples, **(truth | values | changes))


def quiet(duration_s=4.0, **changes):
    return recording(volts(duration_s, ()), **(NOTHING | changes))


def save(path, content, hand=HAND):
    FORMATS["npz"].save(path, content, hand, {"recording": {"name": "taps"}})


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    detector = small_detector(SEED)
    detector.info["alarm"] = SETTINGS.to_dict()
    path = tmp_path_factory.mktemp("model") / "detector.pt"
    detector.save(path)
    return path


def composed(*overrides):
    return composed_of("backend=auto", *overrides, name="detect")


def detected(model, place, folder, *overrides):
    """What ``detect`` returns, which is what it wrote."""
    content = detect(composed(f"model={model}", f"input={place}", *overrides), folder)
    assert json.loads((folder / "onsets.json").read_text()) == content
    return content


@pytest.fixture(scope="module")
def run(model, tmp_path_factory):
    """Two recordings, the second of which has no slip, and all that there can be written."""
    place, folder = tmp_path_factory.mktemp("in"), tmp_path_factory.mktemp("out")
    save(place / "a.npz", recording())
    save(place / "b.npz", quiet())
    return folder, detected(model, place, folder, "decisions=true", "figure=all")


def offline(samples):
    """The decisions on a recording that is known whole."""
    detector = small_detector(SEED, backend="auto")
    scores = score_stream(detector, samples, SETTINGS.hop_samples)
    decider = Decider(SETTINGS, RATE_HZ, detector.pool.bin_samples, detector.look_ahead)
    return decider.decide(scores.score, scores.is_valid)


# What is detected ------------------------------------------------------------------------------


def test_the_truth_stands_beside_them(run):
    _, content = run
    first, second = content["recordings"]
    assert (first["material"], first["scene"], first["simulated"]) == ("M1", "taps", True)
    for onset, slide in zip(first["truth"]["onsets"], LOUD, strict=True):
        alarm, *more = [a for a in first["alarms"] if slide[0] <= a["alarm_s"] <= slide[1]]
        assert onset["outcome"] == alarm["outcome"] == "found"
        assert alarm["true_onset_s"] == onset["onset_s"]
        assert onset["delay_s"] == pytest.approx(alarm["alarm_s"] - onset["onset_s"], abs=1e-8)
        assert onset["error_s"] == pytest.approx(alarm["onset_s"] - onset["onset_s"], abs=1e-8)
        assert {other["outcome"] for other in more} <= {"repeated"}
        assert 0.0 < onset["delay_s"] < 0.1
    false = [a["alarm_s"] for e in (first, second) for a in e["alarms"] if a["outcome"] == "false"]
    assert false == first["truth"]["false_alarms_s"] + second["truth"]["false_alarms_s"]
    assert second["truth"]["onsets"] == []
    counts = [content["events"][f"num_{name}"] for name in ("onsets", "found", "false_alarms")]
    assert counts == [2, 2, len(false)]


def test_an_alarm_behind_the_first_release_is_not_early(model, tmp_path):
    truth = {"onsets_s": (2.0,), "sliding_s": ((2.0, 4.0),), "speeds_mm_s": (20.0,)}
    made = recording(volts(4.0, ((1.9, 4.0),)), released_s=((1.9, 2.1),), **truth)
    save(tmp_path / "a.npz", made)
    (entry,) = detected(model, tmp_path, tmp_path / "out", "threshold=3")["recordings"]
    (onset,), last = entry["truth"]["onsets"], entry["alarms"][-1]
    assert 1.9 < last["alarm_s"] < 2.0
    assert (last["outcome"], onset["outcome"], onset["slid_mm"]) == ("found", "found", 0.0)
    assert onset["first_release_s"] == 1.9
    assert [onset["delay_s"], last["delay_s"]] == pytest.approx([last["alarm_s"] - 2.0] * 2)
    assert onset["delay_first_s"] == pytest.approx(last["alarm_s"] - 1.9)


def test_the_files_agree_with_each_other(run):
    folder, content = run
    each = [f"{name}_{kind}" for name in "ab" for kind in ("decisions.csv", "onsets.png")]
    names = [*each, "config.yaml", "onsets.csv", "onsets.json", "overview.png"]
    assert sorted(path.name for path in folder.iterdir()) == names
    assert_png(folder / "a_onsets.png")
    rows = rows_of(folder / "onsets.csv")
    assert tuple(rows[0]) == COLUMNS
    alarms = [a | {"file": e["file"]} for e in content["recordings"] for a in e["alarms"]]
    for row, alarm in zip(rows, alarms, strict=True):
        for name in ("alarm_s", "onset_s", "end_s", "score", "probability"):
            assert float(row[name]) == alarm[name]
        words = row["file"], row["outcome"], row["simulated"]
        assert words == (alarm["file"], alarm["outcome"], "True")
    decided = rows_of(folder / "a_decisions.csv")
    assert [int(row["number"]) for row in decided] == offline(volts()).number.tolist()
    assert {float(row["score"]) >= 0 for row in decided} == {False, True}


# What it is told ---------------------------------------------------------------------------------


def test_volts_alone_are_enough_but_have_no_truth(model, tmp_path, capsys):
    np.save(tmp_path / "a.npy", volts().numpy().T)
    told = "sample_rate_hz=2000", "decisions=true"
    content = detected(model, tmp_path / "a.npy", tmp_path / "out", *told)
    (entry,) = content["recordings"]
    assert [a["alarm_s"] for a in entry["alarms"]] == [a.alarm_s for a in offline(volts()).alarms]
    assert (entry["truth"], entry["simulated"], content["events"]) == (None, None, None)
    assert content["simulated"] is False
    out = capsys.readouterr().out
    assert "SIMULATED" not in out
    assert "slips" not in out
    assert rows_of(tmp_path / "out" / "onsets.csv")[0]["outcome"] == ""


def test_a_recording_nobody_annotated_has_no_false_alarms(model, tmp_path):
    """No onset and not simulated: nothing says that there was no slip."""
    entries = []
    for told in ({}, {"non_slip_s": ((0, 8),)}):
        save(tmp_path / "a.npz", recording(provenance={}, **NOTHING, **told))
        found = detected(model, tmp_path / "a.npz", tmp_path / "out", "figure=none")
        entries += found["recordings"]
    bare, told = entries
    assert (bare["truth"], bare["simulated"]) == (None, False)
    assert len(told["truth"]["false_alarms_s"]) == len(told["alarms"]) > 0


# Long recordings ---------------------------------------------------------------------------------


def test_no_more_than_a_second_is_in_hand(model, tmp_path, monkeypatch):
    asked, pushed, held = [], [], []
    read, push = Samples.read, module.StreamingDetector.push

    def watched(samples, first, stop):
        piece = read(samples, first, stop)
        asked.append(piece.shape[1])
        return piece

    def pushing(stream, samples):
        pushed.append(len(samples))
        decisions = push(stream, samples)
        held.append(stream.state_bytes)
        return decisions

    monkeypatch.setattr(Samples, "read", watched)
    monkeypatch.setattr(module.StreamingDetector, "push", pushing)
    save(tmp_path / "a.npz", recording())
    detected(model, tmp_path / "a.npz", tmp_path / "out", "figure=none")
    assert max(asked) == max(pushed) == 2000
    assert sum(pushed) == 16000
    assert max(held) < 2000 * 4 * 4  # what a stream keeps is less than what it is given


# What goes wrong ---------------------------------------------------------------------------------


def test_a_damaged_file_in_a_folder_costs_the_others_nothing(model, tmp_path, capsys):
    place, out = tmp_path / "in", tmp_path / "out"
    for name in "acd":
        save(place / f"{name}.npz", quiet())
    content = bytearray((place / "c.npz").read_bytes())
    content[len(content) // 2] ^= 1
    (place / "c.npz").write_bytes(content)
    save(place / "b.npz", recording())
    save(place / "e.npz", quiet(sample_rate_hz=1000.0))
    said = (
        r"2 of 5 recordings failed, first: .*c\.npz is damaged or no recording \(Bad CRC-32"
        ".*; the others are in"
    )
    with pytest.raises(ValueError, match=said):
        detect(composed(f"model={model}", f"input={place}"), out)
    assert "slips found: 2 of 2" in capsys.readouterr().out
    written = json.loads((out / "onsets.json").read_text())
    assert [entry["file"] for entry in written["recordings"]] == ["a.npz", "b.npz", "d.npz"]
    assert [entry["file"] for entry in written["failed"]] == ["c.npz", "e.npz"]
    assert (
        "1000 Hz, the detector of 2000 Hz; set reading.resample_hz=2000"
        in written["failed"][1]["error"]
    )
    names = {path.name for path in out.iterdir()}
    assert names == {"onsets.csv", "onsets.json", "overview.png", "config.yaml"}


def test_what_was_detected_before_an_interruption_stays(model, tmp_path, monkeypatch):
    save(tmp_path / "a.npz", recording())
    save(tmp_path / "b.npz", quiet())
    push, count = module.StreamingDetector.push, []

    def stopped(stream, samples):
        count.append(1)
        if len(count) == 8 + 2:
            raise KeyboardInterrupt
        return push(stream, samples)

    monkeypatch.setattr(module.StreamingDetector, "push", stopped)
    with pytest.raises(KeyboardInterrupt):
        detected(model, tmp_path, tmp_path / "out", "decisions=true", "figure=all")
    written = json.loads((tmp_path / "out" / "onsets.json").read_text())
    assert [entry["file"] for entry in written["recordings"]] == ["a.npz"]
    names = ["a_decisions.csv", "a_onsets.png", "config.yaml", "onsets.csv", "onsets.json"]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == names


@pytest.mark.parametrize(
    ("files", "figure", "wanted"),
    [
        ("a", "auto", ["a_onsets"]),
        ("a", "none", []),
        ("ab", "auto", ["overview"]),
        ("ab", "none", []),
        ("ab", "[b]", ["b_onsets", "overview"]),
        ("ab", "[b.npz]", ["b_onsets", "overview"]),
        ("ab", "all", ["a_onsets", "b_onsets", "overview"]),
    ],
)
def test_figures_are_those_that_were_asked_for(model, tmp_path, files, figure, wanted):
    for name in files:
        save(tmp_path / f"{name}.npz", quiet(1.0))
    detected(model, tmp_path, tmp_path / "out", f"figure={figure}")
    assert sorted(path.stem for path in (tmp_path / "out").glob("*.png")) == wanted


@pytest.mark.parametrize("figure", ["true", "null", "some", "[a,c]"])
def test_a_figure_of_what_is_not_there_is_refused_before_anything_is_read(model, tmp_path, figure):
    save(tmp_path / "a.npz", quiet(1.0))
    with pytest.raises(ValueError, match=r"'c', which is no .* a$|must be auto, all, none or a li"):
        detected(model, tmp_path, tmp_path / "out", f"figure={figure}")
    assert not (tmp_path / "out" / "onsets.json").exists()


def test_the_overview_has_what_each_recording_has(model, tmp_path, drawn):
    """A row in the order of the files: alarms, decided and true slip, and what is not valid."""
    lost = volts(4.0, ())
    lost[:, 4000:6000] = torch.nan
    save(tmp_path / "a.npz", recording())
    save(tmp_path / "b.npz", quiet())
    save(tmp_path / "c.npz", recording(lost, **NOTHING))
    entries = detected(model, tmp_path, tmp_path / "out")["recordings"]
    (axes,) = drawn[-1].axes
    assert [text.get_text() for text in axes.get_yticklabels()] == ["a.npz", "b.npz", "c.npz"]
    rows = {name: [[], [], []] for name in ("recording", "slip", "invalid", "truth", "alarm")}
    for part in axes.collections:
        for path in part.get_paths():
            low, high = path.vertices.min(0), path.vertices.max(0)
            if part.get_gid() in rows:
                row = round(float(low[1] + 0.3))
                rows[part.get_gid()][row].append((float(low[0]), float(high[0])))
    assert rows["recording"] == [[(0.0, 8.0)], [(0.0, 4.0)], [(0.0, 4.0)]]
    assert rows["truth"] == [list(LOUD), [], []]
    for entry, alarms, slips in zip(entries, rows["alarm"], rows["slip"], strict=True):
        assert [start for start, _ in alarms] == [alarm["alarm_s"] for alarm in entry["alarms"]]
        ends = [alarm["end_s"] or entry["duration_s"] for alarm in entry["alarms"]]
        assert [end for _, end in slips] == pytest.approx(ends)
    assert rows["invalid"][:2] == [[], []]
    ((start_s, end_s),) = rows["invalid"][2]
    assert 2.0 <= start_s < 2.2
    assert 3.0 <= end_s < 3.2


def test_an_overview_of_many_shows_those_with_alarms_and_says_how_many(tmp_path, drawn):
    traces = Traces((), RATE_HZ, 0.01, (0.0, 1.0))
    nothing = {"alarms": [], "truth": None, "simulated": False}
    rows = [OverviewRow.of(nothing | {"file": f"{i}.csv"}, traces) for i in range(100)]
    alarms = [{"alarm_s": 0.5}]
    rows += [OverviewRow.of(nothing | {"file": "last.csv", "alarms": alarms}, traces)]
    overview_figure(rows, tmp_path / "overview.png", of_simulated=False)
    assert_png(tmp_path / "overview.png")
    names = [text.get_text() for text in drawn[-1].axes[0].get_yticklabels()]
    assert names == [*(f"{i}.csv" for i in range(59)), "last.csv"]
    assert "101 recordings, 1 alarm, 60 shown" in drawn[-1].get_suptitle()


OTHER_NAMES = HandLayout([HAND.channels[i] for i in (0, 2, 1, 3)])
FEWER = HandLayout(HAND.channels[:3])
REFUSED = {
    # what is saved (or the name of another file), overrides, words
    "no recording": (None, [], "no recording in {place}; give a folder of .npz or .npy or "),
    "names": (recording, [OTHER_NAMES], "channel 2 of {place}/a.npz is PVDF1 (PVDF), not SG2 (SG)"),
    "channels": (lambda: recording(volts()[:3]), [FEWER], "{place}/a.npz has 3 channels, not 4"),
    "rate": (lambda: recording(sample_rate_hz=1999.5), [], "a.npz is of 1999.5 Hz, the detector"),
    "empty": (lambda: quiet(0.0), [], "{place}/a.npz holds no samples"),
    "short": (lambda: quiet(0.049), [], "{place}/a.npz has 98 samples, too few for a decision"),
    "units": (lambda: recording(units="counts"), [], "a.npz is in counts, the detector was traine"),
    "threshold": (recording, ["threshold=high"], "threshold must be a finite number, got 'high'"),
    "backend": (recording, ["backend=steam"], "steam"),
    "tare": (
        recording,
        ["reading.tare_s=[0,a]"],
        "reading.tare_s must be [start, end] in seconds",
    ),
    "view": (recording, ["view=3"], "view must be [start, end] in seconds, got 3"),
}


def test_a_folder_of_folders_is_refused_with_where_the_recordings_are(tmp_path):
    (tmp_path / "cup").mkdir()
    save(tmp_path / "cup" / "a.npz", recording())
    with pytest.raises(ValueError, match=r"itself \(folders inside it were not"):
        recording_files(tmp_path)
    assert [path.name for path in recording_files(tmp_path, in_folders=True)] == ["a.npz"]


@pytest.mark.parametrize("name", REFUSED)
def test_bad_input_is_one_line(name, model, tmp_path):
    make, arguments, said = REFUSED[name]
    place = tmp_path / "in"
    place.mkdir()
    hand = next((given for given in arguments if isinstance(given, HandLayout)), HAND)
    if make:
        save(place / "a.npz", make(), hand)
    more = [given for given in arguments if given is not hand]
    with pytest.raises(ValueError) as caught:  # noqa: PT011  # the words are below
        detect(composed(f"model={model}", f"input={place}", *more), tmp_path / "out")
    assert said.format(place=place) in one_line(caught.value)
    assert not (tmp_path / "out" / "onsets.json").exists()


# Files of others ---------------------------------------------------------------------------------


def write_table(path, samples, times_s):
    """Samples ``[C, T]`` as text, with times and a column more that is none of the hand's."""
    rows = torch.vstack([times_s, samples.double(), torch.zeros(samples.shape[1])]).T
    header = ",".join(["time", *HAND.names, "spare"])
    np.savetxt(path, rows.numpy(), delimiter=",", header=header, comments="", fmt="%.17g")


def test_a_gap_in_the_times_is_missing_samples_and_a_clock_a_little_off_is_none(model, tmp_path):
    whole, times_s = volts(3.0, ((2.0, 2.4),)), torch.arange(6000).double() / RATE_HZ
    is_lost = (times_s >= 1.0) & (times_s < 1.02)
    write_table(tmp_path / "a.csv", whole[:, ~is_lost], times_s[~is_lost])
    np.save(tmp_path / "b.npy", whole.where(~is_lost, torch.nan).numpy().T)
    write_table(tmp_path / "c.csv", whole, times_s / 1.0005)
    np.save(tmp_path / "d.npy", whole.numpy().T)
    options = ("figure=none", f"sample_rate_hz={RATE_HZ}")
    found = detected(model, tmp_path, tmp_path / "out", *options)["recordings"]
    gap, missing, off, even = (
        (each["decisions"], each["duration_s"], [alarm["alarm_s"] for alarm in each["alarms"]])
        for each in found
    )
    assert gap == missing
    assert off == even
    assert gap[0]["invalid"] > even[0]["invalid"] == 0
    assert gap[2]
    assert off[2]


def test_a_detector_of_counts_takes_counts_and_what_says_no_units(model, tmp_path):
    detector = small_detector(SEED)
    detector.info |= {"alarm": SETTINGS.to_dict(), "units": "counts"}
    detector.save(tmp_path / "counts.pt")
    (tmp_path / "in").mkdir()
    save(tmp_path / "in" / "a.npz", recording(units="counts"))
    write_table(tmp_path / "in" / "b.csv", volts(), torch.arange(16000).double() / RATE_HZ)
    save(tmp_path / "in" / "c.npz", recording())
    with pytest.raises(ValueError, match=r"1 of 3 .*c\.npz is in V, the detector was .* counts"):
        detected(tmp_path / "counts.pt", tmp_path / "in", tmp_path / "out", "figure=none")

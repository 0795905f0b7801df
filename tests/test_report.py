"""Tables and figures: what they say, of what, and that files are written whole."""

import csv
import itertools
import json
import math

import numpy as np
import pytest
import torch
from drawing import assert_png, rows_of
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex

from tactslip_torch.commands.entry import compare_runs
from tactslip_torch.data.recording import Recording
from tactslip_torch.hand import HandLayout
from tactslip_torch.onset.events import (
    EventRecord,
    EventRules,
    LatencyParts,
    pooled_metrics,
    recording_events,
)
from tactslip_torch.report import results
from tactslip_torch.report.metrics import bin_metrics, split_metrics
from tactslip_torch.report.onset import (
    REST,
    SLIP,
    Traces,
    alarm_outcome,
    onset_figure,
    onsets_table,
    view_of,
)
from tactslip_torch.report.recordings import (
    signals_figure,
)
from tactslip_torch.report.style import ALARM, table

REASON = "nobody looked"


def scores_of(seed=0, scenes=("paper",)):
    rng, number = np.random.default_rng(seed), range(500)
    truth = torch.from_numpy(rng.random(500) < 0.75)
    predicted = truth ^ torch.from_numpy(rng.random(500) < 0.1)
    kinds = (("acrylic", "ABS"), (60.0, 20.0, 40.0), np.repeat(scenes, 6).tolist())
    materials, speeds, of_scenes = ([kind[i % len(kind)] for i in number] for kind in kinds)
    return bin_metrics(truth, predicted, materials, speeds, of_scenes)


def metrics_of(**more):
    splits = {name: scores_of(seed) for seed, name in enumerate(["train", "test", "unseen"])}
    return {"simulated": True, "splits": splits} | more


def features():
    return [
        {"name": str(number), "channel": channel.name, "domain": "time", "kind": channel.kind}
        | {"component": "raw" if channel.kind == "SG" else ("A1", "D2", "A3", "D4")[number % 4]}
        | {"descriptor": ("kurtosis", "std", "energy")[number % 3], "finger": channel.finger}
        for number, channel in enumerate(HandLayout.paper24().channels)
    ]


def events_of(quiet_s=60.0, compute_s=None):
    """Of twenty recordings with a slip each, found ever later, early or missed; false alarms."""
    duration_s, rules = 3.0 + quiet_s / 20, EventRules(settle_s=0.1)
    events = []
    for number in range(20):
        alarms_s = {0: (0.9,), 1: ()}.get(number % 10, (1 + 0.01 * number, 4.0 + 0.05 * number))
        watched = EventRecord(
            *(str(number), "M1", "paper", duration_s, alarms_s, ()),
            *((1.0,), ((1.0, 2.0),), (20.0,)),
        )
        events.append(recording_events(watched, rules, LatencyParts(0.0125, 0.05, compute_s)))
    return pooled_metrics(events, num_resamples=50)


def no_events():
    return pooled_metrics([], num_resamples=50) | {"reason": REASON}


def stated(ece, count, **more):
    curve = {"probabilities": [0.1, 0.8], "slip_shares": [0.2, 0.7]}
    scores = {"ece": ece, "mce": 2 * ece, "brier": 0.0625, "log_loss": 0.25}
    return curve | scores | {"counts": [count / 4, 3 * count / 4], **more}


BY_ROLE = {
    "test": stated(0.0125, 4000, per_material={"M1": stated(0.02, 800)}),
    "unseen": stated(0.08, 1200, per_material={"iron": stated(0.05, 400)}),
}


def choice(size, penalty, **scores):
    known = [score for score in scores.values() if score is not None]
    kernel = {"kind": "polynomial", "degree": 2, "offset": 0.5}
    found = {"mean": sum(known) / len(known), "balanced_accuracy": scores}
    return {"num_features": size, "kernel": kernel, "penalty": penalty, **found}


CHOICES = [
    choice(60, 0.1, M1=0.9, M2=0.7, M3=None),
    choice(60, 1.0, M1=0.8, M2=0.9, M3=None),
    choice(120, 0.1, M1=0.95, M2=0.75, M3=None),
]


def of_view(view, weight, penalty, is_chosen=False, **scores):
    """A row of a view; one with no group of both classes has no scores by group."""
    row = choice(40, penalty, **scores or {"M1": 0.75})
    row |= {} if scores else {"balanced_accuracy": {}}
    return row | {"view": view, "weight": weight} | ({"chosen": True} if is_chosen else {})


VIEW_CHOICES = [
    of_view("simple", 0.7, 0.1, True, M1=0.9, M2=0.7),
    of_view("simple", 0.7, 1.0, M1=0.9, M2=0.72),
    of_view("channel", 0.0, 0.1),
    of_view("pooled", 0.3, 1.0, True, M1=0.85, M2=0.65),
]


# Tables ----------------------------------------------------------------------------------------


def test_cells_are_text_and_repeated_labels_are_left_blank():
    rows = [("x", 1, None), ("x", 2, True), ("y", 2, False)]
    shown = [dict(zip("abc", row, strict=True)) for row in rows]
    assert table([]) == table([], kept=1) == ""
    assert table([{"a": "-", "b": None, "c": 0}], kept=1).splitlines() == ["a  c", "-  0"]
    lines = ["a  b    c", "x  1    -", "   2  yes", "y  2   no"]
    assert table(shown, merged=2).splitlines() == lines


@pytest.mark.parametrize(
    ("scenes", "is_papers"), [(("paper",), True), (("taps",), False), (("paper", "taps"), False)]
)
def test_the_papers_numbers_stand_beside_its_own_scenes_alone(drawn, tmp_path, scenes, is_papers):
    metrics = {"simulated": True, "splits": {"test": scores_of(scenes=scenes)}}
    elsewhere = metrics | {"is_papers_hand": False}
    for each in (metrics, elsewhere):
        results._confusion_figure(each, tmp_path / "confusion.png")
    own, other = (figure.axes[0].get_xlabel() for figure in drawn)
    assert ("paper: non-slip 93.8" in own) == is_papers
    assert other == "prediction\n\n"
    assert any(row[0] == "paper" for row in rows_of(results._splits_table(metrics))) == is_papers
    assert results.PAPER_LINE not in results._splits_table(elsewhere)
    lines = results._materials_table(metrics).splitlines()
    expected = ["acrylic", "ABS", "20 mm/s", "40 mm/s", "60 mm/s"]
    if len(scenes) > 1:
        assert lines.pop(1) == (
            "of several scenes: materials and speeds are of the paper's scene alone"
        )
        expected += [f"scene {scene}" for scene in scenes]
    assert sorted(rows_of(line)[0][-6] for line in lines[2:]) == sorted(expected)


def comparison_of(number=11, **differences):
    """Of baselines, the ends of the interval of each; the detector has 90.5 %."""
    baselines = {}
    for name, (low, high) in differences.items():
        difference = {"low": low, "value": (low + high) / 2, "high": high}
        balanced = 0.905 + difference["value"]
        baselines[name] = {"balanced_accuracy": balanced, "difference": difference}
    found = {"drawn": "material", "num_drawn": number, "detector": 0.905, "baselines": baselines}
    return {"comparison": {"unseen": found}, "is_papers_hand": False}


def printed_comparison(capsys, comparison):
    results.print_results(metrics_of(**comparison), [])
    (line,) = [line for line in capsys.readouterr().out.splitlines() if "recordings: " in line]
    return line


FOREST, REGRESSION = "random_forest_simple", "logistic_regression"


@pytest.mark.parametrize(
    ("differences", "words"),
    [
        (
            {FOREST: (0.012, 0.06), REGRESSION: (-0.02, 0.2)},  # better, but not surely
            "random forest on simple statistics is ahead of the detector on unseen recordings: "
            "94.1 against 90.5 % balanced (difference 1.2 to 6.0 points, 95 % interval over 11 "
            "objects); try ",
        ),
        ({FOREST: (-0.06, 0.01), REGRESSION: (-0.2, -0.1)}, "no baseline is ahead on unseen"),
        ({FOREST: (-0.06, -0.02)}, "the detector is ahead of every baseline on unseen"),
    ],
)
def test_a_line_says_whether_a_baseline_is_surely_better_and_what_to_do(capsys, differences, words):
    line = printed_comparison(capsys, comparison_of(**differences))
    assert line.startswith(words)
    assert ("recipe." in line) == ("try" in words)


def test_of_one_recording_no_baseline_is_ahead(capsys):
    comparison = comparison_of(number=1, **{FOREST: (0.3, 0.3)})
    number = comparison["comparison"]["unseen"]["baselines"][FOREST]["difference"]
    number |= {"low": None, "high": None}
    line = printed_comparison(capsys, comparison)
    assert line.startswith("no baseline is ahead")
    assert "too few for an interval" in line


def test_choices_show_what_each_view_was_given_and_what_would_have_been_best(capsys):
    """A dropped view has its best penalty and no star."""
    nested = {"mean": 0.8125, "balanced_accuracy": {"M1": 0.875, "M2": 0.75}}
    metrics = metrics_of(validation=VIEW_CHOICES, nested_validation=nested)
    results.print_results(metrics, features())
    lines = capsys.readouterr().out.splitlines()
    start = next(i for i, line in enumerate(lines) if line.split()[:2] == ["chosen", "view"])
    rows = [line.split() for line in lines[start + 1 : start + 5]]
    assert rows[0] == ["*", "simple", "0.70", "40", "2", "0.1", "80.00", "70.00", "M2"]
    assert rows[1] == ["simple", "0.70", "40", "2", "1", "81.00", "72.00", "M2"]
    assert rows[2] == ["channel", "0.00", "40", "2", "0.1", "75.00", "-", "-"]
    assert rows[3] == ["*", "pooled", "0.30", "40", "2", "1", "75.00", "65.00", "M2"]
    (line,) = [line for line in lines if "decided without each group" in line]
    assert line.endswith(": 81.25 % (M1 87.50, M2 75.00)")


def test_reliability_has_a_row_for_each_role():
    lines = results._reliability_table(metrics_of(alarm={"reliability": BY_ROLE})).splitlines()
    rows = [line.split() for line in lines[2:]]
    assert rows[0] == ["test", "all", "4000", "1.25", "2.50", "0.0625", "0.2500"]
    assert rows[1] == ["M1", "800", "2.00", "4.00", "0.0625", "0.2500"]
    assert [row[0] for row in rows[2:]] == ["unseen", "iron"]


def test_events_say_what_their_delay_is_made_of_and_why_there_are_none():
    timed = {"test": {"rule": events_of(), "cusum at 1/h": events_of(compute_s=0.0021)}}
    *_, untimed, parts = rows_of(results._events_table(metrics_of(events=timed)))
    assert untimed[-1] == "-"
    look_ahead, *rest, whole, compute = map(float, parts[1:])
    assert (look_ahead, compute) == (12.5, 2.1)
    assert look_ahead + sum(rest) == pytest.approx(whole, abs=0.2)
    nothing = {role: {"a": no_events(), "b": no_events()} for role in ("train", "test")}
    text = results._events_table(metrics_of(events=nothing))
    assert text.splitlines()[1:] == [f"no events: {REASON}"]


def without_onsets(quiet_s):
    watched = EventRecord("a", "cup", "paper", quiet_s, (3.0,), (), (), (), ())
    return pooled_metrics([recording_events(watched, EventRules(), LatencyParts(0.0, 0.05))])


def test_slips_and_hours_too_few_for_a_rate_are_told():
    enough, few = events_of(quiet_s=7200.0), events_of()
    assert results.few_events(enough | {"num_onsets": 30}) == ""
    assert results.few_events(few | {"num_onsets": 12}) == (
        f"12 slips and {few['quiet_hours'] * 60:.1f} min without slip: too few for a rate; 30 and "
        "1 h are wanted"
    )
    quiet = without_onsets(720.0)
    text = results._events_table(metrics_of(simulated=False, events={"test": {"a": quiet}}))
    head, *_, note, last = text.splitlines()
    assert not {"mm", "delay", "found", "missed"} & set(head.split())
    assert note == "no slip has a known onset: false alarms alone can be counted"
    assert last == "test: 0.2 h without slip: too few for a rate; 1 h is wanted"


# A hand of one's own -----------------------------------------------------------------------------


def test_nothing_of_the_papers_is_said_of_another_hand(capsys):
    truth = torch.arange(40) % 2 == 0
    own = bin_metrics(truth, truth, ["cup"] * 20 + ["box"] * 20, [0.0] * 40, ["paper"] * 40)
    trained_on = {"materials": ["cup", "box"], "sessions": ["1"], "scenes": ["paper"]}
    own_features = [feature | {"finger": "unknown", "kind": "force"} for feature in features()]
    metrics = {"simulated": False, "splits": {"train": own, "unseen": own}}
    metrics |= {"trained_on": trained_on, "events": {"unseen": {"a": without_onsets(720.0)}}}
    metrics |= comparison_of(**{FOREST: (0.012, 0.06)})
    results.print_results(metrics, own_features)
    printed = capsys.readouterr().out
    assert "trained on objects cup, box\n" in printed
    for word in ("paper", "M1", "film", "stroke", "scene", "session", "mm", "unknown", "material"):
        assert word not in printed, word


def test_a_scene_without_a_name_is_not_called_after_the_paper():
    metrics = {"simulated": False, "is_papers_hand": False}
    for scenes, shown in ((("paper", "taps"), "unnamed"), (("lift", "taps"), "lift")):
        own = metrics | {"splits": {"test": scores_of(scenes=scenes)}}
        text = results._materials_table(own) + results._confound_table(own)
        assert f"scene {shown}" in text
        assert "paper" not in text
        assert "acrylic" in text  # objects of the unnamed scene or, without it, of all


# Figures ---------------------------------------------------------------------------------------

NEVER = events_of() | {"delay_ms": None, "found": {"value": 0.0, "low": 0.0, "high": 0.1}}
MANY = {f"rule {number}": NEVER for number in range(7)} | {"8": events_of()}  # more than colours
EVENTS = {
    "test": MANY,
    "unseen": {"x": events_of(quiet_s=7200.0)},
    "held": {"y": no_events()},
    "silent": {"z": NEVER},
}
ABSENT = {str(i): split_metrics([[0, 0], [i, 5]]) for i in range(5)}  # many, without a class


def features_of(metrics, path):
    results._selected_features_figure(features(), path, simulated=metrics["simulated"])


FIGURES = [
    (results._confusion_figure, {}),
    (results._confusion_figure, {"splits": ABSENT}),
    (results._reliability_figure, {"alarm": {"reliability": BY_ROLE}}),
    (results._events_figure, {"events": EVENTS}),
    (features_of, {}),
]


@pytest.mark.parametrize("simulated", [False, True])
@pytest.mark.parametrize(("draw", "more"), FIGURES, ids=lambda of: getattr(of, "__name__", ""))
def test_a_figure_is_written_whole_and_says_what_is_simulated(
    drawn, tmp_path, draw, more, simulated
):
    path = tmp_path / "figure.png"
    path.write_bytes(b"an older figure")
    draw(metrics_of(simulated=simulated, **more), path)
    assert_png(path)
    assert ("SIMULATED" in drawn[0].get_suptitle()) == simulated


# All of a run ----------------------------------------------------------------------------------


def test_results_have_a_table_and_a_figure_of_all_there_is(drawn, tmp_path, capsys):
    solve = {"method": "eigen", "rank": 7, "size": 9, "condition": 1.0, "error": 1e-16}
    everything = metrics_of(
        events={"test": {"two_of_three": events_of()}},
        validation=CHOICES,
        solve=solve,
        timing_s={"features": 1.0},
        trained_on={"materials": ["A", "B"]},
    )
    results.write_results(tmp_path / "all", everything, features())
    results.print_results(everything, features())
    out = capsys.readouterr().out
    for words in ("two of three", "solved by eigen", "trained on materials A, B"):
        assert words in out
    assert {path.name for path in (tmp_path / "all").iterdir()} == {
        *("metrics.json", "confusion.png", "selected_features.png", "events.png"),
    }
    kept = json.loads((tmp_path / "all" / "metrics.json").read_text())
    assert kept["splits"] == everything["splits"]
    few = metrics_of(events={"test": {"two_of_three": no_events()}})
    results.write_results(tmp_path / "few", few, [])
    results.print_results(few, [])
    assert REASON in capsys.readouterr().out
    assert {path.name for path in (tmp_path / "few").iterdir()} == {"metrics.json", "confusion.png"}


RATE_HZ, HOP_S = 2000.0, 0.01


# While a stream passes -------------------------------------------------------------------------


VIEWS = [(None, (0.0, 9.5)), ([1, 2.5], (1.0, 2.5)), ([-3, 99], (0.0, 9.5))]
for given in ("1", 3.0, [1], [1, 2, 3], ["a", "b"], [True, 2], [None, 1]):
    VIEWS.append((given, r"view must be \[start, end\] in seconds"))
for given in ([2, 1], [3, 3], [10, 11], [-2, -1], [math.nan, 3.0]):
    VIEWS.append((given, r"shows nothing of 9\.5 s"))


@pytest.mark.parametrize(("given", "wanted"), VIEWS)
def test_a_view_lies_within_the_recording_or_is_refused(given, wanted):
    if isinstance(wanted, str):
        with pytest.raises(ValueError, match=wanted):
            view_of(given, 9.5)
    else:
        assert view_of(given, 9.5) == wanted


# The figure ------------------------------------------------------------------------------------
TRUTH = {"onsets": [{"onset_s": 0.42}], "sliding_s": [(0.42, 1.1)]}
ALARMS = [{"alarm_s": 0.5, "onset_s": 0.43}, {"alarm_s": 1.25, "onset_s": 1.23}]


def traces_of(films):
    """Slip is decided from 0.5 to 1.2 s, 0.2 s of it not valid."""
    times = np.round(0.07 + HOP_S * np.arange(130), 6)
    slip = (times >= 0.5) & (times < 1.2)
    valid = (times < 0.6) | (times >= 0.8)
    names = [f"PVDF{i}" for i in range(1, 1 + len(films))]
    traces = Traces(names, RATE_HZ, HOP_S, (0.0, 1.4))
    traces.add_samples(films)
    score = np.where(times < 0.2, math.nan, 2.0 * slip)  # not before there is a floor
    of = {"available_s": times - 1e-9, "probability": 0.9 * slip + 0.05, "is_on": slip}
    traces.add_decisions(of | {"is_valid": valid, "onset_score": score})
    return traces


@pytest.fixture
def draw(drawn, tmp_path, rng):
    """Draws traces; their figure."""

    def drawing(traces=None, alarms=ALARMS, **options):
        path, films = tmp_path / "onsets.png", np.arange(3)[:, None] + rng.normal(size=(3, 2800))
        entry = {"alarms": alarms, "truth": TRUTH}
        onset_figure(traces or traces_of(films), entry, path, title="SIMULATED a.npz", **options)
        assert_png(path)
        return drawn[-1]

    return drawing


def marks_of(figure):
    """By panel and name, the times of lines and the ends of shaded segments."""
    found = {}
    for place, axes in enumerate(figure.axes):
        for part in axes.collections:
            boxes = [path.vertices[:, 0] for path in part.get_paths()]
            ends = [(float(box.min()), float(box.max())) for box in boxes]
            times = [low if low == high else (low, high) for low, high in ends]
            found[place, part.get_gid()] = times
    return found


def test_marks_stand_where_things_happened(draw):
    figure = draw()
    films, _, chance = figure.axes
    assert figure.get_suptitle() == "SIMULATED a.npz"
    expected = {
        **{(place, "invalid"): [(0.6, 0.8)] for place in range(3)},
        (0, "slip"): [(0.5, 1.2)],
        (0, "alarm"): [0.5, 1.25],
        (0, "onset"): [0.42],
        (1, f"decided {REST}"): [(0.07, 1.4)],
        (1, f"decided {SLIP}"): [(0.5, 1.2)],
        (1, f"truth {REST}"): [(0.0, 1.4)],
        (1, f"truth {SLIP}"): [(0.42, 1.1)],
        (2, "onset"): [0.42],
        (2, "estimate"): [0.43, 1.23],
    }
    assert marks_of(figure) == {key: list(map(pytest.approx, of)) for key, of in expected.items()}
    (markers,) = [line for line in films.lines if line.get_marker() == "v"]
    assert list(markers.get_xdata()) == [0.5, 1.25]
    assert to_hex(markers.get_color()) == ALARM.lower()
    np.testing.assert_allclose(chance.lines[0].get_ydata().max(), 0.95)
    assert chance.lines[0].get_drawstyle() == "steps-post"  # a decision holds until the next
    legend = {text.get_text() for text in figure.legends[0].get_texts()}
    assert legend >= {"decided: slip", "onset, true", "not valid"}


def test_an_onset_classifier_has_a_panel_with_its_threshold(draw):
    score, threshold = draw(onset_threshold=1.5).axes[3].lines
    times, values = (np.asarray(x) for x in (score.get_xdata(), score.get_ydata()))
    assert np.nanmin(times[np.isfinite(values)]) == pytest.approx(0.2, abs=HOP_S)
    assert (np.nanmax(values), list(threshold.get_ydata())) == (2.0, [1.5, 1.5])


KINDS = ("acceleration", "force", "pressure", "torque", "light")


@pytest.mark.parametrize(("number", "num_kinds"), [(1, 1), (3, 1), (6, 2), (24, 4), (96, 5)])
def test_words_stay_in_the_figure_and_apart_for_any_hand(drawn, tmp_path, rng, number, num_kinds):
    kinds = [KINDS[place % num_kinds] for place in range(number)]
    names = [f"{kind}_{place}" for place, kind in enumerate(kinds)]
    traces = Traces(names, RATE_HZ, HOP_S, (0.0, 1.4), "mV", kinds)
    traces.add_samples(rng.normal(size=(number, 2800)))
    chosen = [
        {"kind": kinds[i % number], "channel": names[i % number], "finger": "unknown"}
        | {"component": "A1", "domain": "time", "descriptor": ("std", "energy")[i % 2]}
        for i in range(2 * number)
    ]
    path = tmp_path / "a.png"
    entry = {"alarms": ALARMS, "truth": TRUTH}
    onset_figure(traces, entry, path, title="Recording cup_1.csv of cup, 2 alarms")
    results._selected_features_figure(chosen, path, simulated=False)
    for figure in drawn:
        renderer, space = FigureCanvasAgg(figure).get_renderer(), figure.bbox
        parts = [*figure.axes, *figure.legends, figure._suptitle]
        for box in [part.get_tightbbox(renderer) for part in parts]:
            assert box.x0 >= space.x0 - 1
            assert box.x1 <= space.x1 + 1
            assert box.y0 >= space.y0 - 1
            assert box.y1 <= space.y1 + 1
        for axes in figure.axes:
            labels = [text.get_window_extent(renderer) for text in axes.get_yticklabels()]
            labels.sort(key=lambda box: box.y0)
            for low, high in itertools.pairwise(labels):
                assert low.y1 < high.y0 + 1


# Tables ----------------------------------------------------------------------------------------


def entry():
    onsets = [
        {"onset_s": 1.0, "outcome": "found", "delay_s": 0.05},
        {"onset_s": 3.0, "outcome": "early", "delay_s": None},
        {"onset_s": 5.0, "outcome": "missed", "delay_s": None},
    ]
    truth = {"onsets": onsets, "false_alarms_s": [0.3], "early_s": 0.2}
    alarms = [
        {"alarm_s": t, "onset_s": t - 0.01, "probability": 0.9, "raised_by": "onset"}
        | {"in_range": t != 1.5}
        | alarm_outcome(t, truth)
        for t in (0.3, 1.05, 1.5, 2.9, 5.7)
    ]
    return {"file": "a.npz", "simulated": True, "alarms": alarms, "truth": truth}


def onsets_of(*entries, simulated=True):
    content = {"recordings": list(entries), "events": None, "simulated": simulated}
    return onsets_table(content).splitlines()


def test_the_table_says_what_is_simulated_what_is_wrong_and_what_it_leaves_out():
    lines = onsets_of(entry())
    assert lines[0].startswith("SIMULATED")
    assert lines[2].split()[:6] == ["a.npz", "0.300", "0.290", "0.90", "onset", "yes"]
    assert [line.split()[-4:] for line in lines[2:]] == [
        ["yes", "-", "-", "false"],
        ["yes", "1.000", "0.050", "found"],
        ["NO", "1.000", "0.500", "repeated"],
        ["yes", "3.000", "-0.100", "early"],
        ["-", "5.000", "-", "missed"],
        ["yes", "5.000", "0.700", "late"],
    ]
    many = onsets_of(*[entry()] * 20, simulated=False)
    assert many[-1] == "and 80 more, see onsets.csv"
    assert "SIMULATED" not in many[0]
    found = entry() | {"alarms": []}
    assert onsets_of(found | {"truth": None}, simulated=False) == ["no alarm"]
    truth = {"onsets": []}
    assert onsets_of(found | {"truth": truth}, simulated=False) == ["no alarm, and no slip missed"]


def test_runs_stand_beside_each_other_with_mean_and_deviation(tmp_path, capsys):
    runs = [
        {"words": ["x=1", f"seed={seed}"], "place": tmp_path, "simulated": True}
        | {"scores": {"test/accuracy": accuracy, "test/balanced_accuracy": balanced}}
        for seed, (accuracy, balanced) in enumerate([(0.9, 0.8), (0.7, 0.6)])
    ]
    compare_runs(runs)
    lines = capsys.readouterr().out.strip().splitlines()
    assert "SIMULATED" in lines[0]
    assert lines[2].split() == ["seed=0", "90.00", "80.00"]
    assert lines[4].split() == ["mean", "80.00", "70.00"]
    assert lines[5].split() == ["standard", "deviation", "10.00", "10.00"]
    with (tmp_path / "runs.csv").open() as file:
        assert list(csv.reader(file))[2] == ["seed=1", "0.7", "0.6"]


# What a set holds --------------------------------------------------------------------------------


HAND = HandLayout.paper24()
CHANNELS = HAND.to_rows()


def recording_of(seed=0):
    """Noise around an offset per channel, with a burst of one sample in each; two slides."""
    rng = np.random.default_rng(seed)
    volts = 0.01 * rng.standard_normal((24, 16000)) + np.linspace(-1, 2, 24)[:, None]
    volts[np.arange(24), rng.integers(0, 16000, 24)] += 0.7
    slides, handled = ((2.0, 4.0), (5.0, 6.5)), ((6.75, 7.5),)
    samples, speeds = torch.from_numpy(volts), [20.0, 40.0]
    return Recording(samples, 2000.0, "M1", speeds, (2.0, 5.0), slides, non_slip_s=handled)


@pytest.mark.parametrize(
    ("view", "onsets", "spans"),
    [(None, [2.0, 5.0], [(2.0, 4.0), (5.0, 6.5), (6.75, 7.5)]), ((3.0, 4.5), [], [(3.0, 4.0)])],
)
def test_onsets_are_marked_and_slides_and_handling_shaded_as_far_as_in_view(
    drawn, tmp_path, view, onsets, spans
):
    rows, views = [("M1", recording_of())], view and [view]
    signals_figure(rows, CHANNELS, tmp_path / "a.png", title="SIMULATED", views=views)
    (figure,) = drawn
    for axes in figure.axes:
        marks = [line for line in axes.lines if line.get_linestyle() == "-."]
        assert [line.get_xdata()[0] for line in marks] == onsets
        ends = [(p.get_x(), p.get_x() + p.get_width()) for p in axes.patches]
        assert ends == [pytest.approx(span) for span in spans]
        assert axes.get_xlim() == (view or (0.0, 8.0))
    words = [text.get_text() for text in figure.legends[0].get_texts()]
    assert words[:5] == ["little", "ring", "middle", "index", "thumb"]
    assert words[-3:] == ["onset of slip", "slip", "non-slip"]

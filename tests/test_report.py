"""Tables and figures of a run: what they say, of what, and that files are written whole."""

import json

import numpy as np
import pytest
import torch
from drawing import assert_png, rows_of

from tactslip_torch.hand import HandLayout
from tactslip_torch.onset.events import (
    EventRules,
    LatencyParts,
    Watched,
    pooled_metrics,
    recording_events,
)
from tactslip_torch.report import published
from tactslip_torch.report.metrics import answer_metrics, bin_metrics, split_metrics
from tactslip_torch.report.results import (
    PAPER_LINE,
    answers_figure,
    answers_table,
    confusion_figure,
    events_figure,
    events_table,
    materials_table,
    print_results,
    reliability_figure,
    reliability_table,
    selected_features_figure,
    splits_table,
    tuning_figure,
    tuning_tables,
    validation_figure,
    write_results,
)
from tactslip_torch.report.style import table

REASON = "nobody looked"


def scores_of(seed=0, scenes=("paper",)):
    rng = np.random.default_rng(seed)
    truth = torch.from_numpy(rng.random(500) < 0.75)
    predicted = truth ^ torch.from_numpy(rng.random(500) < 0.1)
    materials = ["ABS" if i % 2 else "acrylic" for i in range(500)]
    speeds = [(60.0, 20.0, 40.0)[i % 3] for i in range(500)]
    return bin_metrics(truth, predicted, materials, speeds, [scenes[i // 6 % len(scenes)] for i in
                                                            range(500)])  # fmt: skip


def metrics_of(**more):
    splits = {name: scores_of(seed) for seed, name in enumerate(["train", "test", "unseen"])}
    return {"simulated": True, "splits": splits} | more


def features(hand=None):
    rows = []
    for number, channel in enumerate((hand or HandLayout.paper24()).channels):
        component = "raw" if channel.kind == "SG" else f"{'AD'[number % 2]}{1 + number % 4}"
        row = {"channel": channel.name, "component": component, "domain": "time"}
        row |= {"descriptor": ("kurtosis", "std", "energy")[number % 3]}
        rows.append(row | {"name": str(number), "kind": channel.kind, "finger": channel.finger})
    return rows


def events_of(seed=0, *, quiet_s=60.0, compute_s=None, num=20):
    """Of recordings with one slip each: some found, some early, some missed, some false alarms."""
    rng = np.random.default_rng(seed)
    many = []
    for number in range(num):
        alarms = [float(time) for time in rng.uniform(4.0, 3.0 + quiet_s / num, rng.poisson(2))]
        if (kind := rng.choice(["found", "early", "missed"], p=[0.7, 0.1, 0.2])) != "missed":
            alarms.append(0.9 if kind == "early" else 1.0 + rng.exponential(0.05))
        many.append(
            Watched(
                recording=str(number),
                material="M1",
                scene="paper",
                duration_s=3.0 + quiet_s / num,
                alarms_s=tuple(sorted(alarms)),
                onset_estimates_s=(),
                onsets_s=(1.0,),
                sliding_s=((1.0, 2.0),),
                speeds_mm_s=(20.0,),
            )
        )
    latency = LatencyParts(0.0125, 0.05, compute_s)
    rules = EventRules(settle_s=0.1)
    events = [recording_events(one, rules, latency) for one in many]
    return pooled_metrics(events, num_resamples=50)


def no_events():
    return pooled_metrics([], num_resamples=50) | {"reason": REASON}


RECORDINGS = {"a/0": [[1, 3, 0], [2, 0, 2]], "a/1": [[0, 1, 1], [0, 1, 9]]}
ANSWERS = {"unseen": answer_metrics(RECORDINGS, 0.8), "test": answer_metrics({}, 0.8)}


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
    return {
        "num_features": size,
        "kernel": kernel,
        "penalty": penalty,
        "mean": sum(known) / len(known),
        "balanced_accuracy": scores,
    }


CHOICES = [
    choice(60, 0.1, M1=0.9, M2=0.7, M3=None),
    choice(60, 1.0, M1=0.8, M2=0.9, M3=None),
    choice(120, 0.1, M1=0.95, M2=0.75, M3=None),
]
RBF = choice(60, 0.3, M1=0.5, M2=None, M3=0.4) | {"kernel": {"kind": "rbf", "gamma": 1}}


def tuning():
    """Of two groups held out in turn, one step each."""
    won = {"loss": 0.2, "balanced_accuracy": 0.9}
    history = [{"held_loss": 0.3, "loss": 0.4}, {"held_loss": 0.2, "loss": 0.3}]
    ways = {"recipe": won, "grid": won, "tuned": won | {"steps": 1}}
    held = [{"held": name, "history": history, **ways} for name in ("M1", "M2")]
    splits = {"test": split_metrics([[9, 1], [2, 8]])}
    return {
        "held": held,
        "history": history,
        "splits": {"recipe": splits, "grid": splits},
        "start": {"penalty": 1.0, "offset": 0.5},
        "penalty": 2.0,
        "offset": 0.25,
        "steps": 1,
        "bins": 40,
        "seconds": 3.0,
        "fit_s": 1.0,
        "learned": ["penalty", "offset", "scales"],
        "scales": {f"f{i}": 1 + i / 10 for i in range(8)},
    }


# Tables ----------------------------------------------------------------------------------------


def test_cells_are_text_and_repeated_labels_are_left_blank():
    rows = [("x", 1, None), ("x", 2, True), ("y", 2, False)]
    shown = [dict(zip("abc", row, strict=True)) for row in rows]
    assert table([]) == ""
    assert table(shown, merged=2).splitlines() == [
        "a  b    c",
        "x  1    -",
        "   2  yes",
        "y  2   no",
    ]


def test_published_numbers_agree_with_each_other():
    by_finger = published.SELECTED_BY_FINGER
    assert sum(published.SELECTED_BY_KIND.values()) == published.NUM_SELECTED
    for kind, count in published.SELECTED_BY_KIND.items():
        assert sum(by_finger[kind].values()) == count
    assert len({*published.DESCRIPTORS_RANKED, *published.DESCRIPTORS_NEVER}) == 17
    for split in (published.SPLITS["test"], published.SPLITS["unseen"]):
        recalls = np.array([split.non_slip_recall, split.slip_recall])
        assert split.balanced_accuracy == pytest.approx(recalls.mean())
        # one fraction of non-slip bins, 24.66 %, explains accuracy from the recalls
        assert split.accuracy == pytest.approx(recalls @ [0.2466, 0.7534], abs=6e-4)


@pytest.mark.parametrize(
    ("scenes", "is_papers"), [(("paper",), True), (("taps",), False), (("paper", "taps"), False)]
)
def test_the_papers_numbers_stand_beside_its_own_scenes_alone(drawn, tmp_path, scenes, is_papers):
    metrics = {"simulated": True, "splits": {"test": scores_of(scenes=scenes)}}
    elsewhere = metrics | {"is_papers_hand": False}
    for given in (metrics, elsewhere):
        confusion_figure(given, tmp_path / "confusion.png")
    own, other = (figure.axes[0].get_xlabel() for figure in drawn)
    assert ("paper: non-slip 93.8" in own) == is_papers
    assert other == "prediction\n\n"
    assert any(row[0] == "paper" for row in rows_of(splits_table(metrics))) == is_papers
    assert PAPER_LINE not in splits_table(elsewhere)
    lines = materials_table(metrics).splitlines()
    expected = ["acrylic", "ABS", "20 mm/s", "40 mm/s", "60 mm/s"]
    expected = expected if "paper" in scenes or len(scenes) == 1 else []
    if len(scenes) > 1:
        assert lines.pop(1) == (
            "of several scenes: materials and speeds are of the paper's scene alone"
        )
        expected += [f"scene {scene}" for scene in scenes]
    assert sorted(rows_of(line)[0][-6] for line in lines[2:]) == sorted(expected)


def test_tuning_says_what_was_learned():
    metrics = metrics_of(tuning=tuning())
    metrics["splits"] = {"test": metrics["splits"]["test"]}
    (text,) = tuning_tables(metrics)
    assert "tuned by gradient" in text
    assert "1 steps from C=1, c=0.5 to C=2, c=0.25; learned: penalty, offset, scales" in text
    assert tuning_tables(metrics_of()) == []


def test_reliability_and_prediction_sets_have_a_row_for_each_role():
    lines = reliability_table(metrics_of(alarm={"reliability": BY_ROLE})).splitlines()
    rows = [line.split() for line in lines[2:]]
    assert rows[0] == ["test", "all", "4000", "1.25", "2.50", "0.0625", "0.2500"]
    assert rows[1] == ["M1", "800", "2.00", "4.00", "0.0625", "0.2500"]
    assert [row[0] for row in rows[2:]] == ["unseen", "iron"]
    lines = answers_table(metrics_of(answers=ANSWERS)).splitlines()
    assert lines[2].split()[:4] == ["unseen", "15.00", "88.24", "85.83"]
    assert set(lines[3].split()[1:-1]) == {"-"}
    assert lines[4].startswith("asked: 80 % covered")


def test_events_have_a_row_for_each_role_and_rule():
    events = {
        role: {"first_transition": events_of(seed), "two_of_three": events_of(seed + 1)}
        for seed, role in ((0, "test"), (5, "unseen"))
    }
    lines = events_table(metrics_of(events=events)).splitlines()
    assert lines[0].startswith("SIMULATED")
    assert len(lines) == 2 + 4
    found = iter(lines[2:])
    for role, by_rule in events.items():
        for rule, numbers in by_rule.items():
            rate = numbers["false_alarms_per_minute"]
            head = [role] if rule == "first_transition" else []
            assert rows_of(next(found))[0] == [
                *head,
                rule.replace("_", " "),
                str(numbers["num_onsets"]),
                *(f"{100 * numbers[name]['value']:.1f}" for name in ("found", "early", "missed")),
                *(f"{numbers['delay_ms'][name]['value']:.1f}" for name in ("median", "p95")),
                "-",  # the first release is not known
                f"{numbers['slid_mm']['median']['value']:.1f}",
                f"{rate['value']:.1f} /min [{rate['low']:.1f}, {rate['high']:.1f}]",
                f"{60 * numbers['quiet_hours']:.1f} min",
                f"{numbers['alarms_per_slip']['value']:.2f}",
            ]
    timed = {"test": {"rule": events_of(), "cusum at 1/h": events_of(compute_s=0.0021)}}
    lines = events_table(metrics_of(events=timed)).splitlines()
    assert rows_of(lines[6])[0][-1] == "-"
    parts = [float(cell) for cell in rows_of(lines[7])[0][1:]]
    assert (parts[0], parts[4]) == (12.5, 2.1)
    assert sum(parts[:3]) == pytest.approx(parts[3], abs=0.2)
    nothing = {role: {"a": no_events(), "b": no_events()} for role in ("train", "test")}
    lines = events_table(metrics_of(events=nothing)).splitlines()
    assert rows_of(lines[2])[0][2:] == ["0", *["-"] * 10]
    assert [line for line in lines if REASON in line] == [f"no events: {REASON}"]


# Figures ---------------------------------------------------------------------------------------

NEVER = events_of() | {"delay_ms": None, "found": {"value": 0.0, "low": 0.0, "high": 0.1}}
MANY = {f"rule {number}": NEVER for number in range(7)} | {"8": events_of()}  # more than colours
FIGURES = {
    "confusion": lambda path, of: confusion_figure(metrics_of(simulated=of), path),
    "many splits, an absent class": lambda path, of: confusion_figure(
        {"simulated": of, "splits": {str(i): split_metrics([[0, 0], [i, 5]]) for i in range(5)}},
        path,
    ),
    "selected": lambda path, of: selected_features_figure(features(), path, simulated=of),
    "validation": lambda path, of: validation_figure(
        metrics_of(simulated=of, validation=[*CHOICES, RBF]), path
    ),
    "reliability": lambda path, of: reliability_figure(
        metrics_of(simulated=of, alarm={"reliability": BY_ROLE}), path
    ),
    "tuning": lambda path, of: tuning_figure(tuning(), path, simulated=of),
    "answers": lambda path, of: answers_figure(metrics_of(simulated=of, answers=ANSWERS), path),
    "events": lambda path, of: events_figure(
        metrics_of(
            simulated=of,
            events={"test": MANY, "unseen": {"x": events_of(quiet_s=7200.0)}}
            | {"held": {"y": no_events()}, "silent": {"z": NEVER}},
        ),
        path,
    ),
}


@pytest.mark.parametrize("name", FIGURES)
def test_a_figure_is_written_whole_and_says_what_is_simulated(drawn, tmp_path, name):
    path, simulated = tmp_path / "figure.png", name != "confusion"
    path.write_bytes(b"an older figure")
    FIGURES[name](path, simulated)
    assert_png(path)
    assert ("SIMULATED" in drawn[0].get_suptitle()) == simulated


# All of a run ----------------------------------------------------------------------------------


def test_results_have_a_table_and_a_figure_of_all_there_is(drawn, tmp_path, capsys):
    solve = {"method": "eigen", "rank": 7, "size": 9, "condition": 1.0, "error": 1e-16}
    everything = metrics_of(
        events={"test": {"two_of_three": events_of()}},
        answers=ANSWERS,
        validation=CHOICES,
        solve=solve,
        timing_s={"features": 1.0},
        trained_on={"materials": ["A", "B"]},
    )
    write_results(tmp_path / "all", everything, features())
    print_results(everything, features())
    out = capsys.readouterr().out
    for words in ("two of three", "asked: 80 %", "solved by eigen", "trained on materials A, B"):
        assert words in out
    assert {path.name for path in (tmp_path / "all").iterdir()} == {
        *("metrics.json", "confusion.png", "selected_features.png", "events.png"),
        *("answers.png", "validation.png"),
    }
    kept = json.loads((tmp_path / "all" / "metrics.json").read_text())
    assert kept["splits"] == everything["splits"]
    few = metrics_of(events={"test": {"two_of_three": no_events()}})
    write_results(tmp_path / "few", few, [])
    print_results(few, [])
    assert REASON in capsys.readouterr().out
    assert {path.name for path in (tmp_path / "few").iterdir()} == {"metrics.json", "confusion.png"}

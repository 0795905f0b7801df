"""The table and the figure of events, and where they go."""

import json

import numpy as np
import pytest
from test_report import assert_drawn_atomically, rows_of

from tactslip_torch.onset.events import (
    EventRules,
    LatencyParts,
    Watched,
    event_metrics,
    pooled_metrics,
)
from tactslip_torch.report.metrics import split_metrics
from tactslip_torch.report.results import (
    events_figure,
    events_table,
    has_events,
    print_results,
    write_results,
)

RULES = EventRules(settle_s=0.1)
REASON = "nobody looked"


def numbers_of(seed=0, *, quiet_s=60.0, compute_s=None, num=20):
    """Of recordings with one slip each: some found, some early, some missed, some false alarms."""
    rng = np.random.default_rng(seed)
    many = []
    for number in range(num):
        alarms = [float(time) for time in rng.uniform(4.0, 3.0 + quiet_s / num, rng.poisson(2))]
        kind = rng.choice(["found", "early", "missed"], p=[0.7, 0.1, 0.2])
        if kind != "missed":
            alarms.append(1.0 - 0.1 if kind == "early" else 1.0 + rng.exponential(0.05))
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
    return event_metrics(many, RULES, latency, num_resamples=50)


def nothing():
    return pooled_metrics([], num_resamples=50) | {"reason": REASON}


def metrics_of(events, simulated=True):
    scores = {"per_material": {}, "per_speed": {}, **split_metrics([[3, 1], [2, 4]])}
    return {"simulated": simulated, "splits": {"test": scores}, "events": events}


def cells_of(line):
    return rows_of(line)[0]


# ----------------------------------------------------------------------------------------- table
def test_one_row_for_each_role_and_rule():
    events = {
        role: {"first_transition": numbers_of(seed), "two_of_three": numbers_of(seed + 1)}
        for seed, role in ((0, "test"), (5, "unseen"))
    }
    lines = events_table(metrics_of(events)).splitlines()
    assert lines[0].startswith("SIMULATED")
    assert cells_of(lines[1])[2:8] == [
        *("slips", "found %", "early %", "missed %", "delay ms", "p95 ms")
    ]
    assert len(lines) == 2 + 4
    for line, (role, rule) in zip(
        lines[2:], [(r, rule) for r in events for rule in events[r]], strict=True
    ):
        numbers = events[role][rule]
        is_first = rule == "first_transition"
        head = [role, "first transition"] if is_first else ["two of three"]
        rate = numbers["false_alarms_per_minute"]
        expected = [
            str(numbers["num_onsets"]),
            *(f"{100 * numbers[name]['value']:.1f}" for name in ("found", "early", "missed")),
            *(f"{numbers['delay_ms'][name]['value']:.1f}" for name in ("median", "p95")),
            f"{rate['value']:.1f} /min [{rate['low']:.1f}, {rate['high']:.1f}]",
            f"{60 * numbers['quiet_hours']:.1f} min",
            f"{numbers['alarms_per_slip']['value']:.2f}",
        ]
        assert cells_of(line) == [*head, *expected]
    assert "SIMULATED" not in events_table(metrics_of(events, simulated=False))


def test_parts_of_the_delay_are_told_where_compute_was_measured():
    plain = {"test": {"rule": numbers_of()}}
    assert "look-ahead" not in events_table(metrics_of(plain))
    timed = {"test": {"rule": numbers_of(), "cusum at 1/h": numbers_of(compute_s=0.0021)}}
    lines = events_table(metrics_of(timed)).splitlines()
    assert lines[4] == ""
    assert cells_of(lines[5])[2:] == ["look-ahead", "bin fill", "decision", "all", "compute beside"]
    assert cells_of(lines[6])[-1] == "-"
    parts = [float(cell) for cell in cells_of(lines[7])[1:]]
    assert parts[0] == 12.5
    assert sum(parts[:3]) == pytest.approx(parts[3], abs=0.2)
    assert parts[4] == 2.1


def test_what_is_not_there_is_a_dash_and_says_why_once():
    events = {role: {"a": nothing(), "b": nothing()} for role in ("train", "test")}
    lines = events_table(metrics_of(events)).splitlines()
    assert cells_of(lines[2])[2:] == ["0", *["-"] * 8]
    assert [line for line in lines if REASON in line] == [f"no events: {REASON}"]
    no_onset = numbers_of() | {"found": None, "early": None, "missed": None, "delay_ms": None}
    table = events_table(metrics_of({"held": {"a": no_onset | {"alarms_per_slip": None}}}))
    assert rows_of(table)[-1][:7] == ["held", "a", "20", *["-"] * 4]


# ---------------------------------------------------------------------------------------- figure
@pytest.mark.parametrize("simulated", [True, False])
def test_the_figure_is_drawn_and_says_simulated(tmp_path, simulated, monkeypatch):
    words = []
    monkeypatch.setattr(
        "matplotlib.figure.Figure.suptitle", lambda self, text, **_: words.append(text)
    )
    many = {f"rule {number}": numbers_of(number) for number in range(8)}  # more than colours
    events = {"test": many, "unseen": {"x": numbers_of(quiet_s=7200.0)}, "held": {"y": nothing()}}
    never = numbers_of() | {"delay_ms": None, "found": {"value": 0.0, "low": 0.0, "high": 0.1}}
    events["deaf"] = {"z": never}
    events_figure(metrics_of(events, simulated), tmp_path / "events.png")
    assert_drawn_atomically(tmp_path / "events.png")
    assert ("SIMULATED" in words[0]) == simulated


def test_a_rule_has_one_line_in_the_legend_however_it_is_written(tmp_path, monkeypatch):
    labels = []
    monkeypatch.setattr(
        "matplotlib.figure.Figure.legend",
        lambda self, handles, **_: labels.extend(handle.get_label() for handle in handles),
    )
    numbers = numbers_of()
    events = {"test": {"k_of_n": numbers}, "stream": {"k of n": numbers, "cusum": numbers}}
    events_figure(metrics_of(events), tmp_path / "events.png")
    assert labels[:3] == ["k of n", "cusum", "median"]


def test_nothing_to_draw_is_an_error_and_leaves_no_file(tmp_path):
    for metrics in (metrics_of({"train": {"a": nothing()}}), metrics_of({}), {"splits": {}}):
        assert not has_events(metrics)
        with pytest.raises(ValueError, match="no events to draw"):
            events_figure(metrics, tmp_path / "events.png")
    assert not list(tmp_path.iterdir())


# --------------------------------------------------------------------------------------- results
def test_results_have_the_table_and_the_figure_where_there_are_events(tmp_path, capsys):
    with_events = metrics_of({"test": {"two_of_three": numbers_of()}})
    write_results(tmp_path / "with", with_events, [])
    print_results(with_events, [])
    assert "two of three" in capsys.readouterr().out
    assert json.loads((tmp_path / "with" / "metrics.json").read_text()) == with_events
    assert (tmp_path / "with" / "events.png").exists()
    by_bin = metrics_of({"test": {"two_of_three": nothing()}})
    write_results(tmp_path / "by_bin", by_bin, [])
    print_results(by_bin, [])
    assert REASON in capsys.readouterr().out
    assert not (tmp_path / "by_bin" / "events.png").exists()
    older = {name: of for name, of in by_bin.items() if name != "events"}
    write_results(tmp_path / "older", older, [])
    print_results(older, [])
    assert "false alarms" not in capsys.readouterr().out

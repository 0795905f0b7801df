"""The benchmark of alarms: longer hops of one watching, fronts, rivals, and how it all shows."""

from dataclasses import replace
from itertools import product
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from hydra.utils import instantiate
from scipy.signal import savgol_filter
from test_alarming import Streams, loudness_detector, stage

from benchmarks import report as whole_report
from benchmarks.onset import front, report, rivals
from benchmarks.onset.cost import next_hop
from benchmarks.onset.figure import figure
from benchmarks.onset.sizes import QUICK, Sizes
from benchmarks.onset.trained import alarming_of, at_hop, composed
from tactslip_torch.alarming.stage import FIRST_TRANSITION, OURS
from tactslip_torch.alarming.watching import Clock
from tactslip_torch.features.cache import cache_key
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.onset.scoring import score_stream
from tactslip_torch.onset.settings import AlarmSettings
from tactslip_torch.onset.streaming import StreamingDetector
from tactslip_torch.signals.filtering import ChannelFilter

SIZES = Sizes(aligns=("centred", "trailing"), hop_ms=(5.0, 10.0, 50.0), hours=1.0, rounds=1)


def behind(align: str) -> SlipDetector:
    """The detector of loudness behind a filter."""
    made = loudness_detector()
    layer = ChannelFilter([51, 11], align=align)  # type: ignore[arg-type]
    return SlipDetector(made.pool, layer, made.selected, made.scaler, made.head, made.info)


# ------------------------------------------------------------------------------------ what is run
def test_the_stage_has_the_protocol_its_quiet_and_one_rule_at_the_hop() -> None:
    config = composed(SIZES, "causal")
    assert config.features.align == "causal"
    made = alarming_of(config, 25.0, 0.5, 10.0)
    assert {recording.scene for recording in made.streams.ids} == {"paper", "held"}
    assert (made.hop_samples, made.hours, made.false_alarms_per_hour) == (50, 0.5, 10.0)
    drift = config.onset.rules.cusum.drift
    assert made.rules == {"cusum": {"name": "cusum", "drift": drift, "evidence": 0.5}}
    assert at_hop(made, 5.0, 50.0).rules["cusum"]["evidence"] == pytest.approx(0.1)
    assert at_hop(made, 80.0, 50.0).rules["cusum"]["evidence"] == 1.0


def test_there_are_as_many_hours_as_promised_for_every_role() -> None:
    sizes = Sizes()
    config = composed(sizes, "centred")
    source = instantiate(config.data, _convert_="all")
    trained = instantiate(config.split, _convert_="all")(source.ids)[0].having("train")
    info = {
        "train_recordings": {str(r): cache_key(source.key(r)) for r in trained},
        "train_materials": sorted({r.material for r in trained}),
    }
    detector: Any = SimpleNamespace(info=info)
    for hours in (sizes.hours, sizes.rival_hours):
        made = alarming_of(config, 5.0, hours, sizes.target_per_hour)
        for own in made.roles(detector).values():
            quiet = [made.streams.timeline(r).duration_s for r in own if r.scene == "held"]
            assert hours <= sum(quiet) / 3600 < hours + 0.02
            assert not {cache_key(made.streams.key(r)) for r in own} & set(
                info["train_recordings"].values()
            )
    assert sizes.hours * sizes.target_per_hour >= 10


# ------------------------------------------------------------------------------------- longer hops
def test_every_second_decision_is_what_watching_at_twice_the_hop_gives() -> None:
    detectors = {"centred": behind("centred"), "causal": behind("causal")}
    fine = front.watched_by(stage(Streams(cycles=3), hop_ms=5.0), detectors, num_workers=0)
    coarse = front.watched_by(stage(Streams(cycles=3), hop_ms=25.0), detectors, num_workers=0)
    assert {role: len(own) for role, own in fine.items()} == {
        role: len(own) for role, own in coarse.items()
    }
    for role, name in product(fine, detectors):
        for one, other in zip(fine[role], coarse[role], strict=True):
            taken = front.every(one, name, 5)
            assert taken.recording == other.recording
            np.testing.assert_array_equal(taken.score[name], other.score[name])
            np.testing.assert_array_equal(taken.is_valid[name], other.is_valid[name])
            np.testing.assert_array_equal(taken.is_usable[name], other.is_usable[name])


def test_what_is_judged_at_a_longer_hop_is_what_the_stage_says_at_it() -> None:
    detector = loudness_detector()
    usual = stage(hop_ms=50.0, rules={"cusum": {"name": "cusum", "drift": 0.5, "evidence": 1.0}})
    said = usual(detector, {}, num_workers=0)
    finest = stage(hop_ms=10.0, rules={"cusum": {"name": "cusum", "drift": 0.5, "evidence": 0.2}})
    streams = front.watched_by(finest, {"ours": detector}, num_workers=0)
    own = {  # the stage judges other scenes apart
        role: [front.every(s, "ours", 5) for s in of if s.recording.scene != "taps"]
        for role, of in streams.items()
    }
    clock = Clock(2000.0, 100, 100, detector.look_ahead)
    found, settings = front.judged(at_hop(finest, 50.0, 50.0), own, "ours", clock)
    assert found["threshold"] == said["methods"]["cusum"]["calibrated"]
    assert settings.rule.to_dict() == said["settings"]["rule"]
    for role in front.JUDGED:
        wanted = front.in_short(said["events"][f"{role} stream"]["cusum"])
        for events in (wanted, found[role]):
            if events["latency_ms"]:
                events["latency_ms"]["compute"] = None  # measured by the one, not by the other
        assert found[role] == wanted


def test_every_push_of_a_hop_makes_one_decision() -> None:
    detector = behind("trailing")
    stage()(detector, {}, num_workers=0)
    settings = replace(AlarmSettings.of(detector), hop_samples=30)
    push = next_hop(StreamingDetector(detector, settings), torch.randn(1000, 2))
    assert [len(push().number) for _ in range(70)] == [1] * 70


def test_every_filter_at_every_hop_is_a_row(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    files = {align: {"file": str(tmp_path / f"{align}.pt")} for align in SIZES.aligns}
    for align, of in files.items():
        behind(align).save(of["file"])
    config = SimpleNamespace(labels=SimpleNamespace(bin_ms=50.0))
    monkeypatch.setattr(front, "composed", lambda sizes, align: config)
    monkeypatch.setattr(front, "ENGINES", ("eager",))

    def small(_: Any, hop_ms: float, hours: float, per_hour: float) -> Any:
        return stage(Streams(cycles=3), hop_ms=hop_ms, hours=hours, false_alarms_per_hour=per_hour)

    monkeypatch.setattr(front, "alarming_of", small)
    found = front.front_of(SIZES, files)
    rows = found["rows"]
    assert [(row["align"], row["hop_ms"]) for row in rows] == list(
        product(SIZES.aligns, SIZES.hop_ms)
    )
    assert {row["align"]: row["look_ahead_ms"] for row in rows} == {"centred": 2.5, "trailing": 0.0}
    for row in rows:
        assert row["threshold"]["target_per_hour"] == SIZES.target_per_hour
        assert row["test"]["num_onsets"] == 2
        assert row["push_s"]["eager"] > 0
        assert front.compute(row, "eager") == pytest.approx(
            row["push_s"]["eager"] / (row["hop_ms"] / 1000)
        )
    assert found["streams"]["test"]["held"]["hours"] > 0


# ------------------------------------------------------------------------------------------ fronts
def of_events(found: float, median: float | None = 40.0) -> dict[str, Any]:
    def around(value: float) -> dict[str, float]:
        return {"value": value, "low": 0.5 * value, "high": 2 * value}

    delay = None if median is None else {"median": around(median), "p95": around(2 * median)}
    return {
        "found": around(found),
        "early": around(0.2 * (1 - found)),
        "missed": around(0.8 * (1 - found)),
        "false_alarms_per_hour": around(8.0),
        "delay_ms": delay,
    }


def front_row(
    align: str, hop_ms: float, median: float | None, found: float, push_s: float
) -> dict[str, Any]:
    return {
        "align": align,
        "hop_ms": hop_ms,
        "look_ahead_ms": {"centred": 12.5}.get(align, 0.0),
        "threshold": {"target_per_hour": 10.0},
        "test": of_events(found, median),
        "unseen": of_events(0.9 * found, None if median is None else 1.5 * median),
        "push_s": dict.fromkeys(front.ENGINES, push_s),
    }


def front_rows(num: int, seed: int) -> list[dict[str, Any]]:
    """Rows of few different values, so that there are ties; one finds nothing."""
    rng = np.random.default_rng(seed)
    rows = [
        front_row(
            "causal", 10.0, float(rng.integers(1, 6)), rng.integers(1, 6) / 8, rng.integers(1, 6)
        )
        for _ in range(num)
    ]
    return [*rows, front_row("centred", 10.0, None, 0.0, 0.5)]


@pytest.mark.parametrize("seed", range(5))
def test_on_a_front_is_what_nothing_beats(seed: int) -> None:
    rows = front_rows(12, seed)
    ways = {
        "compute": lambda row: (row["test"]["delay_ms"], row["push_s"][front.ENGINES[0]]),
        "test": lambda row: (row["test"]["delay_ms"], -row["test"]["found"]["value"]),
        "unseen": lambda row: (row["unseen"]["delay_ms"], -row["unseen"]["found"]["value"]),
    }
    marked = front.on_fronts(rows)
    for name, axes in ways.items():
        points = [(of[0]["median"]["value"], of[1]) for of in map(axes, rows) if of[0]]
        for place, (x, y) in enumerate(points):
            beaten = any((a <= x and b < y) or (a < x and b <= y) for a, b in points)
            assert (name in marked[place]["on"]) == (not beaten)
    assert marked[-1]["on"] == []
    assert [{k: v for k, v in row.items() if k != "on"} for row in marked] == rows


# ------------------------------------------------------------------------------------------ rivals
def loud(windows: Any) -> Any:
    """Scores by the spread of the film: the second of two channels."""
    return windows[:, 1].std(-1) - 1.2


def test_mini_rocket_sees_the_filtered_bins_that_a_detector_sees() -> None:
    detector = loudness_detector()
    rocket = rivals.MiniRocketDetector(detector.pool, detector.channel_filter, loud)
    samples = Streams().load(Streams().ids[0]).samples[:, :900].clone()
    samples[0, 400] = torch.nan  # of the gauge, which the rival looks at too
    assert rocket.look_ahead == 25
    scores = score_stream(rocket, samples, 100)
    whole = savgol_filter(samples[1].double().numpy(), 11, 1)
    wanted = [whole[start : start + 100].std() - 1.2 for start in range(0, 801, 100)]
    np.testing.assert_allclose(scores.score.numpy(), wanted, atol=1e-6)
    is_reached = [start - 25 <= 400 < start + 125 for start in range(0, 801, 100)]
    assert (~scores.is_valid).tolist() == is_reached
    assert scores.score.dtype == torch.float32


def test_training_bins_of_the_rival_are_those_of_our_detector() -> None:
    config = composed(replace(QUICK, training=(*QUICK.training, "data.seed=3")), "trailing")
    windows, is_slip = rivals.drawn_bins(config, 4, 0, num_workers=0)
    assert windows.shape == (8, 24, 100)
    assert windows.dtype == np.float32
    assert is_slip.sum() == 4
    source = instantiate(config.data, _convert_="all")
    trained = instantiate(config.split, _convert_="all")(source.ids)[0].having("train")
    unknown = list(range(8))
    for recording in trained:
        loaded = source.load(recording)
        film = loaded.samples[-1].double().numpy()
        smooth = np.convolve(film, np.ones(11) / 11)[: len(film)]  # the mean of the last 11
        for place in list(unknown):
            fits = np.flatnonzero(np.abs(smooth - windows[place, -1, 0]) < 1e-6)
            for start in fits[fits <= len(smooth) - 100].tolist():
                if np.abs(smooth[start : start + 100] - windows[place, -1]).max() < 1e-6:
                    unknown.remove(place)
                    start_s = start / 2000.0
                    slides = [a - 0.1 <= start_s <= b for a, b in loaded.sliding_s]  # annotated
                    assert any(slides) or not is_slip[place]
                    break
    assert unknown == []
    more, _ = rivals.drawn_bins(config, 10**6, 0, num_workers=0)
    assert len(more) > 100


def test_every_rival_is_a_row_beside_ours(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    file = tmp_path / "d.pt"
    loudness_detector().save(file)
    asked: dict[str, Any] = {}

    def ridge(windows: Any, targets: Any, threads: int, num_kernels: int) -> Any:
        asked.update(targets=targets.tolist(), threads=threads, num_kernels=num_kernels)
        return loud

    drawn = np.zeros((3, 2, 100), np.float32), np.array([True, False, False])
    rules = {"cusum": {"name": "cusum", "drift": 0.5, "evidence": 1.0}}
    small = stage(Streams(cycles=3), hop_ms=50.0, rules=rules)
    monkeypatch.setattr(rivals, "composed", lambda sizes, align: None)
    monkeypatch.setattr(rivals, "drawn_bins", lambda *_: drawn)
    monkeypatch.setattr(rivals, "mini_rocket_ridge", ridge)
    monkeypatch.setattr(rivals, "alarming_of", lambda *_: small)
    found = rivals.rivals_of(SIZES, {"centred": {"file": str(file)}})
    rows = {row["method"]: row for row in found["rows"]}
    assert set(rows) == {OURS, FIRST_TRANSITION, *rivals.BASELINES, rivals.MINI_ROCKET}
    assert asked == {"targets": [1.0, -1.0, -1.0], "threads": 1, "num_kernels": 10_000}
    assert found["fit"]["bins"] == {"slip": 1, "non_slip": 2}
    assert rows[FIRST_TRANSITION]["threshold"] is None
    for name, row in rows.items():
        assert row["scorer"] == (OURS if name == FIRST_TRANSITION else name)
        assert row["push_s"] > 0
        assert row["test"]["num_onsets"] == 2
    # both score by the spread of the same film, and so alarm alike
    assert rows[rivals.MINI_ROCKET]["test"]["num_found"] == rows[OURS]["test"]["num_found"]


# ---------------------------------------------------------------------------------- how it is shown
def report_of() -> dict[str, Any]:
    rows = [
        front_row(align, hop, hop + 20.0 + 7 * place, 0.99 - 0.01 * place, 2e-3 + 1e-3 * place)
        for (place, align), hop in product(enumerate(("centred", "causal", "trailing")), (5, 50))
    ]
    others = [
        {"method": OURS, "scorer": OURS, "test": of_events(0.98), "unseen": of_events(0.9)},
        {"method": FIRST_TRANSITION, "scorer": OURS, "test": of_events(1), "unseen": of_events(1)},
        {"method": "silent", "scorer": "silent", "test": of_events(0, None)},
    ]
    others[-1]["unseen"] = of_events(0.95)
    others = [{**row, "threshold": None, "push_s": 2e-3} for row in others]
    quiet = {"recordings": 90, "hours": 1.5, "slips": 0}
    paper = {"recordings": 60, "hours": 0.2, "slips": 180}
    streams = {role: {"held": quiet, "paper": paper} for role in ("calibrate", *front.JUDGED)}
    trained = {
        align: {
            "balanced_accuracy": {"test": 0.964, "unseen": 0.9},
            "features": 120,
            "training_bins": 65688,
            "seconds": 99.0,
        }
        for align in ("centred", "causal", "trailing")
    }
    fit = {"bins": {"slip": 2500, "non_slip": 2500}, "kernels": 10_000, "seconds": 30.0}
    return {
        "simulated": True,
        "quick": False,
        "machine": {"processor": "abacus"},
        "versions": {"torch": torch.__version__},
        "settings": {"target_per_hour": 10.0, "rival_hop_ms": 50.0},
        "sections": {
            "trained": trained,
            "front": {"streams": streams, "rows": front.on_fronts(rows)},
            "rivals": {"streams": streams, "fit": fit, "rows": others},
        },
        "limits": report.limit_rows(rows, others),
    }


def test_limits_are_the_target_within_the_interval_and_the_best_rival() -> None:
    made = report_of()["limits"]
    judged = [row["ok"] for row in made if row["ok"] is not None]
    assert judged == [*[True] * 6, True, False]  # the first transition is no rival of ours
    rows = report_of()["sections"]["front"]["rows"]
    rows[1]["test"]["false_alarms_per_hour"] = {"value": 20.0, "low": 10.1, "high": 40.0}
    again = report.limit_rows(rows, report_of()["sections"]["rivals"]["rows"])
    assert [row["ok"] for row in again[:3]] == [True, False, True]


def test_the_report_is_shown_in_tables_a_figure_and_benchmarks_md(tmp_path: Any) -> None:
    made = report_of()
    assert not whole_report._missing(made, whole_report.SECTIONS["onset"])
    text = report.report_text(made)
    assert "SIMULATED" in text
    assert "simulated hand" in text
    assert "10 false alarms an hour" in text
    assert "set on 1.5 h without slip and 180 slips" in text
    figure(made, tmp_path / "o.png")
    assert (tmp_path / "o.png").stat().st_size > 30_000
    page = whole_report.markdown({"onset": made}, "results")
    assert "![Alarms: hops, filters and rivals](results/onset.png)" in page
    cost = " | 400" * len(front.ENGINES)
    first = "| 5 | 25 (12 to 50) | 50 (25 to 100) | 99.0 | 0.2 | 0.8 | 8 (4 to 16)"
    assert f"| centred * + {first}{cost} |" in page
    assert "| silent | seen | - | - | 0.0 | 20.0 | 80.0 | 8 (4 to 16) | 2 |" in page
    assert "| trailing | 0 | 96.4 | 90.0 | 120 | 65,688 | 99 |" in page
    assert "onset: centred, hop 5 ms: false alarms an hour" in page


def test_a_front_of_which_nothing_finds_a_slip_is_drawn(tmp_path: Any) -> None:
    made = report_of()
    rows = [front_row("causal", 5.0, None, 0.0, 1e-3)]
    made["sections"]["front"]["rows"] = front.on_fronts(rows)
    figure(made, tmp_path / "o.png")
    assert (tmp_path / "o.png").stat().st_size > 10_000
    assert "-" in report.delay(rows[0]["test"], "median")

"""The benchmark of the ladder: its reference, its shares, what it concludes, and how it shows."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from benchmarks import report as whole_report
from benchmarks.simulation import accuracy, cost, errors, report
from benchmarks.simulation.figure import figure
from benchmarks.simulation.radau import radau, right_hand_side
from benchmarks.simulation.sizes import QUICK
from tactslip_torch.simulation import Scene, Stroke, simulate
from tactslip_torch.simulation.grasp import draw_grasp

TINY = replace(QUICK, steps_us=(500.0, 125.0), behind_s=0.01)
ELEMENT = {
    "mass_kg": 5e-3,
    "stiffness_n_m": 900.0,
    "relaxing_n_m": 100.0,
    "relaxation_time_s": 0.5,
    "damping_n_s_m": 1.0,
    "mu_s": 0.8,
    "mu_k": 0.6,
    "stribeck_m_s": 0.01,
    "bristle_stiffness_n_m": 1e5,
    "bristle_damping_n_s_m": 10.0,
    "viscous_n_s_m": 0.5,
}


# --- the reference ------------------------------------------------------------------------------


def test_steady_sliding_of_the_reference_is_the_sum_of_frictions() -> None:
    pressure, speed = np.array([0.25, 0.75]), 0.06
    rates = right_hand_side(ELEMENT, pressure, lambda t: speed, lambda t: 2.0)
    friction = 0.6 * 2.0 + 0.2 * 2.0 * np.exp(-36.0)  # mu(v) N, without viscous friction
    bristles = pressure * friction / (1e5 / 2)
    stretch = (friction + 0.5 * speed) / 900.0
    np.testing.assert_allclose(rates(0.0, np.r_[stretch, speed, 0.0, bristles]), 0.0, atol=1e-9)


def test_a_stuck_element_of_the_reference_is_a_standard_linear_solid() -> None:
    held = {**ELEMENT, "mu_s": 1e6, "mu_k": 1e6, "bristle_stiffness_n_m": 1e8}
    speed, until_s = 0.01, 0.3
    at = radau(held, np.ones(1), lambda t: speed, lambda t: 1.0, until_s)
    time_s = np.array([0.1, 0.2, 0.3])
    force, slip = at(time_s)
    maxwell = 100.0 * speed * 0.5 * -np.expm1(-time_s / 0.5)
    np.testing.assert_allclose(force, 900.0 * speed * time_s + maxwell, rtol=1e-4)
    np.testing.assert_allclose(slip, 0.0, atol=1e-6)


@pytest.mark.parametrize("rung", cost.RUNGS)
def test_errors_are_small_and_fall_with_the_step(rung: str) -> None:
    found = errors.elements(rung, TINY)
    coarse, fine = (errors.step_errors(rung, found, step) for step in TINY.steps_us)
    assert 0 < fine["friction_error"] < 0.01
    assert fine["friction_error"] < 0.5 * coarse["friction_error"]
    assert fine["onset_error_s"] < 1e-3


def test_the_kinematic_rung_is_close_to_radau_and_not_equal() -> None:
    found = errors.kinematic_errors(errors.elements("lugre", TINY))
    assert 0.005 < found["friction_error"] < 0.5
    assert 0 < found["onset_error_s"] < 0.02


def test_an_element_that_never_slides_has_no_onset() -> None:
    with pytest.raises(ValueError, match="does not slide"):
        errors.onset(np.arange(3.0), np.zeros(3), np.ones(3))


# --- what is counted ----------------------------------------------------------------------------


def test_a_step_that_no_sample_holds_is_costed_on_coarser_samples() -> None:
    scene = Scene("M2", fidelity="lugre")
    assert cost.at_step(scene, 1000.0).sample_rate_hz == 1000.0
    fine = cost.at_step(scene, 62.5)
    assert (fine.sample_rate_hz, fine.dynamics.step_us) == (2000.0, 62.5)


def test_lane_samples_are_strokes_with_their_settling_times_elements() -> None:
    scene = Scene("M2", strokes=(Stroke(40.0, 20.0, 0.1), Stroke(40.0, 20.0, 0.1)))
    lasts_s = 20 / 40 + 40 / 500
    wanted = len(draw_grasp(scene).touching) * 2000 * (2 * lasts_s + 0.1 + 0.25)
    assert cost.lane_samples([scene, scene]) == pytest.approx(2 * wanted, rel=1e-3)


def test_every_channel_of_the_hand_that_is_taken_apart_is_an_element() -> None:
    grasp = draw_grasp(Scene("M2", hand=cost.apart_hand()))
    assert sorted(grasp.element_of_channel.tolist()) == list(range(24))
    assert len(set(cost.SOME)) == 6 <= len(set(cost.apart_hand().names) & set(cost.SOME))


def test_what_bins_need_is_simulated_and_no_more() -> None:
    scene = Scene("M2", strokes=(Stroke(40.0, 20.0, 1.2),))
    whole = int(simulate(scene).samples.isfinite().sum())
    onset_s, end_s = simulate(scene, windows=[(0.0, 0.1)]).sliding_s[0]
    assert 24 * 2000 * (end_s - onset_s) < cost._needed(scene) < 0.99 * whole


def test_accuracy_is_that_of_a_detector_and_the_same_again() -> None:
    sizes = replace(QUICK, accuracy_steps_us=())
    (row,) = accuracy.accuracies(sizes)
    assert (row["rung"], row["step_us"]) == ("kinematic", None)
    assert 0.8 < row["accuracy"] <= 1.0
    assert row["on"] == {"kinematic": row["accuracy"]}


# --- what is concluded --------------------------------------------------------------------------


def costs(**seconds: float) -> list[dict[str, Any]]:
    found = []
    for rung, value in seconds.items():
        for step in (None,) if rung == "kinematic" else (500.0, 250.0):
            row = {"rung": rung, "step_us": step, "engine": "compiled", "integration_s": 0.1}
            found.append({**row, "seconds_per_minute": value})
    return found


def error_rows(**friction: float) -> list[dict[str, Any]]:
    rows = [
        {"rung": rung, "step_us": step, "friction_error": f, "onset_error_s": 1e-5}
        for rung in ("lugre", "patch")
        for step, f in ((500.0, friction["coarse"]), (250.0, friction["fine"]))
    ]
    first = {"rung": "kinematic", "step_us": None, "friction_error": 0.2, "onset_error_s": 1e-3}
    return [first, *rows]


def trained(kinematic: float, lugre: float) -> list[dict[str, Any]]:
    """Accuracy on lugre's test of detectors trained on either."""
    return [
        {
            "rung": "kinematic",
            "step_us": None,
            "accuracy": 0.97,
            "on": {"kinematic": 0.97, "lugre": kinematic},
        },
        {
            "rung": "lugre",
            "step_us": 250.0,
            "accuracy": lugre,
            "on": {"kinematic": 0.97, "lugre": lugre},
        },
    ]


def test_the_longest_step_within_the_errors_and_the_cheapest_rung_are_recommended() -> None:
    made = costs(kinematic=1.0, lugre=2.0)
    fine = report.recommended(made, error_rows(coarse=0.1, fine=0.01), trained(0.955, 0.96))
    assert (fine["rung"], fine["step_us"]) == ("kinematic", 250.0)
    dear = report.recommended(made, error_rows(coarse=0.02, fine=0.01), trained(0.90, 0.96))
    assert (dear["rung"], dear["step_us"]) == ("lugre", 500.0)
    none = report.recommended(made, error_rows(coarse=0.1, fine=0.1), [])
    assert (none["rung"], none["step_us"]) == (None, None)
    assert "250 us" in fine["why"]
    assert "not measured" in none["why"]


def needed(seconds: float, recordings: int = 280) -> list[dict[str, Any]]:
    return [
        {"rung": rung, "recordings": recordings, "processes": 2, "seconds": seconds}
        for rung in ("kinematic", "lugre")
    ]


PARTS = {
    "kinematic": {"whole": 10.0, "some": 5.0, "some alone": 3.0, "window": 1.5},
    "lugre": {"whole": 20.0, "some": 9.0, "some alone": 8.0, "window": 9.0},
}


def test_limits_hold_the_default_rung_and_both_trainings() -> None:
    verdicts = [row["ok"] for row in report.limit_rows(PARTS, needed(40.0))]
    assert verdicts == [True, False, False, None, None, None, True, True]
    assert [row["ok"] for row in report.limit_rows(PARTS, needed(61.0))][-2:] == [False, False]
    assert [row["ok"] for row in report.limit_rows(PARTS, needed(1.0, 28))][-2:] == [None, None]


def test_the_report_is_shown_in_tables_a_figure_and_benchmarks_md(tmp_path: Any) -> None:
    sections = {
        "cost": costs(kinematic=1.0, lugre=2.0, patch=3.0),
        "errors": error_rows(coarse=0.1, fine=0.01),
        "accuracy": trained(0.95, 0.96),
        "parts": PARTS,
        "needed": needed(40.0),
    }
    made = {
        "simulated": True,
        "quick": False,
        "machine": {"processor": "abacus"},
        "versions": {"torch": torch.__version__},
        "sections": sections,
        "recommended": report.recommended(
            sections["cost"], sections["errors"], sections["accuracy"]
        ),
        "limits": report.limit_rows(PARTS, sections["needed"]),
    }
    assert not whole_report._missing(made, whole_report.SECTIONS["simulation"])
    text = report.report_text(made)
    assert "SIMULATED" in text
    figure(made, tmp_path / "s.png")
    assert (tmp_path / "s.png").stat().st_size > 10_000
    page = whole_report.markdown({"simulation": made}, "results")
    assert "| lugre | 250 | compiled | 2 | 0.1 | 1 | 0.01 | 96.0 |" in page
    assert "| kinematic | - | 97.0 | 95.0 |" in page
    assert "simulation: kinematic, batch: 1 s window" in page

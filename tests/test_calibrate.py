"""Calibration looks at seen materials and one published number, and says all that it tried."""

import json
import subprocess
import sys
from types import MappingProxyType

import pytest
from test_commands import composed

from tactslip_torch.commands import calibrate as command
from tactslip_torch.commands.calibrate import (
    Point,
    calibrate,
    chosen_point,
    evaluate_point,
    next_difficulty,
)
from tactslip_torch.commands.train import train
from tactslip_torch.report import published
from tactslip_torch.report.calibration import calibration_table
from tactslip_torch.simulation import Contact, Disturbances, paper_scenes, parameters
from tactslip_torch.simulation.parameters import (
    CALIBRATED,
    CALIBRATED_PATH,
    PRIORS,
    parameters_at,
    read_calibrated,
)

SMALL = (
    "data.cycles=1",
    "data.materials=[M1,M5]",
    "split.seen=[M1,M5]",
    "recipe.num_features=8",
    "recipe.penalties=[0.1,1.0]",
    "num_workers=0",
)
TINY = (*SMALL, "seeds=[1000]", "fact_cycles=1", "most_points=2", "step=1.5")


def tiny(*overrides):
    return composed(*TINY, *overrides, name="calibrate")


def searched(accuracy, *, holds=lambda d: True, target=0.96, tolerance=0.001, bounds=(-3.0, 3.0)):
    """Every point that the search tries on a curve, in order."""
    points = []
    while (place := next_difficulty(points, target, tolerance, bounds)) is not None:
        assert place not in [point.difficulty for point in points]
        assert bounds[0] <= place <= bounds[1]
        points.append(Point(place, accuracy(place), holds(place)))
        assert len(points) < 30
    return points


# --- the search ---------------------------------------------------------------------------------


@pytest.mark.parametrize("root", [-2.3, -0.4, 0.6, 1.0, 2.71])
@pytest.mark.parametrize("bend", [0.0, 0.002, -0.002])
def test_the_search_meets_the_target_on_a_falling_curve(root, bend):
    def accuracy(d):
        return 0.96 - 0.015 * (d - root) - bend * (d - root) * abs(d - root)

    points = searched(accuracy)
    assert abs(points[-1].accuracy - 0.96) <= 0.001
    assert chosen_point(points, 0.96) == len(points) - 1
    assert len(points) <= 8


def test_a_target_behind_failing_facts_is_approached_as_far_as_they_hold():
    points = searched(lambda d: 0.99 - 0.0125 * d, holds=lambda d: d < 2.3)
    kept = points[chosen_point(points, 0.96)]
    assert 2.2 <= kept.difficulty < 2.3


def test_the_search_stops_at_once_where_it_starts_on_the_target():
    assert len(searched(lambda d: 0.9605 - 0.01 * d)) == 1


@pytest.mark.parametrize(("sign", "bounds"), [(1, (-3.0, 2.5)), (-1, (-2.5, 3.0))])
def test_the_search_ends_at_the_bound(sign, bounds):
    points = searched(lambda d: 0.96 + sign * 0.1 - 0.001 * d, bounds=bounds)
    assert [point.difficulty for point in points] == [0.0, sign * 1.0, sign * 2.0, sign * 2.5]
    assert chosen_point(points, 0.96) == 3


@pytest.mark.parametrize("width", [0.333, 0.337, 1.004, 0.003])
@pytest.mark.parametrize("sign", [1, -1])
def test_a_bound_between_hundredths_is_tried_once(width, sign):
    points = searched(lambda d: 0.96 + sign * 0.1 - 0.001 * d, bounds=(-width, width))
    assert points[-1].difficulty == sign * width
    assert len(points) == (3 if width > 1 else 2)


def test_within_bounds_between_hundredths_a_target_is_met():
    points = searched(lambda d: 0.96 - 0.05 * (d - 0.317), bounds=(-0.333, 0.333))
    assert abs(points[-1].accuracy - 0.96) <= 0.001


def test_the_least_step_still_gets_on():
    tried = [Point(0.0, 0.99, True)]
    assert next_difficulty(tried, 0.96, 0.001, (-3, 3), step=0.001) == 0.02


@pytest.mark.parametrize("edge", [0.31, 1.5, 2.2])
def test_the_search_is_cut_back_to_where_the_facts_hold(edge):
    points = searched(lambda d: 0.99 - 0.01 * d, holds=lambda d: d < edge)
    kept = points[chosen_point(points, 0.96)]
    assert kept.holds
    assert edge - 0.1 <= kept.difficulty < edge


def test_facts_that_fail_beyond_the_target_do_not_matter():
    points = searched(lambda d: 0.99 - 0.02 * d, holds=lambda d: d < 1.8)
    assert abs(points[chosen_point(points, 0.96)].accuracy - 0.96) <= 0.001


def test_nothing_is_kept_where_the_facts_fail_at_the_start():
    points = searched(lambda d: 0.99, holds=lambda d: False)
    assert len(points) == 1
    assert chosen_point(points, 0.96) is None


# --- the line and the frozen values -------------------------------------------------------------


def test_the_line_begins_at_the_starting_values_and_gets_harder():
    assert parameters_at(0.0) == {
        "friction_noise_mv": 8.0,  # PHYSICS.md, starting knobs
        "presliding_mm": (0.3, 3.0),
        "burst_rate_hz": 0.3,
    }
    rows = [parameters_at(d) for d in (-1.0, 0.0, 1.0, 2.0)]
    noise = [row["friction_noise_mv"] for row in rows]
    assert noise == sorted(noise, reverse=True)
    for name in ("presliding_mm", "burst_rate_hz"):
        assert [row[name] for row in rows] == sorted(row[name] for row in rows)
    low, high = zip(*(row["presliding_mm"] for row in rows), strict=True)
    assert [b / a for a, b in zip(low, high, strict=True)] == pytest.approx([10.0] * 4, rel=1e-3)


def test_every_place_within_the_bounds_is_a_scene():
    bounds = composed(name="calibrate").bounds
    for difficulty in bounds:
        paper_scenes(cycles=1, materials=["M1"], **parameters_at(difficulty))


def test_knobs_take_the_frozen_values():
    values = json.loads(CALIBRATED_PATH.read_text())["values"]
    assert set(values) == set(PRIORS)
    assert list(Contact().presliding_mm) == values["presliding_mm"]
    assert (
        Contact().friction_noise_mv
        == values["friction_noise_mv"]
        == CALIBRATED["friction_noise_mv"]
    )
    assert Disturbances().burst_rate_hz == values["burst_rate_hz"]


@pytest.mark.parametrize(
    "text",
    ["", "{", "[]", '{"values": null}', '{"values": {}}', '{"values": {"friction_noise_mv": []}}'],
)
def test_a_damaged_file_of_frozen_values_is_one_line(tmp_path, text):
    path = tmp_path / "calibrated.json"
    wanted = "must hold the calibrated parameters.*; restore it from the release"
    with pytest.raises(ValueError, match=wanted):
        read_calibrated(path)
    path.write_text(text)
    with pytest.raises(ValueError, match=wanted) as refusal:
        read_calibrated(path)
    assert "\n" not in str(refusal.value)


# --- the command --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    folder = tmp_path_factory.mktemp("calibrate")
    return calibrate(tiny(), folder), folder


def test_accuracy_is_what_train_reports_for_the_same_knobs_and_seed(tmp_path, found):
    point = found[0]["points"][1]
    scene = [
        f"+scene.{name}={str(value).replace(' ', '')}" for name, value in point["knobs"].items()
    ]
    overrides = (*SMALL, *scene, "+exp=random_bins", "data.materials=[M1,M5]")
    config = composed(
        *overrides, "recipe=paper", "seed=1000", "cache=off", "export=false", name="train"
    )
    assert train(config, tmp_path)["test/accuracy"] == point["accuracy"]
    assert point["accuracy_by_seed"] == [point["accuracy"]]
    assert point["accuracy"] < 1


def test_a_point_is_the_mean_over_its_seeds(found):
    several = evaluate_point(tiny("seeds=[1000,1001]"), -1.5)
    first, second = several["accuracy_by_seed"]
    assert first == found[0]["points"][1]["accuracy"] != second
    assert several["accuracy"] == (first + second) / 2


def test_the_command_leaves_all_it_tried(found):
    content, folder = found
    assert json.loads((folder / "calibration.json").read_text()) == content
    assert [point["difficulty"] for point in content["points"]] == [0.0, -1.5]
    for point in content["points"]:
        assert point["knobs"] == json.loads(json.dumps(parameters_at(point["difficulty"])))
        assert {fact["name"] for fact in point["facts"]} >= {"sg_rise", "pvdf_slide_over_rest"}
    assert content["values"] == content["points"][1]["knobs"]  # closer to the target than d = 0
    assert content["target"]["accuracy"] == 0.9639
    assert "no point tried is closer" in content["verdict"]
    assert (folder / "calibration.png").read_bytes().startswith(b"\x89PNG")
    assert (folder / "config.yaml").exists()
    assert str(folder) not in (folder / "calibration.json").read_text()
    protocol = {name: content["protocol"][name] for name in ("step", "most_points", "fact_cycles")}
    assert protocol == {"step": 1.5, "most_points": 2, "fact_cycles": 1}


def test_unseen_materials_and_their_results_are_used_nowhere(tmp_path, found, monkeypatch):
    monkeypatch.setattr(published, "SPLITS", MappingProxyType({"test": published.SPLITS["test"]}))
    monkeypatch.setattr(parameters, "UNSEEN_MATERIALS", ())
    for name in ("wood", "copper", "cloth", "iron"):  # they come back in the table's order
        monkeypatch.delitem(parameters.MATERIALS, name)
    with pytest.raises(ValueError, match="unknown material 'iron'"):
        paper_scenes(cycles=1, materials=["iron"])  # they are gone indeed
    calibrate(tiny(), tmp_path)
    written = (tmp_path / "calibration.json").read_bytes()
    assert written == (found[1] / "calibration.json").read_bytes()


def test_the_published_test_accuracy_is_the_target(tmp_path, monkeypatch):
    other = published.PublishedSplit(accuracy=0.5)
    monkeypatch.setattr(published, "SPLITS", {"test": other})
    content = calibrate(tiny(), tmp_path)
    assert content["points"][1]["difficulty"] == 1.5


@pytest.fixture
def frozen(tmp_path, monkeypatch):
    """Where values are frozen: not in the package, whatever a test finds."""
    path = tmp_path / "package" / "calibrated.json"
    monkeypatch.setattr(command, "CALIBRATED_PATH", path)
    return path


@pytest.fixture
def whole(found, frozen, monkeypatch):
    """The protocol of ``conf/calibrate.yaml``, with the points of a smaller one put in."""

    def composed_with(*overrides, holds=True):
        def point(_, difficulty):
            facts = [fact | {"holds": holds} for fact in found[0]["points"][1]["facts"]]
            knobs = json.loads(json.dumps(parameters_at(difficulty)))
            scores = {"accuracy": 0.97, "accuracy_by_seed": [0.97, 0.97, 0.97]}
            return {
                "difficulty": difficulty,
                "knobs": knobs,
                "facts": facts,
                "holds": holds,
            } | scores

        monkeypatch.setattr(command, "evaluate_point", point)
        return composed("write=true", *overrides, name="calibrate")

    return composed_with


def test_write_freezes_the_values_that_knobs_then_take(tmp_path, frozen, whole):
    content = calibrate(whole(), tmp_path)
    assert content["difficulty"] in (0.0, 2.0)
    assert frozen.read_bytes() == (tmp_path / "calibration.json").read_bytes()
    assert read_calibrated(frozen) == parameters_at(content["difficulty"])


def test_without_write_nothing_is_frozen(tmp_path, frozen):
    calibrate(tiny("most_points=1"), tmp_path / "results")
    assert not frozen.exists()


def test_facts_that_fail_at_the_start_are_an_error(tmp_path):
    loud = "+scene.mains_mv=300"  # nobody hears M5 slide
    with pytest.raises(ValueError, match=r"the facts .*pvdf_slide_over_rest.* do not hold"):
        calibrate(tiny(loud), tmp_path / "results")


def test_facts_that_fail_at_the_start_freeze_nothing(tmp_path, frozen, whole):
    with pytest.raises(ValueError, match=r"the facts .*pvdf_slide_over_rest.* do not hold"):
        calibrate(whole(holds=False), tmp_path / "results")
    assert not frozen.exists()


@pytest.mark.parametrize(
    ("override", "section"),
    [
        ("labels=half_second", "labels"),
        ("split=seen6", "split"),
        ("split.train_share=0.5", "split"),
        ("recipe=robust", "recipe"),
        ("recipe.among={kind:SG}", "recipe"),
        ("scene=taps", "scene"),
        ("+scene.mains_mv=300", "scene"),
        ("features.align=causal", "features"),
        ("data.cycles=2", "data"),
        ("data.fidelity=bristles", "data"),
        ("others=confound", "others"),
    ],
)
def test_another_protocol_is_not_frozen(tmp_path, frozen, whole, override, section):
    with pytest.raises(ValueError, match=f"^write=true freezes .*, and {section} differ from it"):
        calibrate(whole(override), tmp_path / "results")
    assert not (tmp_path / "results").exists()
    calibrate(whole(override, "write=false", "most_points=1"), tmp_path / "results")
    assert not frozen.exists()


def test_a_recipe_that_restricts_the_ranking_scores_as_in_train(tmp_path, found):
    films = "recipe.among={kind:PVDF,domain:freq}"
    point = evaluate_point(tiny(films), 0.0)
    scene = [
        f"+scene.{name}={str(value).replace(' ', '')}" for name, value in point["knobs"].items()
    ]
    overrides = (*SMALL, *scene, films, "+exp=random_bins", "data.materials=[M1,M5]")
    config = composed(*overrides, "recipe=paper", "seed=1000", "cache=off", "export=false")
    assert train(config, tmp_path)["test/accuracy"] == point["accuracy"]
    assert point["accuracy"] != found[0]["points"][0]["accuracy"]


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("data.materials=[M1,iron,wood]", "seen materials only, .* got iron, wood"),
        ("seeds=[0,1000]", r"1000 or more, .* got \[0, 1000\]"),
        ("seeds=[1000,1000]", "seeds must differ"),
        ("seeds=[]", "seeds must differ"),
        ("bounds=[1,2]", r"bounds must hold 0, .* got \[1, 2\]"),
        ("seeds=1000", r"seeds must be a list of whole numbers, .* got 1000"),
        ("seeds=[1000.5]", r"seeds must be a list of whole numbers, .* got \[1000.5\]"),
        ("seeds=null", r"seeds must be a list of whole numbers, .* got None"),
        ("bounds=3", r"bounds must be two numbers, such as \[-2,2\], got 3"),
        ("bounds=[-1]", r"bounds must be two numbers, .* got \[-1\]"),
        ("bounds=[-1,a]", r"bounds must be two numbers, .* got \[-1, 'a'\]"),
        ("bounds=[nan,1]", r"bounds must hold 0"),
        ("tolerance=0", "tolerance must be a positive number, got 0"),
        ("tolerance=abc", "tolerance must be a positive number, got abc"),
        ("tolerance=nan", "tolerance must be a positive number, got nan"),
        ("step=null", "step must be a positive number, got None"),
        ("most_points=0", "most_points must be a positive whole number, got 0"),
        ("most_points=1.5", "most_points must be a positive whole number, got 1.5"),
        ("fact_cycles=true", "fact_cycles must be a positive whole number, got True"),
    ],
)
def test_what_is_no_calibration_is_refused(tmp_path, override, message):
    with pytest.raises(ValueError, match=message):
        calibrate(tiny(override), tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_bad_input_is_one_line_and_exit_status_2(tmp_path):
    arguments = [sys.executable, "-m", "tactslip_torch", "calibrate", "seeds=[3]"]
    done = subprocess.run(arguments, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("error: seeds must differ and be 1000 or more")
    assert done.stderr.count("\n") == 1


def test_the_table_by_hand():
    def point(d, accuracy, holds):
        facts = [
            {"name": "loud", "says": "it is loud", "low": 1.5, "high": None}
            | {"values": {"M1": 2.0}, "holds": holds}
        ]
        return {
            "difficulty": d,
            "knobs": {"friction_noise_mv": 8.0, "presliding_mm": [0.3, 3.0]},
            "accuracy": accuracy,
            "accuracy_by_seed": [accuracy - 0.01, accuracy + 0.01],
            "holds": holds,
            "facts": facts,
        }

    points = [point(0.0, 0.98, True), point(2.0, 0.95, False), point(1.0, 0.97, True)]
    content = {
        "points": points,
        "values": points[2]["knobs"],
        "difficulty": 1.0,
        "seeds": [1000, 1001],
        "facts": points[2]["facts"],
        "target": {"accuracy": 0.9639, "row": "test", "source": "a paper"},
        "verdict": "what became of it",
    }
    lines = calibration_table(content).splitlines()
    assert lines[0].startswith("SIMULATED")
    rows = [line.split() for line in lines]
    values = ["8", "0.3", "to", "3"]
    middle = ["+1.00", *values, "97.00", "96.00", "98.00", "hold"]
    last = ["+2.00", *values, "95.00", "94.00", "96.00", "fail:", "loud"]
    assert rows.index(middle) < rows.index(last)
    assert ["it", "is", "loud", "above", "1.5", "2"] in rows
    assert lines[-1] == "what became of it"

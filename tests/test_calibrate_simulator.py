"""Calibration looks at seen materials and one published number, and says all that it tried."""

import json
from types import MappingProxyType

import pytest
from drawing import assert_png
from test_commands import composed

from tactslip_torch.commands import calibrate_simulator as command
from tactslip_torch.commands.calibrate_simulator import best_point, calibrate, parameters_at, search
from tactslip_torch.report import published
from tactslip_torch.simulation import paper_scenes, scene
from tactslip_torch.simulation.scene import read_calibrated


def tiny(*overrides):
    return composed(
        *("data.cycles=1", "data.materials=[M1,M5]", "split.seen=[M1,M5]", "num_workers=0"),
        *("recipe.num_features=8", "recipe.penalties=[0.1,1.0]"),
        *("seeds=[1000]", "check_cycles=1", "most_points=2", "step=1.5"),
        *overrides,
        name="calibrate_simulator",
    )


def untouched(*overrides):
    """The command's configuration as it is, but for some values."""
    return composed(*overrides, name="calibrate_simulator")


# --- the search ---------------------------------------------------------------------------------


def searched(accuracy, *, holds=lambda d: True, bounds=(-3.0, 3.0), **options):
    """Every point that the search tries on a curve, in order, and the one that is kept."""

    def evaluate(d):
        return {"difficulty": d, "accuracy": accuracy(d), "holds": holds(d), "signal_checks": []}

    points = search(evaluate, 0.96, 0.001, bounds, most_points=30, **options)
    places = [point["difficulty"] for point in points]
    assert len(set(places)) == len(places) < 30
    assert all(bounds[0] <= place <= bounds[1] for place in places)
    return places, best_point(points, 0.96)


@pytest.mark.parametrize("root", [-2.3, -0.4, 0.6, 1.0, 2.71])
@pytest.mark.parametrize("bend", [0.0, 0.002, -0.002])
def test_the_search_meets_the_target_on_a_falling_curve(root, bend):
    def accuracy(d):
        return 0.96 - 0.015 * (d - root) - bend * (d - root) * abs(d - root)

    places, kept = searched(accuracy)
    assert abs(kept["accuracy"] - 0.96) <= 0.001
    assert kept["difficulty"] == places[-1]
    assert len(places) <= 8


@pytest.mark.parametrize("edge", [0.31, 1.5, 2.2, 2.35])
def test_the_search_is_cut_back_to_where_the_checks_hold(edge):
    _, kept = searched(lambda d: 0.99 - 0.0125 * d, holds=lambda d: d < edge)
    assert edge - 0.1 <= kept["difficulty"] < edge


# --- the line and the frozen values -------------------------------------------------------------


@pytest.mark.parametrize("text", [None, "", "[]", '{"values": {"friction_noise_mv": []}}'])
def test_a_damaged_file_of_frozen_values_is_one_line(tmp_path, text):
    path = tmp_path / "calibrated.json"
    if text is not None:
        path.write_text(text)
    with pytest.raises(ValueError, match="must hold the calibrated parameters") as refusal:
        read_calibrated(path)
    assert "restore it from the release" in str(refusal.value)


# --- the command --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    folder = tmp_path_factory.mktemp("calibrate")
    return calibrate(tiny(), folder), folder


@pytest.mark.slow
def test_the_command_leaves_all_it_tried(found):
    content, folder = found
    assert json.loads((folder / "calibration.json").read_text()) == content
    assert [point["difficulty"] for point in content["points"]] == [0.0, -1.5]
    for point in content["points"]:
        assert point["parameters"] == parameters_at(point["difficulty"])
        names = {check["name"] for check in point["signal_checks"]}
        assert names >= {"sg_rise", "pvdf_slide_over_rest"}
    assert content["values"] == content["points"][1]["parameters"]  # closer to the target than d=0
    assert content["target"]["accuracy"] == 0.9639
    assert "no point tried is closer" in content["outcome"]
    assert_png(folder / "calibration.png")
    assert (folder / "config.yaml").exists()
    assert str(folder) not in (folder / "calibration.json").read_text()
    protocol = {"step": 1.5, "most_points": 2, "check_cycles": 1}
    assert content["protocol"].items() >= protocol.items()


@pytest.mark.slow
def test_unseen_materials_and_their_results_are_used_nowhere(tmp_path, found, monkeypatch):
    monkeypatch.setattr(published, "SPLITS", MappingProxyType({"test": published.SPLITS["test"]}))
    monkeypatch.setattr(scene, "UNSEEN_MATERIALS", ())
    for name in ("wood", "copper", "cloth", "iron"):  # they come back in the table's order
        monkeypatch.delitem(scene.MATERIALS, name)
    with pytest.raises(ValueError, match="unknown material 'iron'"):
        paper_scenes(cycles=1, materials=["iron"])  # they are gone indeed
    calibrate(tiny(), tmp_path)
    written = (tmp_path / "calibration.json").read_bytes()
    assert written == (found[1] / "calibration.json").read_bytes()


CHECK = {"name": "loud", "says": "it is loud", "low": 1.5, "high": None, "values": {"M1": 2.0}}


@pytest.fixture
def put_in(monkeypatch, tmp_path):
    """Points put in, and another place for frozen values than the package."""
    path = tmp_path / "package" / "calibrated.json"
    monkeypatch.setattr(command, "CALIBRATED_PATH", path)

    def put(holds=True):
        def point(config, difficulty):
            found = {"difficulty": difficulty, "parameters": parameters_at(difficulty)}
            found |= {"accuracy": 0.97, "accuracy_by_seed": [0.97] * len(config.seeds)}
            return found | {"holds": holds, "signal_checks": [{**CHECK, "holds": holds}]}

        monkeypatch.setattr(command, "evaluate_point", point)

    put()
    put.path = path
    return put


def test_write_freezes_the_values_that_parameters_then_take(tmp_path, put_in):
    calibrate(untouched("most_points=1"), tmp_path)
    assert not put_in.path.exists()
    content = calibrate(untouched("write=true"), tmp_path)
    assert put_in.path.read_bytes() == (tmp_path / "calibration.json").read_bytes()
    frozen = json.loads(json.dumps(dict(read_calibrated(put_in.path))))
    assert frozen == parameters_at(content["difficulty"])


def test_checks_that_fail_at_the_start_freeze_nothing(tmp_path, put_in):
    put_in(holds=False)
    with pytest.raises(ValueError, match=r"^the signal checks loud do not hold at the starting"):
        calibrate(untouched("write=true"), tmp_path / "results")
    assert not put_in.path.exists()


REFUSED = [
    (["write=true", "labels=half_second"], "^write=true freezes .*, and labels differ from it"),
    (["write=true", "split=seen6"], "and split differ from it"),
    (["write=true", "+scene.mains_mv=300"], "and scene differ from it"),
    (["write=true", "extra_scenes=confound"], "and extra_scenes differ from it"),
    (["data.materials=[M1,iron,wood]"], "seen materials only, .* got iron, wood"),
    (["seeds=[0,1000]"], r"1000 or more, .* got \[0, 1000\]"),
    (["seeds=[1000,1000]"], "seeds must differ"),
    (["bounds=3"], r"bounds must be two numbers, such as \[-2,2\], got 3"),
    (["bounds=[1,2]"], r"bounds must hold 0, .* got \[1, 2\]"),
    (["most_points=1.5"], "most_points must be a positive whole number, got 1.5"),
]


@pytest.mark.parametrize(("overrides", "message"), REFUSED)
def test_what_is_no_calibration_is_refused(tmp_path, put_in, overrides, message):
    with pytest.raises(ValueError, match=message):
        calibrate(untouched(*overrides), tmp_path / "results")
    assert list(tmp_path.iterdir()) == []

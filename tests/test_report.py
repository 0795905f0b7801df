import json
import re
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from matplotlib.image import imread
from matplotlib.text import Text
from sklearn.metrics import accuracy_score, balanced_accuracy_score, recall_score
from sklearn.metrics import confusion_matrix as oracle_confusion

from tactslip_torch.hand import HandLayout
from tactslip_torch.report import (
    bin_metrics,
    confusion_figure,
    confusion_matrix,
    materials_table,
    pipeline_figure,
    published,
    selected_features_figure,
    selected_table,
    solve_line,
    split_metrics,
    splits_table,
    timing_table,
)
from tactslip_torch.report.metrics import merged_metrics
from tactslip_torch.report.results import PAPER_LINE

SCORE_KEYS = {
    "accuracy",
    "balanced_accuracy",
    "non_slip_recall",
    "slip_recall",
    "confusion",
    "num_bins",
}


def random_bins(seed: int, num_bins: int = 500) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    truth = torch.rand(num_bins, generator=generator) < 0.75
    return truth, truth ^ (torch.rand(num_bins, generator=generator) < 0.1)


def metrics_of(simulated: bool) -> dict[str, Any]:
    splits = {}
    for seed, name in enumerate(["train", "test", "unseen"]):
        truth, predicted = random_bins(seed)
        materials = ["ABS" if i % 2 else "acrylic" for i in range(len(truth))]
        speeds = [(60.0, 20.0, 40.0)[i % 3] for i in range(len(truth))]
        splits[name] = bin_metrics(truth, predicted, materials, speeds)
    return {"simulated": simulated, "splits": splits}


@pytest.fixture
def selected() -> list[dict[str, str]]:
    rows = []
    for number, channel in enumerate(HandLayout.paper24().channels):
        component = "raw" if channel.kind == "SG" else f"{'AD'[number % 2]}{1 + number % 4}"
        row = {"channel": channel.name, "component": component, "domain": "time"}
        row |= {"descriptor": ("kurtosis", "std", "energy")[number % 3]}
        rows.append(row | {"name": str(number), "kind": channel.kind, "finger": channel.finger})
    return rows


# ------------------------------------------------------------------------------------- scores
@pytest.mark.parametrize("seed", range(3))
def test_scores_equal_scikit_learn(seed: int) -> None:
    truth, predicted = random_bins(seed)
    confusion = confusion_matrix(truth, predicted)
    scores = split_metrics(confusion)
    assert confusion == oracle_confusion(truth.numpy(), predicted.numpy()).tolist()
    expected = {
        "accuracy": accuracy_score(truth, predicted),
        "balanced_accuracy": balanced_accuracy_score(truth, predicted),
        "non_slip_recall": recall_score(truth, predicted, pos_label=False),
        "slip_recall": recall_score(truth, predicted, pos_label=True),
    }
    for key, value in expected.items():
        assert scores[key] == pytest.approx(value, abs=1e-14), key
    assert scores["num_bins"] == len(truth)


def test_groups_equal_the_scores_of_their_own_bins_and_add_up() -> None:
    truth, predicted = random_bins(3)
    materials = [("iron", "ABS", "wood")[i % 3] for i in range(len(truth))]
    speeds = [(60.0, 40.0, 20.0, 100.0)[i % 4] for i in range(len(truth))]
    scores = bin_metrics(truth, predicted, materials, speeds)
    assert list(scores["per_material"]) == ["iron", "ABS", "wood"]
    assert list(scores["per_speed"]) == ["20", "40", "60", "100"]
    wood = torch.tensor([material == "wood" for material in materials])
    slow = torch.tensor([speed == 20 for speed in speeds])
    for got, rows in ((scores["per_material"]["wood"], wood), (scores["per_speed"]["20"], slow)):
        assert got == split_metrics(confusion_matrix(truth[rows], predicted[rows]))
    for groups in (scores["per_material"], scores["per_speed"]):
        added = sum(np.array(group["confusion"]) for group in groups.values())
        assert added.tolist() == scores["confusion"]
        assert all(set(group) == SCORE_KEYS for group in groups.values())
    assert set(scores) == SCORE_KEYS | {"per_material", "per_speed"}


def test_of_several_scenes_groups_count_the_papers_bins_alone() -> None:
    truth, predicted = random_bins(7)
    num = len(truth)
    scenes = [("taps", "paper", "grips")[i % 3] for i in range(num)]
    groups = [["a" if i < 200 else "b" for i in range(num)], [20.0 * (i % 4) for i in range(num)]]
    positions = [i % 9 - 4 for i in range(num)]
    scores = bin_metrics(truth, predicted, *groups, scenes, positions)
    rows = [i for i in range(num) if scenes[i] == "paper"]
    labels = [[group[i] for i in rows] for group in groups]
    places = [positions[i] for i in rows]
    expected = bin_metrics(truth[rows], predicted[rows], *labels, None, places)
    for kind in ("per_material", "per_speed", "per_position"):
        assert scores[kind] == expected[kind]
    assert scores["num_bins"] == num
    unlike = ["taps" if scene == "paper" else "grips" for scene in scenes]  # and none the paper's
    none = bin_metrics(truth, predicted, *groups, unlike, positions)
    assert none["per_material"] == none["per_speed"] == none["per_position"] == {}
    for parts in (scenes, unlike):
        by_scene = [
            bin_metrics(
                truth[own],
                predicted[own],
                *([group[i] for i in own] for group in groups),
                [scene] * len(own),
                [positions[i] for i in own],
            )
            for scene in dict.fromkeys(parts)
            for own in [[i for i in range(num) if parts[i] == scene]]
        ]
        assert merged_metrics(by_scene) == bin_metrics(truth, predicted, *groups, parts, positions)
    taps = [i for i in range(num) if scenes[i] == "taps"]  # of one kind, whichever, all count
    labels = [[group[i] for i in taps] for group in groups]
    one = bin_metrics(truth[taps], predicted[taps], *labels, ["taps"] * len(taps))
    assert sum(of["num_bins"] for of in one["per_material"].values()) == len(taps)


def test_recall_by_position_is_the_share_of_right_bins_there(rng: np.random.Generator) -> None:
    num_bins = 4000
    places = rng.integers(-24, 60, num_bins)
    truth = torch.from_numpy(places >= 0)
    predicted = truth ^ torch.from_numpy(rng.random(num_bins) < 0.2)
    of_stroke = rng.random(num_bins) < 0.9
    positions = [int(p) if mine else None for p, mine in zip(places, of_stroke, strict=True)]
    scores = bin_metrics(truth, predicted, ["a"] * num_bins, [0.0] * num_bins, None, positions)
    found = scores["per_position"]
    assert list(found) == ["<-20", *map(str, range(-20, 20)), "20+"]
    at = {"<-20": places < -20, "20+": places >= 20} | {str(p): places == p for p in range(-20, 20)}
    for label, rows in at.items():
        rows = rows & of_stroke
        expected = recall_score(
            truth[rows],
            predicted[rows],
            pos_label=label == "20+" or (label[0] != "<" and int(label) >= 0),
        )
        assert found[label]["recall"] == pytest.approx(expected, abs=1e-14)
        assert found[label]["num_bins"] == rows.sum()
    assert "per_scene" not in scores
    assert json.loads(json.dumps(scores, allow_nan=False)) == scores


def test_merged_scores_equal_those_of_all_bins_together(rng: np.random.Generator) -> None:
    truth, predicted = random_bins(4)
    materials = ["ABS" if i < 200 else "iron" for i in range(len(truth))]  # iron: second part only
    speeds = [(20.0, 40.0)[i % 2] for i in range(len(truth))]
    scenes = ["paper" if i < 300 else "taps" for i in range(len(truth))]
    places = [int(p) if p > -25 else None for p in rng.integers(-30, 30, len(truth))]
    groups = (materials, speeds, scenes, places)
    parts = [
        bin_metrics(truth[rows], predicted[rows], *(group[rows] for group in groups))
        for rows in (slice(0, 150), slice(150, None))
    ]
    assert merged_metrics(parts) == bin_metrics(truth, predicted, *groups)
    plain = [
        bin_metrics(truth[rows], predicted[rows], materials[rows], speeds[rows])
        for rows in (slice(0, 150), slice(150, None))
    ]
    assert merged_metrics(plain) == bin_metrics(truth, predicted, materials, speeds)


@pytest.mark.parametrize("slip", [True, False])
def test_a_class_without_bins_has_no_recall(slip: bool) -> None:
    truth = torch.full((8,), slip)
    predicted = torch.arange(8) < 6
    scores = split_metrics(confusion_matrix(truth, predicted))
    present, absent = ("slip", "non_slip") if slip else ("non_slip", "slip")
    assert scores[f"{absent}_recall"] is None
    assert scores["balanced_accuracy"] is None
    assert scores[f"{present}_recall"] == scores["accuracy"] == (0.75 if slip else 0.25)


def test_no_bins_give_no_scores() -> None:
    nothing = torch.zeros(0, dtype=torch.bool)
    scores = bin_metrics(nothing, nothing, [], [])
    assert scores["confusion"] == [[0, 0], [0, 0]]
    assert [scores[key] for key in ("accuracy", "balanced_accuracy", "num_bins")] == [None, None, 0]


def test_wrong_input_is_named() -> None:
    truth, predicted = random_bins(0, 4)
    with pytest.raises(ValueError, match=r"is_slip_predicted must be \[N\] bool.*float32"):
        confusion_matrix(truth, predicted.float())
    with pytest.raises(ValueError, match="is_slip_true must be"):
        confusion_matrix(truth[None], predicted[None])
    with pytest.raises(ValueError, match="got 4 and 3 bins"):
        confusion_matrix(truth, predicted[:3])
    with pytest.raises(ValueError, match=r"materials must have one entry per bin, 4, got 1"):
        bin_metrics(truth, predicted, ["ABS"], [20.0] * 4)
    with pytest.raises(ValueError, match=r"speeds_mm_s must have one entry per bin, 4, got 5"):
        bin_metrics(truth, predicted, ["ABS"] * 4, [20.0] * 5)
    with pytest.raises(ValueError, match=r"scenes must have one entry per bin, 4, got 3"):
        bin_metrics(truth, predicted, ["ABS"] * 4, [20.0] * 4, ["paper"] * 3)
    with pytest.raises(ValueError, match=r"positions must have one entry per bin, 4, got 0"):
        bin_metrics(truth, predicted, ["ABS"] * 4, [20.0] * 4, positions=[])


# ---------------------------------------------------------------------------------- published
def test_published_numbers_agree_with_each_other() -> None:
    by_finger = published.SELECTED_BY_FINGER
    assert sum(published.SELECTED_BY_KIND.values()) == published.NUM_SELECTED
    for kind, count in published.SELECTED_BY_KIND.items():
        assert sum(by_finger[kind].values()) == count
    assert len({*published.DESCRIPTORS_RANKED, *published.DESCRIPTORS_NEVER}) == 17
    for name in ("test", "unseen"):
        split = published.SPLITS[name]
        assert split.non_slip_recall is not None
        assert split.slip_recall is not None
        mean = (split.non_slip_recall + split.slip_recall) / 2
        assert split.balanced_accuracy == pytest.approx(mean)
        # one share of non-slip bins, 24.66 %, explains accuracy from the recalls
        accuracy = 0.2466 * split.non_slip_recall + 0.7534 * split.slip_recall
        assert split.accuracy == pytest.approx(accuracy, abs=6e-4)


# ------------------------------------------------------------------------------------- tables
def rows_of(table: str) -> list[list[str]]:
    return [re.split(r"\s{2,}", line.strip()) for line in table.splitlines()]


def test_splits_table_has_ours_and_the_papers_numbers() -> None:
    metrics = metrics_of(simulated=True)
    table = splits_table(metrics)
    assert table.startswith("SIMULATED")
    rows = rows_of(table)
    scores = metrics["splits"]["unseen"]
    keys = ("accuracy", "balanced_accuracy", "non_slip_recall", "slip_recall")
    position = [row[0] for row in rows].index("unseen")
    assert rows[position] == ["unseen", *(f"{100 * scores[key]:.2f}" for key in keys), "500"]
    assert rows[position + 1] == ["paper", "91.95", "86.05", "74.40", "97.70", "-"]
    train = [row[0] for row in rows].index("train")
    assert rows[train + 1] == ["paper", "96.59", "-", "-", "-", "-"]
    widths = {len(line) for line in table.splitlines()[1:8]}
    assert len(widths) == 1  # aligned


def test_a_split_unknown_to_the_paper_stands_alone_and_none_is_a_dash() -> None:
    scores = split_metrics([[0, 0], [1, 3]])
    rows = rows_of(splits_table({"simulated": False, "splits": {"validation": scores}}))
    assert rows[1] == ["validation", "75.00", "-", "-", "75.00", "4"]
    assert rows[2][0].startswith("paper:")  # the source line, no row of numbers


def test_materials_table_has_each_material_and_speed_of_each_split() -> None:
    metrics = metrics_of(simulated=True)
    rows = rows_of(materials_table(metrics))[2:]
    assert [row[0] for row in rows[::5]] == ["train", "test", "unseen"]
    groups = [row[-6] for row in rows[:5]]
    assert groups == ["acrylic", "ABS", "20 mm/s", "40 mm/s", "60 mm/s"]
    assert sum(int(row[-1]) for row in rows[:2]) == 500


def test_materials_table_has_scenes_where_there_are_several() -> None:
    truth, predicted = random_bins(6)
    scenes = [("paper", "taps")[i % 2] for i in range(len(truth))]
    for given, expected in ((scenes, ["scene paper", "scene taps"]), (["paper"] * len(truth), [])):
        scores = bin_metrics(truth, predicted, ["a"] * len(truth), [20.0] * len(truth), given)
        table = materials_table({"simulated": False, "splits": {"test": scores}})
        line = "of several scenes: materials and speeds are of the paper's scene alone"
        assert (table.splitlines()[0] == line) == bool(expected)
        assert [row[-6] for row in rows_of(table)[1 + bool(expected) :]] == [
            "a",
            "20 mm/s",
            *expected,
        ]


def test_timing_table_takes_a_given_total() -> None:
    rows = rows_of(timing_table({"total": 50.0, "features": 20.0}))
    assert rows[1:] == [["features", "20.00", "40.00"], ["total", "50.00", "100.00"]]
    assert rows_of(timing_table({}))[1:] == [["total", "0.00", "-"]]


def test_solve_line_says_how_far_rounding_may_reach() -> None:
    facts = {"method": "eigen", "rank": 7, "size": 9, "condition": "inf", "error": 2.2e-16}
    line = "solved by eigen: 7 of 9 unknowns, condition inf, relative error of the weights about"
    assert solve_line(facts) == f"{line} 2e-16"
    facts |= {"left_out": 0.01, "error": 0.01}
    assert solve_line(facts) == f"{line} 1e-02, unless what is left out is null"


def test_selected_table_counts_every_key(selected: list[dict[str, str]]) -> None:
    rows = rows_of(selected_table(selected))
    assert ["kind", "SG", "14", "6"] in rows
    assert ["PVDF", "10", "114"] in rows
    assert ["index", "5", "48"] in rows
    assert ["middle", "5", "21"] in rows
    assert ["domain", "time", "24", "-"] in rows
    assert ["D1", "0", "0"] in rows
    assert ["peak_factor", "0", "#1"] in rows
    assert ["mode", "0", "0"] in rows
    count = Counter(row["descriptor"] for row in selected)["energy"]
    assert ["energy", str(count), "0"] in rows
    assert rows[-2] == ["all", "24", "120"]


# ------------------------------------------------------------------------------------ figures
def assert_drawn_atomically(path: Path) -> None:
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]  # nothing left behind
    pixels = imread(path)
    assert min(pixels.shape[:2]) > 300
    assert 0.02 < (pixels[..., :3].min(axis=-1) < 0.9).mean() < 0.9  # neither blank nor black
    for edge in (pixels[0], pixels[-1], pixels[:, 0], pixels[:, -1]):
        assert edge.min() == 1.0  # nothing is cut off at the border


@pytest.mark.parametrize("simulated", [True, False])
def test_confusion_figure(tmp_path: Path, simulated: bool) -> None:
    path = tmp_path / "confusion.png"
    path.write_bytes(b"an older figure")
    confusion_figure(metrics_of(simulated), path)
    assert_drawn_atomically(path)


@pytest.mark.parametrize(
    ("scenes", "is_papers"), [(("paper",), True), (("taps",), False), (("paper", "taps"), False)]
)
def test_the_papers_numbers_stand_beside_its_own_scenes_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, scenes: tuple[str, ...], is_papers: bool
) -> None:
    truth, predicted = random_bins(9)
    kinds = [scenes[i % len(scenes)] for i in range(len(truth))]
    scores = bin_metrics(truth, predicted, ["a"] * len(truth), [20.0] * len(truth), kinds)
    metrics = {"simulated": True, "splits": {"test": scores}}
    drawn = []

    def keep(figure: Any, target: Path, **_: object) -> None:
        drawn.append(figure)
        target.write_bytes(b"drawn")

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", keep)
    confusion_figure(metrics, tmp_path / "confusion.png")
    (panel,) = drawn[0].axes
    assert ("paper: non-slip 93.8" in panel.get_xlabel()) == is_papers
    assert any(row[0] == "paper" for row in rows_of(splits_table(metrics))) == is_papers
    elsewhere = metrics | {"is_papers_hand": False}
    confusion_figure(elsewhere, tmp_path / "confusion.png")
    assert drawn[1].axes[0].get_xlabel() == "prediction\n\n"
    assert PAPER_LINE in splits_table(metrics)
    assert PAPER_LINE not in splits_table(elsewhere)


def test_confusion_figure_with_many_splits_and_an_absent_class(tmp_path: Path) -> None:
    splits = {f"fold {i}": split_metrics([[0, 0], [i, 5]]) for i in range(5)}
    confusion_figure({"simulated": True, "splits": splits}, str(tmp_path / "confusion.png"))
    assert_drawn_atomically(tmp_path / "confusion.png")


def test_selected_features_figure(tmp_path: Path, selected: list[dict[str, str]]) -> None:
    selected_features_figure(selected, tmp_path / "selected.png", simulated=True)
    assert_drawn_atomically(tmp_path / "selected.png")


@pytest.mark.parametrize("kinds", [("SG",), ("electrode",), ("IMU", "SG"), tuple("abcdefghi")])
def test_selected_features_of_another_hand_stand_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kinds: tuple[str, ...]
) -> None:
    row = {"channel": "X1", "component": "D6", "domain": "freq", "descriptor": "mean"}
    rows = [row | {"name": "X1", "kind": kind, "finger": "palm"} for kind in kinds]
    selected_features_figure(rows, tmp_path / "selected.png", simulated=False)
    assert_drawn_atomically(tmp_path / "selected.png")
    drawn = []
    monkeypatch.setattr(
        "matplotlib.figure.Figure.savefig",
        lambda figure, target, **_: drawn.append(figure) or Path(target).touch(),
    )
    selected_features_figure(rows, tmp_path / "again.png", simulated=False)
    bars = drawn[0].axes[0]
    heights = {layer.get_label(): sum(b.get_height() for b in layer) for layer in bars.containers}
    assert {kind: heights[kind] for kind in kinds} == dict.fromkeys(kinds, 1)
    words = [text.get_text() for axes in drawn[0].axes for text in axes.findobj(Text)]
    assert not any("paper" in word or "[" in word for word in words)
    assert "paper" not in selected_table(rows)
    assert {row[0] for row in rows_of(selected_table(rows))} >= {"kind", "all"}


def test_pipeline_figure(tmp_path: Path) -> None:
    pipeline_figure(tmp_path / "pipeline.png")
    assert_drawn_atomically(tmp_path / "pipeline.png")


def test_nothing_to_draw_is_an_error_and_leaves_no_file(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no split"):
        confusion_figure({"simulated": True, "splits": {}}, tmp_path / "confusion.png")
    with pytest.raises(ValueError, match="no selected feature"):
        selected_features_figure([], tmp_path / "selected.png", simulated=True)
    assert not list(tmp_path.iterdir())


def test_a_failed_write_keeps_the_older_figure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "pipeline.png"
    path.write_bytes(b"an older figure")

    def full_disk(self: object, target: Path, **_: object) -> None:
        target.write_bytes(b"half")
        raise OSError("no space left on device")

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", full_disk)
    with pytest.raises(OSError, match="no space left"):
        pipeline_figure(path)
    assert path.read_bytes() == b"an older figure"
    assert list(tmp_path.iterdir()) == [path]

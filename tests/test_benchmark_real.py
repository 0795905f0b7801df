import json
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.peers import rockets
from benchmarks.real import __main__ as bench
from benchmarks.real import bootstrap, inner, measure, method, report, rivals, rocket, scores
from benchmarks.real.figure import figure
from benchmarks.real.ours import ours, pool_rows
from benchmarks.real.page import page
from benchmarks.real.ridge import ridge_scores
from benchmarks.real.sizes import QUICK, Sizes
from benchmarks.real.tried import tried
from benchmarks.real.windows import Windows, composed, read_windows, recipe_of
from tactslip_torch.train import train

OBJECTS, SCENES, CHANNELS = ("bottle", "brush", "pen"), ("n", "cw", "t"), 3


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A set of the layout of the real one: slip is a vibration, stable touch is not."""
    root, generator = tmp_path_factory.mktemp("set"), np.random.default_rng(5)
    header = ",".join(f"ff_e{place + 1}" for place in range(CHANNELS))
    for scene in SCENES:
        folder = root / "csvs" / scene
        folder.mkdir(parents=True)
        for number, name in enumerate(OBJECTS * 2):
            times = np.arange(50 + 64 + 32)
            counts = 2500 + 40 * generator.random((len(times), CHANNELS)) + 100 * number
            if scene != "t":
                pitch = {"n": 0.9, "cw": 1.4}[scene]
                counts[50:] += 60 * np.sin(pitch * times[50:, None] + np.arange(CHANNELS))
            rows = "\n".join(",".join(map(str, row)) for row in counts.round().astype(int))
            (folder / f"{name}{number}.csv").write_text(f"{header}\n{rows}\n")
    return root


@pytest.fixture(scope="module")
def read(root: Path) -> tuple[Windows, Any]:
    return read_windows(composed([f"data.root={root}"], "robust"), Sizes())


# ----------------------------------------------------------------------------------------- windows
def test_windows_are_tared_and_labelled_by_the_folder(read: tuple[Windows, Any]) -> None:
    windows, folds = read
    assert windows.samples.shape == (18 * 2, CHANNELS, 64)
    assert (windows.is_slip == (windows.scenes != "t")).all()
    assert set(windows.objects) == set(OBJECTS)
    assert [len(fold.having("unseen")) for fold in folds] == [6, 6, 6]
    still = windows.samples[~windows.is_slip]  # 2500 and more, were they not tared
    assert np.abs(still).max() < 60


def test_a_few_recordings_of_each_object_and_scene(root: Path) -> None:
    sizes = replace(QUICK, objects=2, each=1)
    windows, folds = read_windows(composed([f"data.root={root}"], "robust"), sizes)
    assert len(windows.recordings) == 2 * len(SCENES)
    assert len(folds) == 2


def test_no_fold_shows_a_method_what_it_leaves_out(read: tuple[Windows, Any]) -> None:
    windows, folds = read
    seen: list[method.Training] = []

    def fit(training: method.Training) -> method.Fitted:
        seen.append(training)
        number = float(len(seen))
        return method.Fitted(lambda rows: np.full(len(rows), number), lambda _: np.zeros(0), {})

    spy = method.Method("spy", np.arange(len(windows.is_slip)), 0.5, fit)
    found = measure.on_folds(windows, folds, [spy])["spy"]
    for number, (fold, training) in enumerate(zip(folds, seen, strict=True), 1):
        held = windows.of(fold.having("unseen"))
        left_out = set(windows.objects[held].tolist())
        assert len(left_out) == 1
        assert left_out.isdisjoint(training.objects.tolist())
        assert training.rows.tolist() == np.flatnonzero(~held).tolist()
        assert (training.is_slip == windows.is_slip[~held]).all()
        assert (found.scores[held] == number).all()
    assert min(found.fit_s) >= 24 * 0.5  # describing training windows is part of a fit
    with pytest.raises(ValueError, match="left out by one fold"):
        measure.on_folds(windows, folds[:2], [spy])


def test_ours_decides_as_train_does(root: Path, read: tuple[Windows, Any], tmp_path: Path) -> None:
    windows, folds = read
    small = ["recipe.num_features=[5,9]", f"data.root={root}"]
    ways = ["num_workers=0", "export=false", "cache=off"]
    train(composed([*small, *ways], "paper"), tmp_path)
    told = json.loads((tmp_path / "metrics.json").read_text())["folds"]
    mine = ours(windows, recipe_of(small, "paper"), *pool_rows(windows))
    found = measure.on_folds(windows, folds, [mine])[mine.name]
    for fold, chosen in zip(folds, found.chosen, strict=True):
        held = windows.of(fold.having("unseen"))
        value = scores.balanced(found.scores[held], windows.is_slip[held])
        assert told[fold.name]["splits"]["unseen"]["balanced_accuracy"] == pytest.approx(value)
        assert told[fold.name]["penalty"] == chosen["C"]
        assert len(told[fold.name]["selected"]) == chosen["features"]
    assert found.last is not None
    judged = found.last.judge(windows.samples[held])
    np.testing.assert_allclose(judged, found.scores[held], rtol=1e-4, atol=1e-5)


# ------------------------------------------------------------------------------------------ scores
@pytest.mark.parametrize("seed", range(4))
def test_scores_are_those_of_scikit_learn(seed: int) -> None:
    metrics = pytest.importorskip("sklearn.metrics")
    generator = np.random.default_rng(seed)
    is_slip = generator.random(60) < 0.7
    found = (generator.normal(size=60) + is_slip).round(1)  # with equals
    weights = generator.integers(0, 4, 60).astype(float)
    for of in (None, weights):
        wanted = metrics.roc_auc_score(is_slip, found, sample_weight=of)
        assert scores.auc(found, is_slip, of) == pytest.approx(wanted, abs=1e-12)
        wanted = metrics.balanced_accuracy_score(is_slip, found >= 0, sample_weight=of)
        assert scores.balanced(found, is_slip, of) == pytest.approx(wanted, abs=1e-12)
    grid, curve = scores.curve(found, is_slip)
    false, true, _ = metrics.roc_curve(is_slip, found, drop_intermediate=False)
    highest = {x: max(true[false == x]) for x in false.tolist()}
    wanted = np.interp(grid, list(highest), list(highest.values()))
    np.testing.assert_allclose(curve, wanted, atol=1e-6)


def test_the_worst_object_and_every_direction_are_told() -> None:
    is_slip = np.array([True, False, True, False])
    objects, scenes = np.array(["a", "a", "b", "b"]), np.array(["n", "t", "cw", "t"])
    found = scores.judged(np.array([1.0, -1.0, 0.0, 2.0]), is_slip, objects, scenes)
    assert found["objects"] == {"a": 1.0, "b": 0.5}
    assert found["worst"] == {"object": "b", "balanced_accuracy": 0.5}
    assert found["scenes"] == {"n": 1.0, "cw": 1.0, "t": 0.5}
    assert (found["sensitivity"], found["specificity"]) == (1.0, 0.5)


def test_the_bootstrap_draws_recordings_within_their_class() -> None:
    generator = np.random.default_rng(1)
    recording = np.repeat(np.arange(12), generator.integers(2, 5, 12))
    is_slip = recording % 3 > 0
    table = {name: generator.normal(size=len(recording)) + is_slip for name in ("ours", "other")}
    found = bootstrap.differences(table, "ours", is_slip, recording, 40, seed=3)
    again = np.random.default_rng(3)
    gaps = []
    for _ in range(40):
        slip = [n for n in range(12) if n % 3 > 0]
        still = [n for n in range(12) if n % 3 == 0]
        drawn = [*again.choice(still, len(still)), *again.choice(slip, len(slip))]
        places = np.concatenate([np.flatnonzero(recording == n) for n in drawn])
        a, b = (scores.balanced(table[n][places], is_slip[places]) for n in ("ours", "other"))
        gaps.append(a - b)
    told = found["other"]["balanced_accuracy"]
    assert (told["low"], told["high"]) == pytest.approx(np.quantile(gaps, [0.025, 0.975]).tolist())
    assert told["share"] == pytest.approx(np.mean(np.array(gaps) > 0))
    whole = [scores.auc(table[name], is_slip) for name in ("ours", "other")]
    assert found["other"]["auc"]["value"] == pytest.approx(whole[0] - whole[1])
    same = bootstrap.differences(table | {"other": table["ours"]}, "ours", is_slip, recording, 5)
    assert {same["other"]["auc"][key] for key in ("value", "low", "high")} == {0.0}


# ------------------------------------------------------------------------------------------ rivals
def test_the_best_choice_is_by_objects_that_were_left_out() -> None:
    is_slip = np.tile([True, False], 6)
    objects = np.repeat(["a", "b", "c"], 4)
    parts: list[tuple[set[str], set[str]]] = []

    def trial(fitted: Any, held: Any) -> Sequence[Any]:
        parts.append((set(objects[fitted].tolist()), set(objects[held].tolist())))
        truth = np.where(is_slip[held], 1.0, -1.0)
        return [np.ones(held.sum()), truth, truth]

    assert inner.best_choice(trial, is_slip, objects, 5) == (1, 1.0)
    assert parts == [({"b", "c"}, {"a"}), ({"a", "c"}, {"b"}), ({"a", "b"}, {"c"})]


def test_simple_statistics_of_a_ramp() -> None:
    ramp = np.arange(5.0)[None, None] * np.array([2.0, -2.0])[None, :, None]
    spread = np.sqrt(8.0)
    wanted = [4, -4, spread, spread, 8, 8, 0, 0, 2, 2]
    np.testing.assert_allclose(rivals.statistics(ramp), [wanted])
    logs = rivals.with_logs(np.array([[-3.0, 0.0]]))
    np.testing.assert_allclose(logs, [[-3.0, 0.0, -np.log(4.0), 0.0]])


def test_the_rockets_in_the_middle_stand_beside_ours() -> None:
    is_slip = np.arange(20) < 10
    truth = np.where(is_slip, 1.0, -1.0)
    found = {}
    wrong_by_way = {
        rocket.BY_WINDOWS: (4, 0, 2),
        rocket.BY_OBJECTS: (1, 3, 5),
        rocket.HYDRA_BY_OBJECTS: (0, 1, 2),
    }
    for way, wrongs in wrong_by_way.items():
        for seed, wrong in enumerate(wrongs):
            of = truth.copy()
            of[:wrong] = -1.0
            name = f"{way}, seed {seed}"
            spy = method.Method(name, of, 0.0, partial(pytest.fail, "is not fitted"))
            found[name] = measure.Found(spy, of)
    seeds = zip(wrong_by_way, (2, 1, 1), strict=True)
    wanted = tuple(f"{way}, seed {seed}" for way, seed in seeds)
    assert measure.middle_rockets(found, is_slip) == wanted


@pytest.mark.parametrize("width", [3, 40])  # fewer and more features than windows
def test_ridge_is_that_of_scikit_learn(width: int) -> None:
    linear = pytest.importorskip("sklearn.linear_model")
    scaling = pytest.importorskip("sklearn.preprocessing")
    generator = np.random.default_rng(width)
    rows, others = 5 + 3 * generator.normal(size=(2, 30, width))
    rows[:, 1] = 7.0  # constant
    is_slip = rows[:, 0] + generator.normal(size=30) < 8
    alphas = np.array([0.001, 1.0, 1e5])
    found = ridge_scores(rows, is_slip, others, alphas)
    scaler = scaling.StandardScaler().fit(rows)
    for scores_of, alpha in zip(found, alphas, strict=True):
        made = linear.RidgeClassifier(alpha, class_weight="balanced", solver="svd")
        made.fit(scaler.transform(rows), is_slip)
        wanted = made.decision_function(scaler.transform(others))
        np.testing.assert_allclose(scores_of, wanted, atol=1e-9)


def test_ridge_of_inner_products_is_that_of_scikit_learn() -> None:
    linear = pytest.importorskip("sklearn.linear_model")
    generator = np.random.default_rng(2)
    rows, others = 2 + generator.normal(size=(2, 30, 70))
    is_slip = rows[:, 0] > 1.5
    alphas = np.array([0.001, 1.0, 1e5])
    found = rockets.ridge_scores_of_products(rows @ rows.T, others @ rows.T, is_slip, alphas)
    for scores_of, alpha in zip(found, alphas, strict=True):
        made = linear.RidgeClassifier(alpha, class_weight="balanced", solver="svd")
        wanted = made.fit(rows, is_slip).decision_function(others)
        np.testing.assert_allclose(scores_of, wanted, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", [rockets.MINI_ROCKET, rockets.MULTI_ROCKET_HYDRA])
def test_windows_are_told_by_rockets(name: str) -> None:
    pytest.importorskip("aeon")
    generator = np.random.default_rng(0)
    windows = generator.normal(size=(60, 3, 64))
    is_slip, groups = np.arange(60) % 2 == 0, np.arange(60) // 20
    windows[is_slip] = np.cumsum(windows[is_slip], axis=-1)
    known = slice(0, 40)
    made = rockets.fit(windows[known], is_slip[known], groups[known], name=name, num_kernels=168)
    assert made.alpha in rockets.ALPHAS
    assert ((made.score(windows[40:]) >= 0) == is_slip[40:]).mean() > 0.9


@pytest.mark.parametrize("is_scaled", [False, True])
def test_a_penalty_by_objects_is_right_on_objects_that_were_left_out(is_scaled: bool) -> None:
    linear = pytest.importorskip("sklearn.linear_model")
    generator = np.random.default_rng(0)
    objects = np.repeat(list("abcd"), 20)
    rows = generator.normal(size=(80, 60)).astype(np.float32)
    is_slip = rows[:, 0] + generator.normal(size=80) > 0
    values = []
    for alpha in rockets.ALPHAS:
        of = np.empty(80)
        for name in "abcd":
            out = objects == name
            made = rockets.scaled(linear.RidgeClassifier(alpha, class_weight="balanced"), is_scaled)
            of[out] = made.fit(rows[~out], is_slip[~out]).decision_function(rows[out])
        values.append(scores.balanced(of, is_slip))
    made, alpha = rockets.ridge_by_groups(rows, is_slip, objects, is_scaled)
    assert alpha == rockets.ALPHAS[np.argmax(values)]
    assert len(set(values)) > 2  # there was something to choose
    wanted = rockets.scaled(linear.RidgeClassifier(alpha, class_weight="balanced"), is_scaled)
    wanted = wanted.fit(rows, is_slip).decision_function(rows)
    np.testing.assert_array_equal(made.decision_function(rows), wanted)


# ------------------------------------------------------------------------------------- the command
@pytest.fixture(scope="module")
def kept(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a quick run of everything."""
    for library in ("aeon", "tsfel", "sklearn"):
        pytest.importorskip(library)
    folder = tmp_path_factory.mktemp("kept")
    assert bench.main([f"data.root={root}", "--quick", "--runs", str(folder)]) == 0
    return folder


def test_a_run_judges_every_method_on_the_same_windows(kept: Path, root: Path) -> None:
    made = json.loads((kept / "real.json").read_text())
    rows = made["sections"]["methods"]
    assert list(rows) == [
        "ours, recipe=robust",
        "ours, recipe=paper",
        "MiniRocket, ridge by windows, seed 0",
        "MiniRocket, ridge by windows, seed 1",
        "MiniRocket, ridge by objects, seed 0",
        "MiniRocket, ridge by objects, seed 1",
        "MultiRocketHydra, ridge by objects, seed 0",
        "MultiRocketHydra, ridge by objects, seed 1",
        "TSFEL, random forest",
        "our pool, RBF SVC",
        "simple statistics, logistic regression",
    ]
    for row in rows.values():
        assert set(row["objects"]) == set(OBJECTS)
        assert len(row["chosen"]) == 3
        assert row["fit_s"] > 0
        assert row["balanced_accuracy"] > 0.8  # a vibration is easily told from none
    timed = {name: row["time"] for name, row in rows.items() if row["time"]}
    assert len(timed) == 8
    assert set(made["sections"]["differences"]) == set(timed) - {"ours, recipe=robust"}
    for time in timed.values():  # what is timed is what is judged
        assert time["differs"] < 1e-3
        assert min(time["batched_s"], time["alone_s"]) > 0
    assert timed[made["rockets"][0]]["alone_times_faster"]["median"] == 1.0
    with np.load(kept / "scores.npz") as table:
        assert table["scores"].shape == (11, made["data"]["windows"]["all"])
    assert str(root) not in json.dumps(made)  # no path of a machine in what is kept


def test_whole_recordings_of_slip_raise_alarms_and_no_others(kept: Path) -> None:
    found = json.loads((kept / "real.json").read_text())["sections"]["watched"]
    touch = found["by_scene"].pop("t")
    assert touch["recordings"] > 0
    assert touch["with_alarm"] == 0  # a vibration is easily told from none
    for of in found["by_scene"].values():
        assert of["with_alarm"] == of["recordings"] > 0
    assert (kept / "real_watched.png").stat().st_size > 10_000
    onsets = json.loads((kept / "watched" / "onsets.json").read_text())
    assert onsets["recordings"][0]["file"] == Path(found["shown"]).name


def test_an_interrupted_run_finds_its_rows_again(
    kept: Path, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from benchmarks.real import tsfel_rows

    windows, _ = read_windows(composed([f"data.root={root}"], "robust"), QUICK)
    calls: list[int] = []

    def counting(_: float) -> Any:
        return lambda window: calls.append(1) or np.array([window.mean(), np.nan, np.inf])

    monkeypatch.setattr(tsfel_rows, "tsfel_features", counting)
    tsfel_rows.tsfel_rows(windows, kept / "tsfel")
    assert not calls
    other = kept / "other"
    found, seconds = tsfel_rows.tsfel_rows(windows, other)
    assert len(calls) == len(windows.samples)
    assert np.isfinite(found).all()
    next(other.iterdir()).unlink()
    again, _ = tsfel_rows.tsfel_rows(windows, other)
    assert len(calls) == len(windows.samples) + 2  # one recording was lost
    np.testing.assert_array_equal(again, found)
    assert seconds > 0


def test_the_page_is_written_anew_from_what_is_kept(kept: Path, tmp_path: Path) -> None:
    paths = {"--json": kept / "real.json", "--figure": tmp_path / "r.png", "--page": tmp_path / "p"}
    given = [str(part) for pair in paths.items() for part in pair]
    assert bench.main(["--report", *given]) == 0
    text, before = (tmp_path / "p").read_text(), (kept / "REAL_DATA.md").read_text()
    assert text.replace("(r.png", "(real.png").replace("(r_watched", "(real_watched") == before
    assert (tmp_path / "r.png").stat().st_size > 30_000
    for word in ("Sensors 19(3):523", "states no licence", "development data", "QUICK", "95.50"):
        assert word in text.replace("**", "")
    first = text.split("\n\n")[1]
    assert "What was tried before" in first  # not of this run
    assert "earlier run" in first
    assert f"{len(tried())} variants" in text


def test_limits_say_by_how_much(kept: Path, tmp_path: Path) -> None:
    made = json.loads((kept / "real.json").read_text())
    rows = made["sections"]["methods"]
    name, middle = made["ours"], made["rockets"]
    rows[name] |= {"balanced_accuracy": 0.9488, "auc": 0.9862}
    for rocket_name, value in zip(middle, (0.92, 0.951, 0.94), strict=True):
        rows[rocket_name]["balanced_accuracy"] = value
    for how, ratio in (("batched", 12.0), ("alone", 4.0)):
        rows[name]["time"][f"{how}_times_faster"]["median"] = ratio
    made["limits"] = report.limit_rows(rows, name, middle)
    assert [row["ok"] for row in made["limits"]] == [True, False, True, False, True, True, False]
    assert made["limits"][0]["measured"] == "94.88 %, +2.88 points"
    assert made["limits"][1]["measured"] == "94.88 %, -0.22 points"
    assert made["limits"][1]["what"] == f"balanced accuracy above that of {middle[1]}"
    assert made["limits"][3]["measured"] == "94.88 %, -0.12 points"
    text = page(made, tmp_path / "f.png", tmp_path / "p.md")
    assert "4 of 7 limits are met" in text
    higher = text.split("of all methods and seeds: ")[1].split(".\n")[0].split("; ")
    assert middle[1] in higher
    assert not {name, middle[0]} & set(higher)
    gap = {"value": 0.01, "low": -0.01, "high": 0.03, "share": 0.9}
    gaps = {"sure": gap | {"low": 0.001}, "unsure": gap}
    made["sections"]["differences"] = {
        n: {"balanced_accuracy": g, "auc": g} for n, g in gaps.items()
    }
    assert "nothing is settled, beside:** unsure." in page(made, tmp_path / "f.png", tmp_path / "p")
    figure(made, tmp_path / "f.png")
    assert (tmp_path / "f.png").stat().st_size > 30_000


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["data.root=nowhere"], "no folder at nowhere"),
        (["split=seen7"], "unknown split seen7"),
        (["nosuch=3"], "Could not override 'nosuch'"),
        ([], "data.root"),
    ],
)
def test_bad_input_is_one_line(
    overrides: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stopped:
        bench.main([*overrides, "--quick", "--runs", str(tmp_path)])
    assert stopped.value.code == 2
    assert said in capsys.readouterr().err.strip().splitlines()[-1]


def test_without_stable_touch_there_is_nothing_to_tell(root: Path) -> None:
    pattern = "data.pattern='csvs/(?P<scene>n|cw)/(?P<material>[a-z]+)(?P<trial>[0-9]+).csv'"
    with pytest.raises(ValueError, match="no window of stable touch"):
        read_windows(composed([f"data.root={root}", pattern], "robust"), Sizes())

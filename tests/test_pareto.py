"""``pareto`` as a command: what it writes, what it promises, and what it says when it cannot."""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from test_commands import TinyRecordings, composed

import tactslip_torch.commands.pareto as command
from tactslip_torch import SlipDetector
from tactslip_torch.analysis.latency import Latency, Limits, Timing
from tactslip_torch.analysis.pareto import Candidate, Search, Timed, Workshop, distinct
from tactslip_torch.data.labels import LabelRule
from tactslip_torch.data.splits import seen6, unseen4
from tactslip_torch.features.groups import allowed
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.model.fit import TrainingBins, fit_machine
from tactslip_torch.model.kernels import Polynomial
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.report.pareto import none_meets, pareto_table
from tactslip_torch.signals.binning import bins_at
from tactslip_torch.signals.filtering import ChannelFilter
from tactslip_torch.training.datamodule import FeatureMaker
from tactslip_torch.training.recipe import FREE_CONSTANT, FeatureSelection, scaled_selection
from tactslip_torch.training.selection import Structure, fitted_selection

TINY = (
    "data._target_=test_commands.TinyRecordings",
    "data.materials=[A,B,C]",
    "data.cycles=4",
    "split.seen=[A,B]",
    "split.unseen=[C]",
    "split.train_share=0.5",
    "search=quick",
    "search.sizes=[4,8]",
    "search.rankings=[t]",
    "search.arithmetics=[double]",
    "search.calls=10",
    "search.most_timed=3",
    "features.backend=auto",
    "retime_calls=20",
    "num_workers=0",
)
EASY = ("deadline_ms=500", "compute_us=400000")  # a busy machine keeps these too


def run(folder, *overrides):
    return command.pareto(composed(*TINY, *overrides, name="pareto"), folder)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pareto")
    return folder, run(folder, *EASY)


# What it leaves ----------------------------------------------------------------------------------


def test_the_files_and_the_parts_of_the_promise(written):
    folder, found = written
    assert json.loads((folder / "pareto.json").read_text()) == found
    names = {"pareto.json", "pareto.png", "detector.pt", "config.yaml"}
    assert found["validation"] in pareto_table(found)
    assert "ranking and scaling saw the material left out" in found["validation"]
    assert {row["columns"] for row in found["front"]} <= {"channel", "pooled mean, std"}
    assert {path.name for path in folder.iterdir()} == names
    assert (folder / "pareto.png").read_bytes().startswith(b"\x89PNG")
    assert found["simulated"] is False
    for row in [found["chosen"], *found["front"]]:
        latency = row["latency"]
        parts = [latency[name] for name in ("look_ahead_ms", "bin_ms", "hop_ms")]
        assert latency["worst_ms"] == pytest.approx(sum(parts) + latency["compute_us"] / 1000)
        assert latency["bin_ms"] == 50
        assert latency["compute_us"] == row["p99_us"]
        gauges = any(name.startswith("SG") for name in row["channels_read"])
        waits = 0.0 if row["align"] == "causal" else 12.5 if gauges else 2.5
        assert latency["look_ahead_ms"] == waits
        assert len(row["selected"]) == row["num_features"]
    chosen = found["chosen"]
    assert chosen["latency"]["worst_ms"] <= 500
    assert chosen["latency"]["hop_ms"] == 50  # the longest that keeps the deadline
    assert chosen["validation"] == max(row["validation"] for row in found["front"])
    assert chosen["fitted_to"] == "all training bins"


def test_nothing_on_the_front_beats_another(written):
    _, found = written
    points = [(r["latency"]["worst_ms"], r["p99_us"], -r["validation"]) for r in found["front"]]
    for own in points:
        for other in points:
            assert own == other or any(a > b for a, b in zip(other, own, strict=True))
    assert found["searched"] == len(found["modelled"]) >= found["timed"] >= len(points)


def test_the_detector_is_the_one_described_and_its_test_score_its_own(written):
    folder, found = written
    chosen, detector = found["chosen"], SlipDetector.load(folder / "detector.pt")
    assert [str(name) for name in detector.selected_names] == chosen["selected"]
    assert detector.channel_filter.align == chosen["align"]
    assert detector.info["train_materials"] == ["A", "B"]
    source = TinyRecordings(seed=0, cycles=4, materials=["A", "B", "C"])
    fold = unseen4(source.ids, seen=["A", "B"], unseen=["C"], train_share=0.5)[0]
    maker = FeatureMaker(source, detector.pool, detector.channel_filter, LabelRule())
    truth, says = [], []
    for recording in fold.having("test"):
        bins = maker.lay_bins(source.timeline(recording))
        filtered = detector.channel_filter(source.load(recording).samples.double())
        score = detector.predict(bins_at(filtered, bins.starts, 100).float()).score
        truth += bins.is_slip.tolist()
        says += (score >= 0).tolist()
    truth, says = np.array(truth), np.array(says)
    recalls = [np.mean(says[truth == label] == label) for label in (False, True)]
    assert chosen["test"]["num_bins"] == len(truth)
    assert chosen["test"]["balanced_accuracy"] == pytest.approx(np.mean(recalls), abs=0.01)


def test_the_table_says_what_the_files_do(written, capsys):
    _, found = written
    table = pareto_table(found)
    rows = [line.split() for line in table.splitlines()]
    for row in found["front"]:
        cells = f"{row['latency']['worst_ms']:.2f}"
        assert any(cells in line for line in rows)
    assert "SIMULATED" not in table
    best = found["named"]["most_accurate"]
    assert best["validation"] == max(row["validation"] for row in found["front"])
    assert f"A most accurate: {100 * best['validation']:.2f} %" in table
    assert found["named"]["few"]["num_features"] <= 20
    without = pareto_table(found | {"named": found["named"] | {"cheap": None}})
    assert "B at most 1 point worse, at most 1/3 of its compute: none of those timed" in without
    assert found["definition"] in table
    assert "look-ahead" in table
    assert f"{100 * found['chosen']['test']['balanced_accuracy']:.2f} %" in table
    assert "SIMULATED" in pareto_table(found | {"simulated": True})
    assert f"backend {found['backend']}; p50" in table
    assert f"{found['tried']} tried there, {found['not_tried']} not tried" in table
    chosen = found["chosen"]
    assert f"p99 of all calls {chosen['p99_all_us']:.0f} us" in table
    for share, is_busy in ((0.05, False), (0.0612, True)):
        busy = pareto_table(found | {"chosen": chosen | {"interrupted": share}})
        said = f"machine busy: {100 * share:.1f} % of calls interrupted"
        assert (said in busy.splitlines()[-2]) == is_busy


# Limits ------------------------------------------------------------------------------------------


def fails(monkeypatch, capsys, tmp_path, *arguments):
    """Exit status and the last line that the command leaves on standard error."""
    monkeypatch.setattr(sys, "argv", ["pareto", *TINY, f"hydra.run.dir={tmp_path}", *arguments])
    with pytest.raises(SystemExit) as stopped:
        command.main()
    return stopped.value.code, capsys.readouterr().err.strip().splitlines()[-1]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["deadline_ms=55"], "deadline_ms=55 cannot be met: bin 50 ms, shortest hop 5 ms"),
        (
            ["search.aligns=[centred]", "deadline_ms=57.5"],
            "least look-ahead 2.5 ms are 57.5 ms before any compute; give more, or a shorter",
        ),
        (["compute_us=0"], "compute_us must be a positive finite number, got 0"),
        (["deadline_ms=soon"], "deadline_ms must be a positive finite number, got 'soon'"),
        (["deadline_ms=null"], "deadline_ms must be a positive finite number, got None"),
        (["deadline_ms=inf"], "deadline_ms must be a positive finite number, got inf"),
        (["headroom=abc"], "headroom must be a finite number of at least 1, got 'abc'"),
        (["tries=0"], "tries must be a positive whole number, got 0"),
        (["retime_calls=0"], "retime_calls must be a positive whole number, got 0"),
        (["search.hops_ms=[5.3]"], "search.hops_ms: 5.3 ms are 10.6 samples at 2000 Hz"),
        (["split=leave_one_material_out"], "split has 10 folds"),
        (["headroom=0.5"], "headroom must be a finite number of at least 1, got 0.5"),
        (["search.sizes=[5000]"], "an empty selection: no group of this hand"),
    ],
)
def test_bad_input_is_one_line(monkeypatch, capsys, tmp_path, arguments, message):
    if "split=leave_one_material_out" in arguments:
        monkeypatch.setattr("test_pareto.TINY", tuple(o for o in TINY if "split." not in o))
        materials = "M1,M2,M3,M4,M5,M6,iron,cloth,copper,wood"
        arguments = [arguments[0], f"data.materials=[{materials}]"]

    def never(*args):
        raise AssertionError("worked before it refused")

    monkeypatch.setattr(Workshop, "look", never)
    status, line = fails(monkeypatch, capsys, tmp_path, *arguments)
    assert status == 2
    assert line.startswith("error: ")
    assert message in line
    assert not (tmp_path / "pareto.json").exists()


def test_none_that_meets_the_limits_is_said_plainly(monkeypatch, capsys, tmp_path):
    (tmp_path / "detector.pt").write_text("of an earlier run")
    status, line = fails(monkeypatch, capsys, tmp_path, "compute_us=1", "search.sizes=[4]")
    assert status == 1
    found = json.loads((tmp_path / "pareto.json").read_text())
    quickest = min(row["p99_us"] for row in found["front"])  # misses least
    said = f"the closest has compute {quickest:.0f} us above compute_us=1"
    assert f"no detector meets deadline_ms=80 and compute_us=1: {said}" in line
    assert found["chosen"] is None
    assert found["front"]
    assert (tmp_path / "pareto.png").exists()
    assert not (tmp_path / "detector.pt").exists()
    assert not (tmp_path / "trial.pt").exists()


def test_one_that_fails_in_the_fresh_process_gives_way_to_the_next(monkeypatch, tmp_path):
    given = iter([900_000.0, 100.0, 100.0])

    def played(path, calls, backend):
        assert path.exists()
        us = next(given)
        return Timing(50.0, us, us, calls)

    monkeypatch.setattr(command, "time_in_fresh_process", played)
    found = run(tmp_path, *EASY)
    first, second, third = found["tries"]
    assert (found["tried"], found["not_tried"]) == (2, found["timed"] - 2)
    assert first["misses"][1] == "compute 900000 us above compute_us=400000"
    assert second["selected"] == third["selected"] == found["chosen"]["selected"]
    assert (second["misses"], third["misses"]) == ([], [])
    assert first["validation"] >= found["chosen"]["validation"]
    made_of = ("selected", "degree", "penalty", "align", "ranking")
    assert [first[key] for key in made_of] != [second[key] for key in made_of]
    assert found["chosen"]["p99_us"] == 100
    assert "sample" not in third["fitted_to"]


def test_all_that_fail_there_leave_none(monkeypatch, tmp_path):
    slow = Timing(50.0, 900_000.0, 900_000.0, 20)
    monkeypatch.setattr(command, "time_in_fresh_process", lambda *a: slow)
    found = run(tmp_path, *EASY, "tries=2")
    assert found["chosen"] is None
    assert len(found["tries"]) == 2
    said = none_meets(found)
    left = found["timed"] - 2
    assert f"in a fresh process (2 tried, {left} that kept both when timed not tried): the" in said
    assert " and ".join(found["tries"][0]["misses"]) in said
    assert not (tmp_path / "detector.pt").exists()


def test_those_that_meet_the_limits_go_by_accuracy(monkeypatch, tmp_path):
    met = []

    def played(detector, calls):
        met.append([str(name) for name in detector.selected_names])
        us = 100.0 * (len(met) + 2)
        return Timing(100.0, us, us, calls)

    monkeypatch.setattr("tactslip_torch.analysis.pareto.time_detector", played)
    slow = Timing(50.0, 900_000.0, 900_000.0, 20)
    monkeypatch.setattr(command, "time_in_fresh_process", lambda *a: slow)
    found = run(tmp_path, "deadline_ms=500", "compute_us=400", "tries=9")
    # 300, 400 and 500 us: two of them keep the limit
    assert len(met) == found["timed"]
    assert sorted(row["selected"] for row in found["tries"]) == sorted(met[:2])
    scores = [row["validation"] for row in found["tries"]]
    assert scores == sorted(scores, reverse=True)


def test_the_last_try_is_for_the_one_with_most_head_room():
    def timed(accuracy, us, ahead=0.0):
        latency = Latency(ahead, 50.0, 5.0, us)
        made = candidate(balanced_accuracy=accuracy, latency=latency)
        return Timed(made, "double", Timing(us, us, us, 20), latency, us)

    limits = Limits(80.0, 500.0, [5.0])
    able = [timed(0.5 + i / 100, 200.0 + 20 * i) for i in range(10)]
    able[2] = quick = timed(0.52, 50.0)
    best_first = able[::-1]
    assert command._in_turn(able, limits, 3) == [*best_first[:2], quick]
    assert command._in_turn(able, limits, 1) == best_first[:1]
    assert command._in_turn(able, limits, 9) == [*best_first[:8], able[0]]  # the quick one was met
    assert command._in_turn(able, limits, 10) == command._in_turn(able, limits, 99) == best_first
    assert command._in_turn([], limits, 5) == []


def test_what_is_missed_least_is_said():
    def row(worst_ms, compute_us, hop_ms):
        latency = Latency(worst_ms - 40 - hop_ms - compute_us / 1000, 40.0, hop_ms, compute_us)
        return {"latency": latency.to_dict(), "misses": Limits(80.0, 500.0, [5.0]).misses(latency)}

    found = {"limits": {"deadline_ms": 80.0, "compute_us": 500.0}, "tries": []}
    found["front"] = [row(50.5, 900.0, 5.0), row(50.5, 421.0, 0.4), row(99.0, 100.0, 5.0)]
    assert none_meets(found).endswith(": the closest has compute 421 us not below the hop 0.4 ms")


def test_ctrl_c_is_one_line(monkeypatch, capsys, tmp_path):
    def stopped(*args):
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "time_in_fresh_process", stopped)
    status, line = fails(monkeypatch, capsys, tmp_path, *EASY)
    assert (status, line) == (130, "interrupted: no detector is written")
    assert not (tmp_path / "trial.pt").exists()
    assert not (tmp_path / "detector.pt").exists()


def test_the_detector_is_put_in_place_last(monkeypatch, tmp_path):
    def broken(found, path):
        assert (tmp_path / "pareto.json").exists()
        assert not (tmp_path / "detector.pt").exists()
        raise ValueError("no room on the disk")

    monkeypatch.setattr(command, "pareto_figure", broken)
    with pytest.raises(ValueError, match="no room"):
        run(tmp_path, *EASY, "search.sizes=[4]")
    assert not list(tmp_path.glob("*.pt"))


def test_unseen_materials_are_never_read(monkeypatch, tmp_path):
    read = []
    load = TinyRecordings.load

    def watched(self, recording, windows=None):
        read.append(str(recording))
        return load(self, recording, windows)

    monkeypatch.setattr(TinyRecordings, "load", watched)
    monkeypatch.setattr(command, "time_in_fresh_process", lambda *a: Timing(50.0, 100.0, 100.0, 20))
    run(tmp_path, *EASY, "cache=off", "search.sizes=[4]")
    assert {name[0] for name in read} == {"A", "B"}
    # the test cycles once and at the end, by the detector that was chosen by then
    source = TinyRecordings(seed=0, cycles=4, materials=["A", "B", "C"])
    fold = unseen4(source.ids, seen=["A", "B"], unseen=["C"], train_share=0.5)[0]
    test = [str(recording) for recording in fold.having("test")]
    assert read[-len(test) :] == test
    assert not set(test) & set(read[: -len(test)])


# The workshop ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def shop():
    source = TinyRecordings(seed=0, cycles=4, materials=["A", "B"])
    fold = unseen4(source.ids, seen=["A"], unseen=["B"], train_share=0.5)[0]
    config = composed(*TINY, name="pareto").search
    search = Search(**{k: v for k, v in config.items() if k != "_target_"})
    lengths = [51, 51, 11, 11]
    makers = {
        align: FeatureMaker(
            source, FeaturePool(source.hand), ChannelFilter(lengths, align=align), LabelRule()
        )
        for align in ("centred", "causal")
    }
    recipe = composed(*TINY, name="pareto").recipe
    from hydra.utils import instantiate

    made = Workshop(makers, fold, search, instantiate(recipe, _convert_="all"), num_workers=0)
    made.look()
    return made


def candidate(**changes):
    parts = {
        "align": "causal",
        "channels": "all",
        "components": "all",
        "columns": "channel",
        "ranking": "t",
        "degree": 1,
        "penalty": 0.01,
        "selected": (3, 40, 300, 17),
        "balanced_accuracy": 0.9,
        "by_group": {},
        "latency": Latency(0.0, 50.0, 5.0, 100.0),
    }
    parts |= changes
    selected = parts.pop("selected")
    ends = torch.ones(len(selected), dtype=torch.float64)
    return Candidate(
        **({"selection": FeatureSelection(selected, FeatureScaler(-ends, ends))} | parts)
    )


def test_a_detector_found_twice_is_one_candidate():
    found = [
        candidate(),
        candidate(channels="pvdf"),
        candidate(ranking="ccweighting", selected=(40, 3, 17, 300)),
        candidate(penalty=0.1),
        candidate(degree=2),
        candidate(align="centred"),
        candidate(selected=(3, 40, 300)),
    ]
    assert distinct(found) == [found[0], *found[3:]]


def scaled(shop, found):
    """The candidate with its features scaled as the search does."""
    return found._replace(
        selection=scaled_selection(shop.recipe, shop.surveys[found.align], found.selected)
    )


@pytest.mark.parametrize("degree", [1, 2])
def test_a_pooled_detector_is_made_timed_and_judged(shop, degree):
    survey = shop.surveys["causal"]
    recipe = replace(shop.recipe, pooling=["mean", "std"], use="pooled")
    everything = Structure("pooled", 10**6, Polynomial(1))
    mask = allowed(shop.pool.hand, shop.pool.names, "all", "time_moments")
    frame = fitted_selection(recipe, shop.pool, survey.sample.bins(), everything, mask).first(18)
    chosen = candidate(selection=frame, columns="pooled mean, std", degree=degree)
    detector = shop.make(chosen, "double", from_all=True)
    assert detector.info["fitted_to"] == "all training bins"
    assert detector.pooling.names == frame.pooling.names
    assert len(detector.selected_names) == 18
    assert detector.gaussians is None
    assert set(detector.selected) == {shop.pool.names.index(n) for n in frame.pooling.inputs}
    assert shop.evaluated(detector)["balanced_accuracy"] > 0.5
    (timed,) = shop.timed([chosen])
    row = command.row_of(shop, timed, Limits(80.0, 500.0, [5.0]), timed.latency, timed.timing)
    assert row["graph_p50_us"] > 0
    assert (row["num_features"], row["features_read"]) == (18, len(detector.selected))
    assert row["selected"] == [str(name) for name in frame.pooling.names]


@pytest.mark.parametrize("degree", [1, 2])
def test_a_machine_of_all_bins_is_that_of_all_bins(shop, degree):
    chosen = scaled(shop, candidate(degree=degree))
    detector = shop.make(chosen, "double", from_all=True)
    assert detector.info["fitted_to"] == "all training bins"
    maker = shop.makers["causal"]
    features, labels = [], []
    for recording in shop.fold.having("train"):
        batch = maker(recording, shop.fold)
        features.append(batch.features[:, list(chosen.selected)].double())
        labels.append(batch.is_slip)
    z, is_slip = detector.scaler(torch.cat(features)), torch.cat(labels)
    counts = torch.bincount(is_slip.long()).double()
    weights = (len(z) / (2 * counts))[is_slip.long()]
    training = TrainingBins(z, is_slip, weights)
    offset = FREE_CONSTANT if degree == 1 else 0.5
    head = fit_machine(training, 0.01, Polynomial(degree, offset), route="dual")
    torch.testing.assert_close(detector.head(z), head(z), rtol=1e-6, atol=1e-6)


def test_a_large_quadratic_head_keeps_to_the_sample(shop):
    shop.most_summed = 3
    try:
        quadratic = shop.make(candidate(degree=2), "double", from_all=True)
        linear = shop.make(candidate(degree=1), "double", from_all=True)
    finally:
        shop.most_summed = 120
    assert quadratic.info["fitted_to"] == "30 training bins of each material and class"
    assert linear.info["fitted_to"] == "all training bins"


@pytest.mark.parametrize(("align", "before", "after"), [("centred", 25, 25), ("causal", 50, 0)])
def test_test_bins_come_with_the_context_of_their_filter(shop, monkeypatch, align, before, after):
    detector = shop.make(candidate(align=align), "double")
    given, predict_raw = [], detector.predict_raw
    monkeypatch.setattr(detector, "predict_raw", lambda raw: given.append(raw) or predict_raw(raw))
    found = shop.evaluated(detector)
    expected = []
    for recording in shop.fold.having("test"):
        maker = shop.makers[align]
        starts = maker.lay_bins(maker.source.timeline(recording)).starts.tolist()
        samples = maker.source.load(recording).samples
        expected += [samples[:, start - before : start + 100 + after] for start in starts]
    assert torch.equal(torch.cat(given), torch.stack(expected))
    assert found["num_bins"] == len(expected)


class BrokenBefore(TinyRecordings):
    """One sample is missing 30 before the first bin."""

    def load(self, recording, windows=None):
        loaded = super().load(recording, windows)
        loaded.samples[0, 150] = torch.nan
        return loaded


def test_a_broken_sample_before_a_causal_bin_is_named():
    source = BrokenBefore(seed=0, cycles=2, materials=["A"])
    causal = ChannelFilter([51, 51, 11, 11], align="causal")
    maker = FeatureMaker(source, FeaturePool(source.hand), causal, LabelRule())
    assert int(maker.lay_bins(source.timeline(source.ids[0])).starts[0]) == 180
    fold = seen6(source.ids, seen=["A"])[0]
    with pytest.raises(ValueError, match=r"A/0: channel SG1, sample 150 \(0.0750 s\) is nan"):
        maker(source.ids[0], fold)


def test_a_saved_causal_detector_loads_as_causal(shop, tmp_path):
    detector = shop.make(candidate(), "double")
    detector.save(tmp_path / "a.pt")
    loaded = SlipDetector.load(tmp_path / "a.pt")
    assert loaded.channel_filter.align == "causal"
    raw = torch.randn(5, 4, 150)
    assert torch.equal(loaded.predict_raw(raw).score, detector.predict_raw(raw).score)
    changed = raw.clone()
    changed[..., :50] += 1  # all context lies before the bin
    moved = loaded.predict_raw(changed).score - loaded.predict_raw(raw).score
    assert (moved != 0).any()

"""The search for the front against its definitions, and ``pareto`` as a command."""

import itertools
import json
import sys
from dataclasses import replace

import pytest
import torch
from small_detector import HAND as FOUR_CHANNELS
from small_detector import small_detector
from small_set import SMALL_HAND, SmallSet, refitted_scores, small_maker, small_recipe
from test_commands import BAD_INPUT, TINY_DATA, TINY_SPLIT, TinyRecordings, composed

import tactslip_torch.commands.pareto as command
from tactslip_torch import SlipDetector
from tactslip_torch.analysis import latency as latency_module
from tactslip_torch.analysis import pareto
from tactslip_torch.analysis.latency import (
    GROUPS,
    CostModel,
    Latency,
    Limits,
    Timing,
    detector_parts,
    measure_costs,
    parts_of,
    time_calls,
    time_in_fresh_process,
)
from tactslip_torch.commands.stopping import one_line
from tactslip_torch.data.splits import seen6, unseen4
from tactslip_torch.features.bank import make_plan, pool_names
from tactslip_torch.features.groups import allowed
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.features.pooling import ChannelPooling
from tactslip_torch.hand import HandLayout
from tactslip_torch.model.fit import TrainingBins, fit_machine
from tactslip_torch.model.kernels import Polynomial
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.signals.filtering import ChannelFilter
from tactslip_torch.training.recipe import (
    FREE_CONSTANT,
    FeatureSelection,
    balanced_accuracy,
    sample_weight,
    scaled_selection,
)

SMALL = {
    "sizes": [3, 6],
    "channels": ["all", "films", "gauges"],
    "drop_fingers": True,
    "components": ["all", "time"],
    "rankings": ["t", "ccweighting", "per_cost"],
    "degrees": [1, 2],
    "aligns": ["centred"],
    "arithmetics": ["double"],
    "hops_ms": [5.0, 10.0],
    "penalties": [0.1, 1.0],
    "bins": 40,
}
POOLED = {"statistics": [["mean"]], "pooled_sizes": [None, 4], "pooled_components": ["moments"]}
RECIPE = small_recipe(balance="weights", compress=True, tail=0.01)
HAND = HandLayout.paper24()
PRICES = dict.fromkeys(GROUPS, 1.0)


@pytest.fixture(scope="module", autouse=True)
def no_clock():
    """Prices as given: what anything takes is not looked at, but in the command's own test."""
    with pytest.MonkeyPatch.context() as patch:
        costs = CostModel(10.0, PRICES, PRICES, tail=2.0)
        patch.setattr(pareto, "measure_costs", lambda *args, **named: costs)
        yield patch


def searching(**changes):
    """A search on a small set that has read its training recordings."""
    maker = small_maker(SmallSet())
    fold = seen6(maker.source.ids, seen=["a", "b", "c"])[0]
    search = pareto.Search(**SMALL | changes)
    made = pareto.ParetoSearch({"centred": maker}, fold, search, RECIPE, num_workers=0)
    made.read()
    return made


@pytest.fixture(scope="module")
def searched():
    made = searching(**POOLED)
    return made, made.candidates()


def at(worst_ms, compute_us, accuracy, size=50):
    """A candidate that nobody searched for."""
    ends = torch.ones(size, dtype=torch.float64)
    selected = (3, 40, 300, 17, *range(400, 400 + size))[:size]
    how = {"columns": "channel", "ranking": "t", "degree": 1, "penalty": 0.01}
    found = {"balanced_accuracy": accuracy, "by_group": {}}
    return pareto.Candidate(
        group=pareto.Group("causal", "all", "all", None),
        selection=FeatureSelection(selected, FeatureScaler(-ends, ends)),
        latency=Latency(worst_ms - 55 - compute_us / 1000, 50.0, 5.0, compute_us),
        **(how | found | {"modelled_us": compute_us, "graph_us": compute_us}),
    )


# What is searched --------------------------------------------------------------------------------
def test_groups_hold_what_their_names_say():
    names = pool_names(HAND, 4)

    def names_of(channels, components):
        mask = allowed(HAND, names, channels, components).tolist()
        return {name for name, inside in zip(names, mask, strict=True) if inside}

    everything = names_of("all", "all")
    assert len(everything) == 2582
    assert {name.channel[:2] for name in names_of("gauges", "all")} == {"SG"}
    assert names_of("films", "all") == everything - names_of("gauges", "all")
    costly, jumping = {"median", "mode", "iqr", "entropy"}, {"mode", "cv", "entropy"}
    deep = {"A3", "D3", "A4", "D4", "raw"}
    rules = {
        "time": lambda n: n.domain == "time",
        "unsorted": lambda n: n.descriptor not in costly,
        "steady": lambda n: n.descriptor not in jumping,
        "moments": lambda n: n.descriptor not in costly | jumping,
        "time_moments": lambda n: n.domain == "time" and n.descriptor not in costly | jumping,
        "spreads": lambda n: n.domain == "time" and n.descriptor in ("std", "range"),
        "deep_spectra": lambda n: n.domain == "time" or n.component in deep,
    }
    for components, does in rules.items():
        assert names_of("all", components) == set(filter(does, everything)), components
    for channels, components in (("toes", "all"), ("all", "cheap")):
        with pytest.raises(ValueError, match=rf"unknown group '{channels}' or '{components}'"):
            names_of(channels, components)


REFUSED = [
    ({"channels": ["toes"]}, r"search.channels: unknown 'toes', expected some of all, films"),
    ({"sizes": []}, r"search.sizes is empty, expected at least one value"),
    ({"sizes": 8}, r"search.sizes must be a list in brackets, got 8"),
    ({"sizes": [8.5]}, r"search.sizes must be a positive whole number, got 8.5"),
    ({"pooled_sizes": [None, 0]}, r"search.pooled_sizes must be a positive whole number"),
    ({"penalties": [float("inf")]}, r"search.penalties must be a .* finite number, got inf"),
    ({"calls": True}, r"search.calls must be a positive whole number, got True"),
    ({"cost_power": -1}, r"search.cost_power must be a finite number of at least 0, got -1"),
    ({"alpha": 1.5}, r"search.alpha must be at most 1, got 1.5"),
    ({"degrees": [True]}, r"search.degrees: unknown True, expected some of 1, 2"),
    ({"statistics": ["mean"]}, r"each of search.statistics must be a list in brackets, got 'm"),
]


@pytest.mark.parametrize(("changes", "message"), REFUSED)
def test_what_cannot_be_searched_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        pareto.Search(**(SMALL | changes))


# What is found -----------------------------------------------------------------------------------
@pytest.mark.parametrize("degree", [1, 2])
def test_a_score_is_that_of_machines_that_never_met_the_material(searched, degree):
    made, candidates = searched
    wanted = ("films", "all", "t", degree, "channel", 6)
    (found,) = [
        c
        for c in candidates
        if (*c.group[1:3], c.ranking, c.degree, c.columns, c.selection.size) == wanted
    ]
    statistics = made.training_statistics["centred"]
    sample = statistics.sample.bins()
    z = scaled_selection(RECIPE, statistics, found.selected)(sample.features)
    weights = sample_weight(RECIPE, sample)
    bins, by_penalty = TrainingBins(z, sample.is_slip, weights), {}
    for penalty in SMALL["penalties"]:
        is_called = refitted_scores(bins, sample.group, penalty, Polynomial(degree, 0.5)) >= 0
        masks = [sample.group == index for index in range(len(sample.group_names))]
        scores = [balanced_accuracy(is_called[own], sample.is_slip[own]) for own in masks]
        by_penalty[penalty] = scores
    best = max(by_penalty, key=lambda penalty: sum(by_penalty[penalty]))
    assert found.balanced_accuracy == pytest.approx(sum(by_penalty[best]) / 3)
    assert list(found.by_group.values()) == pytest.approx(by_penalty[found.penalty])


def test_a_pooled_score_is_that_of_everything_learned_without_the_material(searched):
    made, candidates = searched
    pooled = [c for c in candidates if c.columns == "pooled mean"]
    sized = itertools.product(("all", "films", "gauges"), ("none", "gd"), (1, 2))
    assert sorted((c.group.channels, c.ranking, c.degree) for c in pooled) == sorted(sized)
    assert all(each.selection.size == 4 or each.ranking == "none" for each in pooled)
    (found,) = [
        c for c in pooled if (c.group.channels, c.ranking, c.degree) == ("films", "none", 1)
    ]
    sample, names = made.training_statistics["centred"].sample.bins(), made.pool.names
    weights = sample_weight(RECIPE, sample)
    films = allowed(SMALL_HAND, names, "films", "moments").nonzero()[:, 0]
    names = [names[index] for index in films]
    features = sample.features[:, films].double()
    expected = []
    for index in range(len(sample.group_names)):
        out = sample.group == index
        layer = ChannelPooling.fit(SMALL_HAND, names, features[~out], ["mean"])
        columns = layer(features[:, [names.index(name) for name in layer.inputs]])
        z = FeatureScaler.fit(columns[~out], compress=True, tail=0.01)(columns)
        training = TrainingBins(z[~out], sample.is_slip[~out], weights[~out])
        head = fit_machine(training, found.penalty, Polynomial(1, FREE_CONSTANT))
        expected.append(balanced_accuracy(head(z[out]) >= 0, sample.is_slip[out]))
    assert list(found.by_group.values()) == pytest.approx(expected)


# The front ---------------------------------------------------------------------------------------
def test_each_finger_goes_that_is_missed_least(monkeypatch):
    made = searching(rankings=["t"], components=["all"])
    made.pool = FeaturePool(HAND)
    made._channel_of = [HAND.names.index(name.channel) for name in made.pool.names]
    worth = {"little": 0.01, "ring": 0.3, "middle": 0.02, "index": 0.2, "thumb": 0.1}

    def played(group, ranking, degrees):
        gone = group.channels.split(" without ")[1].split(" and ")
        names = zip(made.pool.names, group.mask, strict=True)
        assert {HAND.channel(n.channel).finger for n, m in names if m} == set(worth) - set(gone)
        return [at(60.0, 100.0, 0.9 - sum(worth[finger] for finger in gone))]

    monkeypatch.setattr(made, "_of_channels", played)
    one_of_each = tuple(made._channel_of.index(channel) for channel in (0, 3, 6, 9, 12))
    best = at(60.0, 100.0, 0.9, 5)
    best = replace(best, selection=replace(best.selection, selected=one_of_each))
    found = made.without_fingers(best)
    kept = [max(c.balanced_accuracy for c in part) for part in (found[:5], found[5:9], found[9:12])]
    assert kept == pytest.approx([0.89, 0.87, 0.77])  # little, then middle, then the thumb
    assert len(found) == 5 + 4 + 3 + 2


def test_landmarks_are_the_best_the_cheap_and_the_small():
    def found(*rows):
        return list(pareto.landmarks(rows).values())

    best, quick = at(60.0, 300.0, 0.99, 100), at(60.0, 200.0, 0.99, 100)
    third, poor = at(60.0, 100.0, 0.981, 60), at(60.0, 10.0, 0.979, 30)
    few, fewer = at(60.0, 200.0, 0.95, 20), at(60.0, 90.0, 0.94, 8)
    assert found(poor, few, third, best, fewer) == [best, third, few]
    assert found(best, third, poor) == [best, third, None]
    assert found(best, quick, third) == [quick, None, None]  # as accurate: the quickest
    assert found() == [None, None, None]
    made = [at(60.0, 100.0, accuracy) for accuracy in (0.8, 0.9, 0.7)]
    pooled = [replace(each, columns="pooled mean") for each in made]
    small = [at(60.0, 100.0, accuracy, 20) for accuracy in (0.4, 0.5)]
    assert set(pareto.worth_naming([*made, *pooled, *small])) == {made[1], pooled[1], small[1]}


def test_what_is_close_to_the_limits_is_timed(rng):
    """Two filters: the quick one waits longer, so accuracy does not rise with compute."""
    line = [at(61.0, 100.0 + 10 * i, 0.8 - 0.001 * (39 - i)) for i in range(40)]
    line += [at(59.0, 500.0 + 10 * i, 0.6 + 0.001 * i) for i in range(40)]
    timed = pareto.worth_timing(
        [line[i] for i in rng.permutation(80)], 10, Limits(80.0, 300.0, [5.0])
    )
    # 450 us and 300 us at most, then 200 us, best first: the model may err either way
    compute = [each.latency.compute_us for each in timed]
    assert compute[:5] == [490.0, 450.0, 300.0, 200.0, 440.0]
    assert {100.0, 890.0} < set(compute)  # the cheapest and the dearest
    assert len(set(compute)) == 10


def test_the_front_is_what_nothing_beats(rng):
    points = rng.integers(0, 6, (80, 3)).tolist()

    def beats(a, b):
        return all(x <= y for x, y in zip(a, b, strict=True)) and a != b

    expected = [
        i
        for i, own in enumerate(points)
        if own not in points[:i] and not any(beats(other, own) for other in points)
    ]
    assert pareto.nondominated(points) == expected
    assert pareto.nondominated([]) == []


# The command -------------------------------------------------------------------------------------
TINY = (
    *(*TINY_DATA, *TINY_SPLIT, "num_workers=0", "search=quick", "search.sizes=[4,8]"),
    *("search.rankings=[t]", "search.components=[time]", "search.aligns=[centred]"),
    *("search.arithmetics=[double]", "search.calls=10", "search.most_timed=2", "retime_calls=20"),
)
FEW = ("search.sizes=[4]", "search.degrees=[1]", "search.statistics=[]", "search.channels=[all]")
EASY = ("deadline_ms=500", "compute_us=400000")  # a busy machine keeps these too


def run(folder, *overrides):
    return command.pareto(composed(*TINY, *overrides, name="pareto"), folder)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """The whole command, its recordings watched and the fresh process played."""
    folder, read, load = tmp_path_factory.mktemp("pareto"), [], TinyRecordings.load

    def watched(self, recording, windows=None):
        read.append(str(recording))
        return load(self, recording, windows)

    times = iter([900_000.0, 100.0, 100.0])

    def played(path, calls, backend):
        assert path.exists()
        us = next(times)
        return Timing(50.0, us, us, calls)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TinyRecordings, "load", watched)
        patch.setattr(command, "time_in_fresh_process", played)
        patch.setattr(TinyRecordings, "units", "N", raising=False)
        found = run(folder, *EASY, "cache=off")
    return folder, found, read


def test_the_files_and_the_parts_of_the_promise(written):
    folder, found, _ = written
    assert json.loads((folder / "pareto.json").read_text()) == found
    names = {"pareto.json", "pareto.png", "detector.pt", "config.yaml"}
    assert {path.name for path in folder.iterdir()} == names
    for row in [found["chosen"], *found["front"]]:
        latency = row["latency"]
        parts = [latency[name] for name in ("look_ahead_ms", "bin_ms", "hop_ms")]
        assert latency["worst_ms"] == pytest.approx(sum(parts) + latency["compute_us"] / 1000)
        assert latency["compute_us"] == row["p99_us"]
        gauges = any(name.startswith("SG") for name in row["channels_read"])
        assert latency["look_ahead_ms"] == (12.5 if gauges else 2.5)
        assert len(row["selected"]) == row["num_features"]
        assert row["graph_p50_us"] > 0
    points = [(r["latency"]["worst_ms"], r["p99_us"], -r["validation"]) for r in found["front"]]
    assert pareto.nondominated(points) == list(range(len(points)))
    assert found["searched"] == len(found["modelled"]) >= found["timed"] >= len(points)


def test_one_that_fails_in_the_fresh_process_gives_way_to_the_next(written):
    folder, found, _ = written
    first, second, third = found["tries"]
    assert (found["tried"], found["not_tried"]) == (2, found["timed"] - 2)
    assert first["misses"][1] == "compute 900000 us above compute_us=400000"
    assert second["selected"] == third["selected"] == found["chosen"]["selected"]
    assert first["validation"] >= found["chosen"]["validation"]
    assert found["chosen"]["p99_us"] == 100
    assert found["chosen"]["latency"]["hop_ms"] == 50  # the longest that keeps the deadline
    assert "sample" not in third["fitted_to"]
    detector = SlipDetector.load(folder / "detector.pt")
    assert [str(name) for name in detector.selected_names] == found["chosen"]["selected"]
    assert detector.info["train_materials"] == ["A", "B"]
    assert detector.info["units"] == "N"


def test_unseen_materials_are_never_read_and_test_cycles_by_the_chosen_one_alone(written):
    _, found, read = written
    assert {name[0] for name in read} == {"A", "B"}
    source = TinyRecordings(seed=0, cycles=4, materials=["A", "B", "C"])
    fold = unseen4(source.ids, seen=["A", "B"], unseen=["C"], train_fraction=0.5)[0]
    test = [str(recording) for recording in fold.having("test")]
    assert read[-len(test) :] == test
    assert not set(test) & set(read[: -len(test)])
    assert found["chosen"]["test"]["num_bins"] > 0


BAD_ARGUMENTS = [
    ("deadline_ms=57.5", "look-ahead 2.5 ms are 57.5 ms before any compute; give more, or a"),
    ("tries=0", "tries must be a positive whole number, got 0"),
    ("search.hops_ms=[5.3]", "search.hops_ms: 5.3 ms are 10.6 samples at 2000 Hz"),
    ("headroom=0.5", "headroom must be a finite number of at least 1, got 0.5"),
    ("search.sizes=[5000]", "an empty selection: no group of this hand"),
]


@pytest.mark.parametrize(("argument", "message"), BAD_ARGUMENTS)
def test_bad_input_is_one_line(monkeypatch, tmp_path, argument, message):
    monkeypatch.setattr(pareto.ParetoSearch, "read", None)  # it refuses before it works
    with pytest.raises(BAD_INPUT) as caught:
        run(tmp_path, argument)
    line = one_line(caught.value)
    assert message in line
    assert "\n" not in line
    assert not (tmp_path / "pareto.json").exists()


def test_none_that_meets_the_limits_is_said_plainly(monkeypatch, capsys, tmp_path):
    (tmp_path / "detector.pt").write_text("of an earlier run")
    arguments = ["pareto", *TINY, f"hydra.run.dir={tmp_path}", "compute_us=1", *FEW]
    monkeypatch.setattr(sys, "argv", arguments)
    with pytest.raises(SystemExit) as stopped:
        command.main()
    line = capsys.readouterr().err.strip().splitlines()[-1]
    assert stopped.value.code == 1
    found = json.loads((tmp_path / "pareto.json").read_text())
    quickest = min(row["p99_us"] for row in found["front"])  # misses least
    said = f"the closest has compute {quickest:.0f} us above compute_us=1"
    assert f"no detector meets deadline_ms=80 and compute_us=1: {said}" in line
    assert found["chosen"] is None
    assert (tmp_path / "pareto.png").exists()
    assert not list(tmp_path.glob("*.pt"))


RATE_HZ = 2000


def decided_after_ms(onset, num_samples, hop, look_ahead, compute_us):
    """Samples come one by one; the first bin that begins at or behind the onset decides."""
    start = next(start for start in itertools.count(onset) if start % hop == 0)
    return (start + num_samples + look_ahead - onset) * 1000 / RATE_HZ + compute_us / 1000


@pytest.mark.parametrize("look_ahead", [0, 5, 25])
@pytest.mark.parametrize("hop", [10, 37, 100])
def test_no_onset_waits_longer_and_one_waits_so_long(look_ahead, hop):
    played = [decided_after_ms(400 + i, 100, hop, look_ahead, 700.0) for i in range(hop)]
    stated = Latency(look_ahead / 2, 50.0, hop / 2, 700.0)
    # an onset just behind the first sample of a bin is the worst: it misses that bin by nothing
    assert max(played) == pytest.approx(stated.worst_ms - 1000 / RATE_HZ)
    assert stated.to_dict()["worst_ms"] == stated.worst_ms


def test_what_is_missed_is_named():
    latency = Latency(2.5, 50.0, 5.0, 400.0)
    assert Limits(57.9, 400, [5.0]).misses(latency) == []
    assert Limits(57.8, 399, [5.0]).misses(latency) == [
        "latency 57.90 ms above deadline_ms=57.8",
        "compute 400 us above compute_us=399",
    ]
    missed = Limits(100, 9999, [5.0]).misses(Latency(0.0, 50.0, 5.0, 5000.0))
    assert missed == ["compute 5000 us not below the hop 5 ms"]
    assert Latency(0.0, 50.0, 5.0, 1000.0).load == pytest.approx(0.2)


# Costs -------------------------------------------------------------------------------------------
POOL = FeaturePool(FOUR_CHANNELS)


def test_the_hop_leaves_head_room_where_one_does():
    limits = Limits(80.0, 500.0, [5.0, 10.0, 25.0])
    parts = Latency(4.6, 50.0, 5.0, 1.0)
    assert limits.latency(parts, 380.0).hop_ms == 25  # 79.98 ms
    roomy = limits.latency(parts, 380.0, headroom=1.25)
    assert (roomy.hop_ms, roomy.compute_us) == (10, 380)  # 25 ms with 475 us are 80.075 ms
    assert limits.latency(parts, 390.0, headroom=1.5).hop_ms == 25  # 585 us are none: without
    tight = Latency(2.0, 50.0, 5.0, 400.0)
    assert Limits(60.0, 5000.0, [5.0]).headroom(tight) == pytest.approx(7.5)
    assert Limits(900.0, 500.0, [5.0]).headroom(tight) == 1.25
    for us, hop_ms in ((12_000.0, 25), (60_000.0, 25), (5_000.0, 10)):
        assert Latency(0.0, 50.0, 5.0, us).with_shortest_hop(limits.hops_ms).hop_ms == hop_ms


PRIMES = dict(zip(GROUPS, (2.0, 3, 5, 7, 11, 13, 17, 19, 23, 29, 31, 37), strict=True))
MODEL = CostModel(0.5, {name: 1000 * price for name, price in PRIMES.items()}, PRIMES, tail=2.0)


def priced(**groups):
    """The bill by hand: each group once, and so many of its parts."""
    return 2 * (0.5 + sum((1000 + num) * PRIMES[name] for name, num in groups.items()))


BILLS = [
    (["SG1 raw time mean"], {"gauges": 1, "moments": 1}),
    (["SG1 raw time mode"], {"gauges": 1, "sorts": 1}),
    (
        ["PVDF1 A2 time std", "PVDF1 A2 time median", "PVDF1 A2 time iqr"],
        {"films": 1, "branches": 1, "moments": 1, "sorts": 1},
    ),
    (
        ["PVDF1 A2 time correlation", "PVDF2 A2 time entropy"],
        {"films": 2, "branches": 2, "correlations": 1, "sorts": 1, "histograms": 1},
    ),
    (
        ["PVDF1 D4 freq spectral_centroid", "PVDF1 D4 freq spectral_spread"],
        {"films": 1, "spectra": 1, "lines": 1},
    ),
    (
        ["PVDF1 A1 freq band_energy_ratio", "PVDF1 D3 freq band_energy_ratio"],
        {"films": 1, "energies": 1},
    ),
]


@pytest.mark.parametrize(("names", "bill"), BILLS)
def test_shared_work_is_on_the_bill_once(names, bill):
    needed, everything = parts_of(make_plan(FOUR_CHANNELS, 4, names)), range(len(names))
    alone = priced(**bill, columns=len(names))
    assert MODEL.compute_us(detector_parts(needed, everything)) == pytest.approx(alone)
    pooled = priced(**bill, columns=5, pooled=len(names))  # five numbers of all of them
    assert MODEL.compute_us(detector_parts(needed, everything, 5)) == pytest.approx(pooled)


def test_prices_are_found_again_in_timings_that_follow_them(monkeypatch):
    needed = parts_of(make_plan(POOL.hand, POOL.level, POOL.names))

    def played(detector, calls):
        layer = detector.pooling
        num_pooled = None if layer is None else len(layer.names)
        us = MODEL.compute_us(detector_parts(needed, detector.selected, num_pooled))
        return Timing(us / 2, us, us, calls)

    monkeypatch.setattr(latency_module, "time_detector", played)
    costs = measure_costs(POOL, ChannelFilter([51, 51, 11, 11]), [4, 8], "auto", ["mean", "std"])
    assert costs.tail == pytest.approx(2.0)
    assert costs.error < 0.02
    assert min(costs.base_us, *costs.group_us.values(), *costs.part_us.values()) >= 0
    some = detector_parts(needed, range(0, len(needed), 50))
    assert costs.compute_us(some) == pytest.approx(MODEL.compute_us(some), rel=0.05)
    plain = json.loads(json.dumps(costs.to_dict(), allow_nan=False))
    assert plain["groups"].keys() == GROUPS.keys()


# The clock ---------------------------------------------------------------------------------------
class Played:
    """A clock and calls that are played: microseconds as given, interrupted if negative."""

    def __init__(self, monkeypatch, *runs):
        self.now, self.switches = 0, 0
        self.left = iter([1, *(us for run in runs for us in run)])  # the first is not timed
        monkeypatch.setattr(latency_module.time, "perf_counter_ns", lambda: self.now)
        monkeypatch.setattr(latency_module, "_interruptions", lambda: self.switches)

    def __call__(self, given):
        us = next(self.left)
        self.now += 1000 * abs(us)
        self.switches += us < 0


def test_calls_are_timed_one_by_one_and_interrupted_ones_told_but_not_counted(monkeypatch):
    run = list(range(1, 101))
    played = Played(monkeypatch, run[::-1], [10 * us for us in run], run)
    # one run that a neighbour slows down does not decide
    assert time_calls(played, [None], 100, runs=3) == Timing(51.0, 99.0, 99.0, 100, 0.0)
    played = Played(monkeypatch, [*run[:50], *[-5000] * 25, *run[50:]])
    assert time_calls(played, [None], 100, runs=1) == Timing(51.0, 99.0, 5000.0, 100, 0.2)
    played = Played(monkeypatch, [7, *[-5000] * 100])
    assert time_calls(played, [None], 100, runs=1).p50_us == 5000  # hardly one was left alone


@pytest.mark.slow
def test_a_saved_detector_is_timed_in_a_process_of_its_own(tmp_path):
    small_detector().save(tmp_path / "detector.pt")
    timing = time_in_fresh_process(tmp_path / "detector.pt", 20, "auto")
    assert timing.calls == 20
    assert 0 < timing.p50_us <= timing.p99_us <= timing.p99_all_us
    with pytest.raises(FileNotFoundError, match=r"gone.pt"):
        time_in_fresh_process(tmp_path / "gone.pt", 20)

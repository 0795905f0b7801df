"""Groups, the search and the front, each against its definition."""

import itertools
from dataclasses import replace

import pytest
import torch
from small_set import SMALL_HAND, SmallSet, small_maker, small_recipe

from tactslip_torch.analysis.latency import GROUPS, CostModel, Latency, Limits, Timing
from tactslip_torch.analysis.pareto import (
    Candidate,
    Search,
    Searcher,
    Timed,
    landmarks,
    nondominated,
    worth_naming,
    worth_timing,
)
from tactslip_torch.data.splits import seen6
from tactslip_torch.features.groups import allowed, of_fingers
from tactslip_torch.features.names import FeatureName, pool_names
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.features.pooling import ChannelPooling
from tactslip_torch.features.selection import rank_features, t_scores
from tactslip_torch.features.survey import Survey
from tactslip_torch.hand import HandLayout
from tactslip_torch.model.fit import TrainingBins, fit_machine
from tactslip_torch.model.kernels import Polynomial
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.signals.filtering import ChannelFilter
from tactslip_torch.training.datamodule import SlipDataModule
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


def described(candidates):
    """What can be compared of candidates."""
    return [
        (c._replace(selection=None), c.detector, c.selection.scaler.minimum.tolist())
        for c in candidates
    ]


def searcher(source=None, recipe=RECIPE, **changes):
    source = source or SmallSet()
    search = Search(**(SMALL | changes))
    maker = small_maker(source)
    fold = seen6(source.ids, seen=["a", "b", "c"])[0]
    survey = Survey(len(maker.pool.names), search.bins)
    for batch in SlipDataModule(maker, fold, 0).loader(["train"]):
        name, material = str(batch.recording), batch.recording.material
        survey.update(name, material, batch.features, batch.is_slip)
    prices = dict.fromkeys(GROUPS, 1.0)
    costs = CostModel(10.0, prices, prices, 50.0, 0.0, 2.0, 0.0)
    filters = {"centred": maker.channel_filter}
    return Searcher(search, recipe, maker.pool, costs, {"centred": survey}, filters)


@pytest.fixture(scope="module")
def searched():
    made = searcher(**POOLED)
    return made, made.candidates()


# Groups ----------------------------------------------------------------------------------------


def names_of(channels, components):
    names = pool_names(HAND, 4)
    mask = allowed(HAND, names, channels, components)
    return {name for name, inside in zip(names, mask.tolist(), strict=True) if inside}


def test_groups_hold_what_their_names_say():
    everything = names_of("all", "all")
    assert len(everything) == 2582
    assert {name.channel[:2] for name in names_of("gauges", "all")} == {"SG"}
    assert names_of("films", "all") == everything - names_of("gauges", "all")
    costly = {"median", "mode", "iqr", "entropy"}
    assert names_of("all", "unsorted") == {n for n in everything if n.descriptor not in costly}
    assert {name.domain for name in names_of("all", "time")} == {"time"}
    jumping = {"mode", "cv", "entropy"}
    steady = {n for n in everything if n.descriptor not in jumping}
    assert names_of("all", "steady") == steady
    moments = {n for n in steady if n.descriptor not in costly}
    assert names_of("all", "moments") == moments
    assert names_of("all", "time_moments") == {n for n in moments if n.domain == "time"}
    assert {n.descriptor for n in names_of("all", "spreads")} == {"std", "range"}
    assert {n.domain for n in names_of("all", "spreads")} == {"time"}
    left = everything - names_of("all", "deep_spectra")
    assert {name.component for name in left} == {"A1", "D1", "A2", "D2"}
    assert {name.domain for name in left} == {"freq"}
    with pytest.raises(ValueError, match=r"unknown group 'toes' or 'all', expected one of all"):
        names_of("toes", "all")
    with pytest.raises(ValueError, match=r"unknown group 'all' or 'cheap'"):
        names_of("all", "cheap")


def test_fingers_are_those_of_the_channels():
    names = (FeatureName("SG1", "raw", "time", "mean"), FeatureName("PVDF10", "A1", "time", "std"))
    assert of_fingers(HAND, names, ["little"]).tolist() == [True, False]
    assert of_fingers(HAND, names, ["thumb", "index"]).tolist() == [False, True]


# What is searched ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"channels": ["toes"]}, r"search.channels: unknown 'toes', expected some of all, films"),
        ({"components": ["cheap"]}, r"search.components: unknown 'cheap', expected .* time"),
        ({"rankings": ["best"]}, r"search.rankings: unknown 'best', expected some of t, cc"),
        ({"aligns": ["left"]}, r"search.aligns: unknown 'left', expected some of centred"),
        ({"arithmetics": ["half"]}, r"search.arithmetics: unknown 'half'"),
        ({"sizes": []}, r"search.sizes is empty, expected at least one value"),
        ({"rankings": []}, r"search.rankings is empty"),
        ({"sizes": [0, 3]}, r"search.sizes must be a positive whole number, got 0"),
        ({"sizes": 8}, r"search.sizes must be a list in brackets, got 8"),
        ({"sizes": [8.5]}, r"search.sizes must be a positive whole number, got 8.5"),
        ({"sizes": ["a"]}, r"search.sizes must be a positive whole number, got 'a'"),
        ({"channels": "all"}, r"search.channels must be a list in brackets, got 'all'"),
        ({"hops_ms": [5.0, -1.0]}, r"search.hops_ms must be a positive finite number, got -1"),
        ({"hops_ms": [None]}, r"search.hops_ms must be a positive finite number, got None"),
        ({"penalties": [1.0, 0]}, r"search.penalties must be a positive finite number, got 0"),
        ({"penalties": ["x"]}, r"search.penalties must be a positive finite number, got 'x'"),
        ({"penalties": [float("inf")]}, r"search.penalties must be a .* finite number, got inf"),
        ({"bins": 0}, r"search.bins must be a positive whole number, got 0"),
        ({"calls": True}, r"search.calls must be a positive whole number, got True"),
        ({"cost_power": -1}, r"search.cost_power must be a finite number of at least 0, got -1"),
        ({"alpha": "a"}, r"search.alpha must be a finite number of at least 0, got 'a'"),
        ({"alpha": 1.5}, r"search.alpha must be at most 1, got 1.5"),
        ({"drop_fingers": None}, r"search.drop_fingers must be true or false, got None"),
        ({"degrees": [3]}, r"search.degrees must be of 1 and 2, got \[3\]"),
        ({"statistics": "mean"}, r"search.statistics must be a list in brackets, got 'mean'"),
        ({"statistics": ["mean"]}, r"search.statistics must be lists of some of mean, std"),
        ({"statistics": [["mean", "mode"]]}, r"search.statistics must be lists of some of mean"),
        ({"statistics": [[]]}, r"search.statistics must be lists of some of mean, std"),
        ({"pooled_sizes": [0]}, r"search.pooled_sizes must be a positive whole number, got 0"),
        ({"pooled_sizes": []}, r"search.pooled_sizes is empty"),
        ({"pooled_components": ["cheap"]}, r"search.pooled_components: unknown 'cheap'"),
    ],
)
def test_what_cannot_be_searched_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        Search(**(SMALL | changes))


def test_an_empty_selection_is_named():
    made = searcher(sizes=[500], channels=["gauges"])
    with pytest.raises(ValueError, match=r"an empty selection: no group .*=\['gauges'\]"):
        made.candidates()


# What is found ---------------------------------------------------------------------------------


def test_every_group_ranking_head_and_size_is_there_once(searched):
    _, candidates = searched
    groups = {("all", "all"), ("all", "time"), ("films", "all"), ("films", "time")}
    groups.add(("gauges", "all"))  # a gauge has no spectra: gauges in time are the same again
    candidates = [c for c in candidates if c.columns == "channel"]
    met = [(c.channels, c.components, c.ranking, c.degree, len(c.selected)) for c in candidates]
    expected = itertools.product(groups, SMALL["rankings"], (1, 2), (3, 6))
    assert sorted(met) == sorted((*group, *rest) for group, *rest in expected)
    names = FeaturePool(SMALL_HAND).names
    for each in candidates:
        assert each.selection.pooling is None
        chosen = [names[index] for index in each.selected]
        if each.channels == "films":
            assert {name.channel for name in chosen} == {"PVDF1"}
        if each.components == "time":
            assert {name.domain for name in chosen} == {"time"}
        # frames of 51 and 11 samples, half of them behind a sample
        with_gauge = any(name.channel == "SG1" for name in chosen)
        assert each.latency.look_ahead_ms == (12.5 if with_gauge else 2.5)
        assert (each.latency.bin_ms, each.latency.hop_ms) == (50.0, 5.0)


def test_t_ranks_as_the_t_test(searched):
    made, candidates = searched
    scores = t_scores(made.surveys["centred"].moments)
    expected = tuple(rank_features(scores, 6).tolist())
    found = [c for c in candidates if (c.ranking, c.channels, c.components) == ("t", "all", "all")]
    assert {c.selected for c in found} == {expected, expected[:3]}


@pytest.mark.parametrize("degree", [1, 2])
def test_a_score_is_that_of_machines_that_never_met_the_material(searched, degree):
    made, candidates = searched
    (found,) = [
        c
        for c in candidates
        if (c.channels, c.components, c.ranking, c.degree) == ("films", "all", "t", degree)
        and len(c.selected) == 6
    ]
    survey = made.surveys["centred"]
    sample = survey.sample.bins()
    z = scaled_selection(RECIPE, survey, found.selected)(sample.features)
    weights = sample_weight(RECIPE, sample)
    by_penalty = {}
    for penalty in SMALL["penalties"]:
        scores = []
        for index in range(len(sample.group_names)):
            out = sample.group == index
            training = TrainingBins(z[~out], sample.is_slip[~out], weights[~out])
            head = fit_machine(training, penalty, Polynomial(degree, 0.5))
            scores.append(balanced_accuracy(head(z[out]) >= 0, sample.is_slip[out]))
        by_penalty[penalty] = scores
    best = max(by_penalty, key=lambda penalty: sum(by_penalty[penalty]))
    assert found.balanced_accuracy == pytest.approx(sum(by_penalty[best]) / 3)
    assert list(found.by_group.values()) == pytest.approx(by_penalty[found.penalty])


def test_the_number_of_threads_changes_nothing(searched):
    made, candidates = searched
    torch.set_num_threads(2)
    try:
        assert described(made.candidates()) == described(candidates)
    finally:
        torch.set_num_threads(1)


def test_test_cycles_teach_nothing():
    fold = seen6(SmallSet().ids, seen=["a", "b", "c"])[0]
    loud = SmallSet(gains=dict.fromkeys(fold.having("test"), 9.0))
    few = {"rankings": ["t"], "channels": ["all"], "components": ["all"], "degrees": [2]}
    quiet = described(searcher(**few).candidates())
    assert described(searcher(loud, **few).candidates()) == quiet
    loud = SmallSet(gains=dict.fromkeys(fold.having("train")[:3], 9.0))
    assert described(searcher(loud, **few).candidates()) != quiet


def test_pooled_candidates_of_every_group_size_and_degree(searched):
    _, candidates = searched
    pooled = [c for c in candidates if c.columns != "channel"]
    met = [(c.channels, c.ranking, c.degree) for c in pooled]
    sized = [("none", 1), ("none", 2), ("gd", 1), ("gd", 2)]
    expected = [(channels, *of) for channels in ("all", "films", "gauges") for of in sized]
    assert sorted(met) == sorted(expected)
    for each in pooled:
        assert (each.columns, each.components) == ("pooled mean", "moments")
        names = each.selection.pooling.names
        assert len(names) == each.selection.size == each.selection.pooling.knee.numel()
        kinds = {name.channel for name in names}
        assert kinds <= {"all": {"SG", "PVDF"}, "films": {"PVDF"}, "gauges": {"SG"}}[each.channels]
        assert not {name.descriptor for name in names} & {"mode", "cv", "entropy", "median", "iqr"}
        assert each.selection.size == 4 or each.ranking == "none"


def test_a_pooled_score_is_that_of_everything_learned_without_the_material(searched):
    made, candidates = searched
    (found,) = [
        c
        for c in candidates
        if (c.channels, c.ranking, c.degree) == ("films", "none", 1) and c.columns != "channel"
    ]
    sample = made.surveys["centred"].sample.bins()
    weights = sample_weight(RECIPE, sample)
    place = {name: index for index, name in enumerate(made.pool.names)}
    names = [
        name
        for name, inside in zip(
            made.pool.names, allowed(SMALL_HAND, made.pool.names, "films", "moments"), strict=True
        )
        if inside
    ]
    features = sample.features[:, [place[name] for name in names]].double()
    expected = []
    for index in range(len(sample.group_names)):
        out = sample.group == index
        layer = ChannelPooling.fit(SMALL_HAND, names, features[~out], ["mean"])
        columns = layer(features[:, [names.index(name) for name in layer.inputs]])
        scaler = FeatureScaler.fit(columns[~out], compress=True, tail=0.01)
        z = scaler(columns)
        training = TrainingBins(z[~out], sample.is_slip[~out], weights[~out])
        head = fit_machine(training, found.penalty, Polynomial(1, FREE_CONSTANT))
        expected.append(balanced_accuracy(head(z[out]) >= 0, sample.is_slip[out]))
    assert list(found.by_group.values()) == pytest.approx(expected)
    assert found.balanced_accuracy == pytest.approx(sum(expected) / 3)


def test_pooled_compute_is_of_all_channels_and_of_pooling():
    made = searcher(**POOLED, rankings=["t"], components=["all"], channels=["films"])
    flat = made.candidates()
    made.costs = replace(made.costs, pooling_us=100.0, pooling_of_one_us=1.0)
    for before, after in zip(flat, made.candidates(), strict=True):
        num_pooled = len(after.selected) if after.columns != "channel" else 0
        more = 2.0 * (100 + num_pooled) if num_pooled else 0.0  # p99 is twice the median here
        assert after.latency.compute_us - before.latency.compute_us == pytest.approx(more)
        if num_pooled:
            assert set(after.selected) == {
                made.pool.names.index(name) for name in after.selection.pooling.inputs
            }


def test_fingers_are_dropped_from_the_best_on():
    made = searcher(rankings=["t"], components=["all"])
    gauge, film = SMALL_HAND.channels
    made.pool = FeaturePool(HandLayout((gauge, replace(film, finger="thumb"))))
    candidates = made.candidates()
    best = next(c for c in candidates if c.channels == "all" and c.degree == 2)
    best = best._replace(selection=frame_of((0, 100)))
    found = made.without_fingers(best)
    assert {c.channels for c in found} == {"all without index", "all without thumb"}
    of_film = next(c for c in candidates if c.channels == "films" and len(c.selected) == 6)
    without = [c for c in found if c.channels == "all without index" and len(c.selected) == 6]
    assert without[0].selected == of_film.selected
    alone = best._replace(selection=frame_of((0,)))
    assert made.without_fingers(alone) == []


def test_each_finger_goes_that_is_missed_least(monkeypatch):
    made = searcher(rankings=["t"], components=["all"])
    made.pool = FeaturePool(HAND)
    made._channel_of = [HAND.names.index(name.channel) for name in made.pool.names]
    worth = {"little": 0.01, "ring": 0.3, "middle": 0.02, "index": 0.2, "thumb": 0.1}

    def played(align, channels, components, mask, ranking, degrees):
        gone = channels.split(" without ")[1].split(" and ")
        inside = {
            HAND.channel(n.channel).finger for n, m in zip(made.pool.names, mask, strict=True) if m
        }
        assert inside == set(worth) - set(gone)
        assert degrees == [2]
        return [candidate(60.0, 100.0, 0.9 - sum(worth[finger] for finger in gone))]

    monkeypatch.setattr(made, "_scored", played)
    one_of_each = [made._channel_of.index(channel) for channel in (0, 3, 6, 9, 12)]
    best = candidate(60.0, 100.0, 0.9)._replace(selection=frame_of(one_of_each))
    found = made.without_fingers(best)
    assert len(found) == 5 + 4 + 3 + 2
    kept = [max(c.balanced_accuracy for c in part) for part in (found[:5], found[5:9], found[9:12])]
    assert kept == pytest.approx([0.89, 0.87, 0.77])  # little, then middle, then the thumb


# The front -------------------------------------------------------------------------------------


def test_the_front_is_what_nothing_beats(rng):
    points = rng.integers(0, 6, (80, 3)).tolist()
    kept = nondominated(points)

    def beats(a, b):
        return all(x <= y for x, y in zip(a, b, strict=True)) and a != b

    expected = [
        i
        for i, own in enumerate(points)
        if not any(beats(other, own) for other in points) and own not in points[:i]
    ]
    assert kept == expected
    assert nondominated([]) == []


def frame_of(selected):
    ends = torch.ones(len(selected))
    return FeatureSelection(tuple(selected), FeatureScaler(-ends, ends))


def candidate(worst_ms, compute_us, accuracy, size=50):
    latency = Latency(worst_ms - 55 - compute_us / 1000, 50.0, 5.0, compute_us)
    frame = frame_of(range(size))
    about = "centred", "all", "all", "channel", "t", 2, 0.1
    return Candidate(*about, frame, accuracy, {}, latency)


WIDE = Limits(1000.0, 1e6, [5.0])
NONE = Limits(1.0, 1.0, [5.0])


def test_landmarks_are_the_best_the_cheap_and_the_small():
    def timed(accuracy, us, size):
        made = candidate(60.0, us, accuracy, size)
        return Timed(made, "double", Timing(us, us, us, 20), made.latency, us)

    def found(*rows):
        return list(landmarks(rows).values())

    best, third, poor = timed(0.99, 300.0, 100), timed(0.981, 100.0, 60), timed(0.979, 10.0, 30)
    few, fewer = timed(0.95, 200.0, 20), timed(0.94, 90.0, 8)
    assert found(poor, few, third, best, fewer) == [best, third, few]
    assert found(poor, few, best) == [best, None, few]
    assert found(best, third, poor) == [best, third, None]
    quick = timed(0.99, 200.0, 100)  # of the same accuracy: the quickest
    assert found(best, quick, third) == [quick, None, None]
    assert found() == [None, None, None]


def test_the_best_of_each_group_and_of_few_numbers_may_be_named():
    made = [candidate(60.0, 100.0, accuracy) for accuracy in (0.8, 0.9, 0.7)]
    pooled = [each._replace(columns="pooled mean") for each in made]
    time = [each._replace(components="time") for each in pooled[:1]]
    few = [candidate(60.0, 100.0, accuracy, size=20) for accuracy in (0.4, 0.5)]
    assert worth_naming([*made, *pooled, *time, *few]) == [made[1], pooled[1], time[0], few[1]]


def test_worth_timing_goes_by_layers():
    line = [candidate(60.0 + i, 100.0 * (i + 1), 0.5 + 0.04 * i) for i in range(10)]
    behind = [candidate(60.5 + i, 110.0 * (i + 1), 0.45 + 0.04 * i) for i in range(10)]
    assert worth_timing([*behind, *line], 10, NONE) == line
    more = worth_timing([*behind, *line], 13, NONE)
    assert more[:10] == line
    # the most accurate, then a spread of the rest by compute
    assert more[10:] == [behind[9], behind[0], behind[8]]
    assert worth_timing([*behind, *line], 4, NONE) == [line[9], line[0], line[4], line[8]]
    assert worth_timing(line, 1, WIDE) == [line[9]]
    assert worth_timing(line[:2] * 2, 30, WIDE) == line[:2] * 2
    # all near: half by accuracy, the rest spread
    assert worth_timing(line, 6, WIDE) == [line[9], line[8], line[7], line[0], line[3], line[6]]


def test_what_is_close_to_the_limits_is_timed(rng):
    """Two filters: the quick one waits longer, so accuracy does not rise with compute."""
    line = [candidate(61.0, 100.0 + 10 * i, 0.8 - 0.001 * (39 - i)) for i in range(40)]
    line += [candidate(59.0, 500.0 + 10 * i, 0.6 + 0.001 * i) for i in range(40)]
    limits = Limits(80.0, 300.0, [5.0])
    for _ in range(3):
        given = [line[i] for i in rng.permutation(80)]
        assert len(nondominated([each.point for each in given])) == 80
        timed = worth_timing(given, 10, limits)
        assert len({each.point for each in timed}) == 10
        # 450 us and 300 us at most, then 200 us, best first: the model may err either way
        compute = [each.latency.compute_us for each in timed]
        assert compute[:5] == [490.0, 450.0, 300.0, 200.0, 440.0]
        assert {100.0, 890.0} < set(compute)  # the cheapest and the dearest
        assert max(each.balanced_accuracy for each in line) == timed[0].balanced_accuracy


def test_look_ahead_is_that_of_the_filter():
    made = searcher(channels=["gauges"], rankings=["t"], degrees=[1], sizes=[3])
    made.filters = {"centred": ChannelFilter([51, 11], align="causal")}
    assert {c.latency.look_ahead_ms for c in made.candidates()} == {0.0}

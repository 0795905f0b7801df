"""Recordings in and out of a detector's sums: held to refits, and as before on the way back."""

import copy
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tactslip_torch.features.bin_sample import BinSample
from tactslip_torch.model.fit import TrainingBins, fit_machine
from tactslip_torch.model.kernels import Polynomial
from tactslip_torch.model.moments import SufficientStats
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.training import adaptation as steps
from tactslip_torch.training.adaptation import (
    _OF_MARGIN,
    _OF_ONE,
    FACTORS,
    AccuracyChange,
    _class_scales,
    accepted,
    accuracies,
    add,
    compare,
    forget,
    mean_recall,
    solve,
    undo,
)
from tactslip_torch.training.fitting import is_kept
from tactslip_torch.training.recipe import FeatureSelection, Recipe
from tactslip_torch.training.selection import Plan
from tactslip_torch.training.statistics import (
    KnownBins,
    Machine,
    RecordingBins,
    Statistics,
)

K, NUM_BINS = 3, 24
MACHINE = Machine(0.05, 0.5, "weights")


def recording(material, seed, num_bins=NUM_BINS, turn=0.0):
    """Bins whose class hangs on the first feature or, as far as ``turn`` says, on the second."""
    rng = np.random.default_rng(seed)
    z = torch.from_numpy(rng.uniform(-1, 1, (num_bins, K)))
    told = (1 - turn) * z[:, 0] + turn * z[:, 1] + 0.4 * z[:, 0] * z[:, 2]
    is_slip = told + 0.2 * torch.from_numpy(rng.standard_normal(num_bins)) > -0.3
    return RecordingBins(material, z, is_slip, f"{material} {seed}")


def recordings(material, number, first_seed, turn=0.0):
    return {
        f"{material}/{i}": recording(material, first_seed + i, turn=turn) for i in range(number)
    }


def statistics(trained):
    """Of recordings whose bins are all rehearsal."""
    sums = SufficientStats(K)
    for name, own in trained.items():
        sums.update(name, own.z, own.is_slip)
    sizes = torch.tensor([len(own.z) for own in trained.values()])
    ones = torch.ones(int(sizes.sum()), dtype=torch.float64)
    rehearsal = KnownBins(
        torch.cat([own.z for own in trained.values()]),
        torch.cat([own.is_slip for own in trained.values()]),
        ones,
        ones,
        torch.arange(len(trained)).repeat_interleave(sizes),
        tuple(trained),
        tuple(own.material for own in trained.values()),
    )
    return Statistics(sums, MACHINE, {"bin_ms": 50.0}, rehearsal, "digest", {}, {})


@pytest.fixture(scope="module")
def trained():
    return recordings("a", 4, 0) | recordings("b", 4, 10) | recordings("c", 4, 20, turn=0.1)


@pytest.fixture(scope="module")
def old(trained):
    return statistics(trained)


@pytest.fixture(scope="module")
def new():
    return recordings("new", 3, 100, turn=1.0)


def fitted(bins, weights, scales):
    """The machine of bins at given weights, by another route: from a matrix of bins by bins."""
    z = torch.cat([own.z for own in bins])
    is_slip = torch.cat([own.is_slip for own in bins])
    sizes = torch.tensor([len(own.z) for own in bins])
    weight = torch.tensor(weights, dtype=torch.float64).repeat_interleave(sizes)
    training = TrainingBins(z, is_slip, weight * scales[is_slip.long()])
    return fit_machine(training, MACHINE.penalty, Polynomial(2, MACHINE.offset), route="dual")


def test_a_known_bin_scores_as_by_the_machine_refitted_without_its_recording(old, trained, new):
    after = old.reweighed(dict.fromkeys(new, 2.5), new)
    solved, scales = solve(after), _class_scales(after.sums, MACHINE)
    everyone = trained | new
    for name in ("b/2", "new/1"):
        others = [own for other, own in everyone.items() if other != name]
        weights = [2.5 if other in new else 1.0 for other in everyone if other != name]
        expected = fitted(others, weights, scales)(everyone[name].z)
        found = solved.scores[solved.known.of_recordings([name])]
        torch.testing.assert_close(found, expected, rtol=1e-8, atol=1e-9)


def test_added_recordings_are_in_the_machine_with_their_weight(old, trained, new):
    after = old.reweighed(dict.fromkeys(new, 7.0), new)
    scales = _class_scales(after.sums, MACHINE)
    bins, weights = [*trained.values(), *new.values()], [1.0] * len(trained) + [7.0] * len(new)
    z = recording("any", 5).z
    expected = fitted(bins, weights, scales)(z)
    torch.testing.assert_close(solve(after).head(z), expected, rtol=1e-8, atol=1e-9)
    total = sum(w * float(own.is_slip.sum()) for own, w in zip(bins, weights, strict=True))
    assert float(after.sums.weight[1]) == pytest.approx(total, rel=1e-9)


def assert_same_sums(one, other, weight=1.0):
    """To what float64 keeps of bins beside some of this weight."""
    found, expected = one.sums.sums, other.sums.sums
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-12 * max(1.0, weight))


@pytest.mark.parametrize("weight", [0.3, 1.0, 31.9, 3000.0])
def test_what_is_weighed_anew_goes_out_again(old, new, weight):
    there = old.reweighed(dict.fromkeys(new, weight), new)
    assert not torch.equal(there.sums.sums, old.sums.sums)
    back = there.reweighed(dict.fromkeys(new, 0.5)).reweighed(dict.fromkeys(new, 0.0))
    assert_same_sums(back, old, weight)
    assert torch.equal(back.sums.count, old.sums.count)
    assert back.sums.seen_batches == old.sums.seen_batches


def assert_same_statistics(one, other):
    """Of all that a file of them says, sums are those to rounding and the rest to the bit."""
    assert_same_sums(one, other)
    with tempfile.TemporaryDirectory() as folder:
        same = [replace(each, sums=other.sums) for each in (one, other)]
        for number, each in enumerate(same):
            each.save(Path(folder) / str(number))
        assert (Path(folder) / "0").read_bytes() == (Path(folder) / "1").read_bytes()
    assert one.sums.seen_batches == other.sums.seen_batches


def test_an_undone_step_leaves_no_trace(old, trained, new, tmp_path):
    file = torch.arange(5, dtype=torch.uint8)
    change = add(old, solve(old), new, 2.0, margin=1.0)
    first = accepted(old, change, {"action": "add"}, file, "one")
    gone = {"b/1": trained["b/1"], "new/0": new["new/0"]}
    second = accepted(
        first, forget(first, solve(first), gone), {"action": "forget"}, file + 1, "two"
    )
    second.save(tmp_path / "second")
    back, found = undo(Statistics.load(tmp_path / "second"))
    assert torch.equal(found, file + 1)
    assert_same_statistics(back, first)
    back, found = undo(back)
    assert torch.equal(found, file)
    assert_same_statistics(back, old)
    with pytest.raises(ValueError, match="nothing to undo"):
        undo(back)


def test_undo_finds_what_was_there_before_a_recording_came_back_with_other_bins(old, tmp_path):
    wood = recording("wood", 60)
    quiet = replace(wood, z=wood.z[~wood.is_slip], is_slip=wood.is_slip[~wood.is_slip])
    file, states = torch.arange(5, dtype=torch.uint8), [old]
    for step in (
        lambda at: add(at, solve(at), {"wood/0": wood}, 2.0, margin=1.0),
        lambda at: forget(at, solve(at), {"wood/0": wood}),
        lambda at: add(at, solve(at), {"wood/0": quiet}, 3.0, margin=1.0),
    ):
        states.append(accepted(states[-1], step(states[-1]), {}, file, f"{len(states)}"))
    states[-1].save(tmp_path / "last")
    at = Statistics.load(tmp_path / "last")
    for state in reversed(states[:-1]):
        at, _ = undo(at)
        assert_same_statistics(at, state)


@pytest.mark.parametrize(("num_bins", "weight"), [(1, 2.0), (1, 5000.0), (3, 5000.0)])
def test_a_lone_bin_and_a_heavy_one_come_in_and_go_out(old, num_bins, weight):
    few = RecordingBins("few", recording("few", 61).z[:num_bins], torch.arange(num_bins) == 0)
    there = old.reweighed({"few/0": weight}, {"few/0": few})
    assert float(there.sums.weight.sum() - old.sums.weight.sum()) == pytest.approx(
        num_bins * weight
    )
    back = there.reweighed({"few/0": 0.0})
    assert_same_sums(back, old, weight)


def test_forgetting_is_as_if_it_was_never_in(old, trained):
    others = {name: own for name, own in trained.items() if own.material != "c"}
    mine = {name: own for name, own in trained.items() if own.material == "c"}
    found = forget(old, solve(old), mine)
    assert_same_sums(found.statistics, statistics(others))
    assert sorted(found.old.after) == ["a", "b"]


def test_only_what_was_put_in_can_be_taken_out(old, trained):
    other = replace(trained["a/1"], z=trained["a/2"].z)
    with pytest.raises(ValueError, match="other content"):
        forget(old, solve(old), {"a/1": other})
    with pytest.raises(ValueError, match="d/1 is not in"):
        forget(old, solve(old), {"d/1": trained["a/1"]})


def test_auto_takes_the_largest_weight_that_old_materials_allow(old, new):
    before = solve(old)
    found = add(old, before, new, None, margin=0.1)
    chosen = found.factor
    assert found.tried[chosen] == found.old.mean_fall
    assert found.old.problem(_OF_MARGIN * 0.1) is None
    (next_larger,) = [f for f in FACTORS if f > chosen][:1]
    by_hand = add(old, before, new, found.weight * next_larger / chosen, margin=0.1)
    assert by_hand.old.problem(_OF_MARGIN * 0.1) is not None
    assert found.weight * 3 * NUM_BINS == pytest.approx(chosen * 4 * NUM_BINS)


def test_where_nothing_is_allowed_auto_tries_the_smallest_weight(old, new):
    found = add(old, solve(old), new, None, margin=0.0)
    assert min(found.tried) == found.factor == FACTORS[0]
    assert found.weight * 3 * NUM_BINS == pytest.approx(FACTORS[0] * 4 * NUM_BINS)


def test_auto_passes_by_weights_that_lead_to_no_machine(old, new, monkeypatch):
    def solved(statistics):
        if statistics.weight_of("new/0") > most:
            raise ValueError("no machine")
        return solve(statistics)

    before, unit = solve(old), 4 * NUM_BINS / (3 * NUM_BINS)
    monkeypatch.setattr(steps, "solve", solved)
    for largest in (FACTORS[0], FACTORS[2]):
        most = 1.01 * largest * unit
        found = add(old, before, new, None, margin=0.9)
        assert found.factor == max(found.tried) == largest
    most = 0.0
    with pytest.raises(ValueError, match="no machine"):
        add(old, before, new, None, margin=0.9)


def test_small_steps_together_keep_the_margin(old):
    at, before, falls = old, solve(old), []
    first = before
    for number in range(6):
        more = recordings(f"new{number}", 2, 200 + 10 * number, turn=1.0)
        change = add(at, before, more, 1.0, margin=1.0)
        assert change.since_training.before == {
            n: accuracies(first, first.known.recordings)[n] for n in "abc"
        }
        assert change.since_training.after == {n: change.old.after[n] for n in "abc"}
        falls.append((change.old.mean_fall, change.since_training.mean_fall))
        entry = {"old": change.old.to_dict()}
        at = accepted(at, change, entry, torch.zeros(1, dtype=torch.uint8), f"{number}")
        before = change.solved
    step, together = falls[-1]
    assert together > 2 * step
    margin = (step + together) / 2
    assert change.old.problem(margin) is None
    assert change.problem(margin).startswith("since before the first step, ")


def test_a_new_material_is_learned_and_later_ones_share_its_weight(old, new):
    before = solve(old)
    found = add(old, before, new, 4.0, margin=1.0)
    assert found.new["after"] > found.new["before"] + 0.1
    more = {"new/7": recording("new", 107, turn=1.0)}
    later = add(found.statistics, found.solved, more, 2.0, margin=1.0)
    assert dict(later.statistics.weights) == dict.fromkeys([*new, *more], 2.0)
    assert later.new["after"] is None  # nothing else of this recording tells
    assert "new" in later.old.before


def test_bins_without_slip_alone_weigh_as_those_of_an_average_material(old, trained):
    quiet = recording("quiet", 50)
    quiet = replace(quiet, z=quiet.z[~quiet.is_slip], is_slip=quiet.is_slip[~quiet.is_slip])
    found = add(old, solve(old), {"quiet/0": quiet}, None, margin=0.0)
    num_quiet = sum(int((~own.is_slip).sum()) for own in trained.values()) / 3
    assert found.weight * len(quiet.z) / num_quiet in [pytest.approx(f) for f in found.tried]


@pytest.mark.parametrize(
    ("bins", "weight", "message"),
    [
        (recordings("d", 1, 0) | recordings("e", 1, 0), 1.0, "one material at a time, got d, e"),
        (recordings("a", 1, 0), 1.0, "a/0 is in already"),
        ({"d/0": recording("d", 0, num_bins=0)}, 1.0, "no labelled bin"),
        (recordings("d", 1, 0), -1.0, "weight must be auto or a positive number"),
        (recordings("d", 1, 0), float("nan"), "weight must be auto or a positive number"),
        ({}, 1.0, "no labelled bin"),
    ],
)
def test_what_cannot_be_added_is_refused(old, bins, weight, message):
    with pytest.raises(ValueError, match=message):
        add(old, solve(old), bins, weight, margin=0.1)


def test_a_change_of_accuracy_names_what_falls():
    same = {"a": 0.9, "b": 0.8}
    assert AccuracyChange(same, same).problem(0.0) is None
    mean = AccuracyChange(same, {"a": 0.88, "b": 0.8}).problem(0.005)
    assert mean.startswith("old materials fall from 85.00 to 84.00 %")
    one = AccuracyChange(same | {"c": 0.7}, {"a": 0.95, "b": 0.75, "c": 0.7}).problem(
        0.04 / _OF_ONE
    )
    assert one.startswith("b falls from 80.00 to 75.00 %")
    assert AccuracyChange(same, {"a": 0.88, "b": 0.8}).problem(0.0101) is None
    assert AccuracyChange({}, {}).problem(0.0) is None


def test_both_machines_are_compared_on_the_bins_that_both_know(old, new):
    before = solve(old)
    found = compare(before, add(old, before, new, 1.0, margin=1.0).solved)
    assert sorted(found.before) == sorted(found.after) == ["a", "b", "c"]
    known = before.known
    mine = known.material == known.material_names.index("b")
    assert found.before["b"] == mean_recall(before.scores[mine] >= 0, known.is_slip[mine])


def test_mean_recall_is_balanced_accuracy_or_that_of_the_one_class():
    truth = torch.tensor([True, True, True, False])
    assert mean_recall(torch.tensor([True, False, True, False]), truth) == pytest.approx(5 / 6)
    assert mean_recall(truth, ~torch.zeros(4, dtype=torch.bool)) == pytest.approx(3 / 4)


def test_known_bins_give_way_to_all_bins_of_a_recording_that_is_taken_out(old, trained, new):
    weights = {"a/0": 0.0} | dict.fromkeys(new, 3.0)
    known = old.rehearsal.with_others({"a/0": trained["a/0"]} | new, weights)
    assert not bool(known.of_recordings(["a/0"]).any())
    assert set(known.weight[known.of_recordings(new)].tolist()) == {3.0}
    assert len(known.z) == (len(trained) - 1 + len(new)) * NUM_BINS
    assert known.material_names == ["a", "b", "c", "new"]
    names = [known.recordings[i] for i in known.recording.tolist()]
    materials = [known.material_names[i] for i in known.material.tolist()]
    assert all(name.startswith(f"{of}/") for name, of in zip(names, materials, strict=True))


def test_known_bins_are_bins_that_were_trained_on_under_undersampling(rng):
    ends = torch.zeros(2).double(), torch.ones(2).double()
    selection, zeros = FeatureSelection((0, 2), FeatureScaler(*ends)), torch.zeros(2)
    plan = Plan(Recipe(), selection, Polynomial(2, 0.5), 1.0, (1.0, 0.4), 1.0, 60, zeros)
    sample, kept = BinSample(30), {}
    for name in ("m/0", "m/1"):
        features = torch.from_numpy(rng.uniform(0, 1, (40, 4))).float()
        is_slip = torch.arange(40) % 2 == 0
        sample.update(name, "m", features, is_slip)
        kept[name] = selection(features[is_kept(name, is_slip, plan.fractions)])
    found = KnownBins.of(plan, sample.bins(), {"m/0": "m", "m/1": "m"})
    for number, name in enumerate(found.recordings):
        rows = found.z[found.recording == number]
        in_training = (rows[:, None] == kept[name]).all(-1).any(-1)
        assert len(rows) > 0
        assert bool(in_training.all())
    num_slip = float(found.sample_weight[found.is_slip].sum())
    assert 0.5 < num_slip / sum(float(len(z) - 20) for z in kept.values()) < 2.0


def test_statistics_come_back_from_their_file_and_damage_is_noticed(old, new, tmp_path):
    there = replace(old.reweighed(dict.fromkeys(new, 2.0), new), labels={"layout": "whole_slide"})
    there.save(tmp_path / "statistics.pt")
    back = Statistics.load(tmp_path / "statistics.pt")
    assert back.machine == there.machine
    assert back.labels == there.labels
    assert torch.equal(solve(back).scores, solve(there).scores)
    content = bytearray((tmp_path / "statistics.pt").read_bytes())
    content[len(content) // 2] ^= 1
    (tmp_path / "statistics.pt").write_bytes(content)
    with pytest.raises(ValueError, match="damaged"):
        Statistics.load(tmp_path / "statistics.pt")


def test_nothing_that_is_given_is_changed(old, new):
    sums = copy.deepcopy(old.sums.sums)
    add(old, solve(old), new, None, margin=0.1)
    assert torch.equal(old.sums.sums, sums)
    assert not old.bins

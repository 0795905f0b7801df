"""Recordings in and out of a detector's sums: compared with refits, and undone."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tactslip_torch.model.fit import TrainingBins, fit_machine
from tactslip_torch.model.kernels import Polynomial
from tactslip_torch.model.moments import SufficientStats
from tactslip_torch.training import adaptation

K, NUM_BINS = 3, 24
MACHINE = adaptation.Machine(0.05, 0.5, "weights")


def recording(material, seed, num_bins=NUM_BINS, turn=0.0):
    """Bins whose class depends on the first feature or, as far as ``turn`` says, on the second."""
    rng = np.random.default_rng(seed)
    z = torch.from_numpy(rng.uniform(-1, 1, (num_bins, K)))
    level = (1 - turn) * z[:, 0] + turn * z[:, 1] + 0.4 * z[:, 0] * z[:, 2]
    is_slip = level + 0.2 * torch.from_numpy(rng.standard_normal(num_bins)) > -0.3
    return adaptation.RecordingBins(material, z, is_slip, f"{material} {seed}")


def recordings(material, number, first_seed, turn=0.0):
    return {
        f"{material}/{i}": recording(material, first_seed + i, turn=turn) for i in range(number)
    }


def statistics(trained):
    """Of recordings whose bins are all in the rehearsal sample."""
    sums = SufficientStats(K)
    for name, own in trained.items():
        sums.update(name, own.z, own.is_slip)
    z, is_slip = (
        torch.cat([getattr(own, n) for own in trained.values()]) for n in ("z", "is_slip")
    )
    ones = torch.ones(len(z), dtype=torch.float64)
    sizes = torch.tensor([len(own.z) for own in trained.values()])
    recording = torch.arange(len(trained)).repeat_interleave(sizes)
    materials = tuple(own.material for own in trained.values())
    rehearsal = adaptation.KnownBins(z, is_slip, ones, ones, recording, tuple(trained), materials)
    return adaptation.Statistics(sums, MACHINE, {"bin_ms": 50.0}, rehearsal, "digest")


TRAINED = recordings("a", 4, 0) | recordings("b", 4, 10) | recordings("c", 4, 20, turn=0.1)
NEW = recordings("new", 3, 100, turn=1.0)


@pytest.fixture(scope="module")
def old():
    return statistics(TRAINED)


@pytest.fixture(scope="module")
def before(old):
    return adaptation.solve(old)


def assert_same(one, other, folder, weight=1.0):
    """Sums to what float64 keeps of bins beside some of this weight, the rest to the bit."""
    tolerance = 1e-12 * max(1.0, weight)
    torch.testing.assert_close(one.sums.sums, other.sums.sums, rtol=0, atol=tolerance)
    assert torch.equal(one.sums.count, other.sums.count)
    assert one.sums.seen_batches == other.sums.seen_batches
    for name, each in (("one", one), ("other", other)):
        replace(each, sums=other.sums).save(folder / name)
    assert (folder / "one").read_bytes() == (folder / "other").read_bytes()


# Machines ----------------------------------------------------------------------------------------


def test_machine_and_scores_without_a_recording_are_those_of_refits(old):
    after = old.reweighed(dict.fromkeys(NEW, 2.5), NEW)
    solved, everyone = adaptation.solve(after), TRAINED | NEW
    scales = after.sums.class_scale(MACHINE.balance)

    def refitted_without(name, z):
        kept = {other: own for other, own in everyone.items() if other != name}
        is_slip = torch.cat([own.is_slip for own in kept.values()])
        weight = torch.cat([torch.full((NUM_BINS,), 2.5 if n in NEW else 1.0) for n in kept])
        weight = weight.double() * scales[is_slip.long()]
        bins = TrainingBins(torch.cat([own.z for own in kept.values()]), is_slip, weight)
        kernel = Polynomial(2, MACHINE.offset)
        return fit_machine(bins, MACHINE.penalty, kernel, route="dual")(z)

    z = recording("any", 5).z
    torch.testing.assert_close(solved.head(z), refitted_without(None, z), rtol=1e-8, atol=1e-9)
    for name in ("b/2", "new/1"):
        found = solved.scores[solved.known.of_recordings([name])]
        expected = refitted_without(name, everyone[name].z)
        torch.testing.assert_close(found, expected, rtol=1e-8, atol=1e-9)


def test_a_change_of_accuracy_names_what_falls():
    same = {"a": 0.9, "b": 0.8}
    assert adaptation.AccuracyChange(same, same).problem(0.0) is None
    assert adaptation.AccuracyChange({}, {}).problem(0.0) is None
    fall = adaptation.AccuracyChange(same, {"a": 0.88, "b": 0.8})
    assert fall.problem(0.0101) is None
    assert fall.problem(0.005).startswith("old materials fall from 85.00 to 84.00 %")
    of_one = adaptation.AccuracyChange(same | {"c": 0.7}, {"a": 0.95, "b": 0.75, "c": 0.7})
    assert of_one.problem(0.01).startswith("b falls from 80.00 to 75.00 %")  # four times as much


# In and out --------------------------------------------------------------------------------------


@pytest.mark.parametrize("weight", [0.3, 31.9, 5000.0])
@pytest.mark.parametrize("num_bins", [1, NUM_BINS])
def test_bins_go_out_as_they_came_in(old, num_bins, weight, tmp_path):
    own = recording("few", 61)
    few = {"few/0": replace(own, z=own.z[:num_bins], is_slip=own.is_slip[:num_bins])}
    there = old.reweighed({"few/0": weight}, few)
    added = float(there.sums.weight.sum() - old.sums.weight.sum())
    assert added == pytest.approx(num_bins * weight)
    back = there.reweighed({"few/0": 0.5}).reweighed({"few/0": 0.0})
    assert_same(replace(back, bins={}, weights={}), old, tmp_path, weight)


def test_forgetting_is_as_if_it_was_never_in(old, before, tmp_path):
    mine = {name: own for name, own in TRAINED.items() if own.material == "c"}
    others = {name: own for name, own in TRAINED.items() if own.material != "c"}
    found = adaptation.forget(old, before, mine)
    expected = statistics(others).sums
    torch.testing.assert_close(found.statistics.sums.sums, expected.sums, rtol=0, atol=1e-12)
    assert sorted(found.old.after) == ["a", "b"]
    with pytest.raises(ValueError, match="other content"):
        adaptation.forget(old, before, {"a/1": replace(TRAINED["a/1"], z=TRAINED["a/2"].z)})
    with pytest.raises(ValueError, match="d/1 is not in"):
        adaptation.forget(old, before, {"d/1": TRAINED["a/1"]})


def test_a_new_material_is_learned_and_later_recordings_share_its_weight(old, before):
    sums = old.sums.sums.clone()
    found = adaptation.add(old, before, NEW, 4.0, margin=1.0)
    assert torch.equal(old.sums.sums, sums)  # nothing that is given is changed
    assert not old.bins
    assert found.new["after"] > found.new["before"] + 0.1
    assert sorted(found.old.before) == ["a", "b", "c"]
    more = {"new/7": recording("new", 107, turn=1.0)}
    later = adaptation.add(found.statistics, found.solved, more, 2.0, margin=1.0)
    assert dict(later.statistics.weights) == dict.fromkeys([*NEW, *more], 2.0)
    assert later.new["after"] is None  # nothing else of this recording is known
    assert "new" in later.old.before


@pytest.mark.parametrize("margin", [0.1, 0.0])
def test_auto_takes_the_largest_weight_that_old_materials_allow(old, before, margin):
    found = adaptation.add(old, before, NEW, None, margin=margin)
    assert found.tried[found.factor] == found.old.mean_fall
    # a material has 4 recordings, the new one 3
    assert found.weight * 3 == pytest.approx(found.factor * 4)
    if margin == 0:
        assert min(found.tried) == found.factor == adaptation.FACTORS[0]
        return
    assert found.old.problem(0.5 * margin) is None
    larger = adaptation.FACTORS[adaptation.FACTORS.index(found.factor) + 1]
    by_hand = adaptation.add(old, before, NEW, found.weight * larger / found.factor, margin=margin)
    assert by_hand.old.problem(0.5 * margin) is not None


def test_bins_without_slip_weigh_as_those_of_an_average_material(old, before):
    own = recording("quiet", 50)
    quiet = replace(own, z=own.z[~own.is_slip], is_slip=own.is_slip[~own.is_slip])
    found = adaptation.add(old, before, {"quiet/0": quiet}, None, margin=0.0)
    num_quiet = sum(int((~own.is_slip).sum()) for own in TRAINED.values()) / 3
    assert found.weight * len(quiet.z) / num_quiet == pytest.approx(found.factor)


def test_small_steps_together_keep_the_margin(old, before):
    at, solved = old, before
    for number in range(6):
        more = recordings(f"new{number}", 2, 200 + 10 * number, turn=1.0)
        change = adaptation.add(at, solved, more, 1.0, margin=1.0)
        entry = {"old": {"before": change.old.before}}
        at = at.with_step(change.statistics, entry, torch.zeros(1, dtype=torch.uint8), f"{number}")
        solved = change.solved
    assert change.since_training.before == before.accuracies(before.known.recordings)
    assert change.since_training.after == {name: change.old.after[name] for name in "abc"}
    step, together = change.old.mean_fall, change.since_training.mean_fall
    assert together > 2 * step
    margin = (step + together) / 2
    assert change.old.problem(margin) is None
    assert change.problem(margin).startswith("since before the first step, ")


REFUSED = [
    (recordings("d", 1, 0) | recordings("e", 1, 0), 1.0, "one material at a time, got d, e"),
    (recordings("a", 1, 0), 1.0, "a/0 is in already"),
    ({"d/0": recording("d", 0, num_bins=0)}, 1.0, "no labelled bin"),
    ({}, 1.0, "no labelled bin"),
    (recordings("d", 1, 0), -1.0, "weight must be auto or a positive number"),
    (recordings("d", 1, 0), float("nan"), "weight must be auto or a positive number"),
]


@pytest.mark.parametrize(("bins", "weight", "message"), REFUSED)
def test_what_cannot_be_added_is_refused(old, before, bins, weight, message):
    with pytest.raises(ValueError, match=message):
        adaptation.add(old, before, bins, weight, margin=0.1)

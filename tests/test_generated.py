"""One seed decides what property tests see, and the summary line is right about it."""

import json

import generated
import pytest
import torch
from hypothesis import given, seed, settings
from hypothesis import strategies as st

from tactslip_torch.simulation.extremes import EXTREMES

DRAWN: list[int] = []


def make():
    return generated.make_batch(2**40 + 1, 40, 24, 100, torch.float64)


def draws(name):
    """What hypothesis draws by a seed."""
    drawn = []

    @seed(name)
    @settings(max_examples=6)
    @given(st.integers(0, 2**40))
    def collect(number):
        drawn.append(number)

    collect()
    return drawn


@settings(max_examples=6)
@given(number=st.integers(0, 2**40))
def test_draws_are_taken_down(number):
    DRAWN.append(number)


def test_the_seed_drives_hypothesis(request):
    if request.config.getoption("--hypothesis-seed", None) is not None:
        pytest.skip("hypothesis has a seed of its own")
    test = request.node.nodeid.replace(request.node.name, "test_draws_are_taken_down")
    assert len(DRAWN) == 6
    assert draws(f"{generated.SEED} {test}") == DRAWN
    assert draws(f"{generated.SEED + 1} {test}") != DRAWN


def test_the_seed_drives_the_bins(monkeypatch):
    batch = make()
    assert torch.equal(make().bins, batch.bins)
    assert make().kinds == batch.kinds
    monkeypatch.setattr(generated, "SEED", generated.SEED + 1)
    assert not torch.equal(make().bins, batch.bins)


def test_every_kind_stands_in_every_channel_beside_others():
    kinds = make().kinds
    assert {kind for row in kinds for kind in row} == set(EXTREMES)
    assert min(len(set(row)) for row in kinds) > 4


def test_the_same_bins_are_counted_once():
    make()
    before = generated.num_generated()
    make()
    assert generated.num_generated() == before
    generated.make_batch(2**40 + 1, 41, 24, 100, torch.float64)
    assert generated.num_generated() == before + 41


def test_bins_of_other_processes_count_as_if_made_here(monkeypatch):
    monkeypatch.setattr(generated, "_made", set())
    make()
    generated.make_batch(2**40 + 1, 40, 24, 100, torch.float32)
    elsewhere = json.loads(json.dumps(generated.told()))  # plain words, as they cross processes
    monkeypatch.setattr(generated, "_made", set())
    make()  # the same bins here and there are counted once
    generated.hear([tuple(of) for of in elsewhere])
    assert generated.num_generated() == 80
    generated.hear([])
    assert generated.num_generated() == 80


def test_blame_names_bin_feature_and_kind():
    batch = make()
    wrong = torch.zeros(40, 2, dtype=torch.bool)
    names, channels = ["SG1 raw time mean", "PVDF1 A1 time std"], {"SG1": 0, "PVDF1": 14}
    assert batch.blame(wrong, names, channels) == ""
    wrong[3, 1] = True
    assert batch.blame(wrong, names, channels) == (
        f"1 wrong; bin 3, PVDF1 A1 time std, {batch.kinds[3][14]}"
    )

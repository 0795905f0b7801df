"""Costs of columns: each part of the work is paid once, and selection by cost saves it."""

import ctypes
from collections import defaultdict

import pytest
import torch
from test_views import POOL as SMALL_POOL
from test_views import drawn

from tactslip_torch import FeaturePool, HandLayout, SlipDetector
from tactslip_torch.features.cost import MACHINES, WorkCosts
from tactslip_torch.features.descriptors import FeatureName
from tactslip_torch.features.selection import ColumnCosts, forward_selection
from tactslip_torch.native import _Matrix, reason_unavailable
from tactslip_torch.training.recipe import General

POOL = FeaturePool(HandLayout.paper24())
ONE = defaultdict(lambda: 1.0)  # every unit costs the same


def named(text):
    channel, component, domain, descriptor = text.split()
    return FeatureName(channel, component, domain, descriptor)


def kinds(parts):
    return sorted(part[0] for part in parts)


def test_a_set_pays_for_shared_parts_once():
    costs = WorkCosts(POOL, ONE, lanes=2)
    std, peak = (costs.parts(named(f"PVDF1 A2 freq {each}")) for each in ("std", "peak_factor"))
    alone = costs.cost([std])
    assert costs.cost([std, std]) == alone
    only = {part: amount for part, amount in peak.items() if part not in std}
    assert kinds(only) == ["peak_factor"]
    assert costs.cost([std, peak]) == alone + sum(only.values())
    # two channels are computed together, a third is not
    second, third = (costs.parts(named(f"PVDF{c} A2 freq std")) for c in (2, 3))
    assert second == std
    assert costs.cost([std, third]) == 2 * alone
    single = WorkCosts(POOL, ONE, lanes=1)
    each = [single.parts(named(f"PVDF{c} A2 freq std")) for c in (1, 2)]
    assert single.cost(each) == 2 * alone


def test_a_column_needs_what_lies_below_it():
    costs = WorkCosts(POOL, ONE, lanes=10)

    def products(text):
        return {part[3] for part in costs.parts(named(text)) if part[0] == "product"}

    assert products("PVDF1 D2 time std") == {"level 1", "level 2", "D2"}
    assert products("PVDF1 D2 freq std") == {"level 1", "level 2", "D2", "D2 lines"}
    below = {"A4 lines", "D4 lines", "D3 lines"}  # their sum is the spectrum of A2
    assert products("PVDF1 A2 freq std") == {"level 1", "level 2", "A2", *below}
    branches = [f"{kind}{m}" for m in range(1, 5) for kind in "AD"]
    everything = {*branches, *(f"level {m}" for m in range(1, 5)), "A4 lines"}
    everything |= {f"D{m} lines" for m in range(1, 5)}
    assert products("PVDF1 D1 freq band_energy_ratio") == everything
    assert not products("PVDF1 raw time rms")
    assert "sorted" in kinds(costs.parts(named("SG1 raw time median")))


def test_a_pooled_column_needs_every_channel_of_its_kind():
    costs = WorkCosts(POOL, ONE, lanes=4)
    own = costs.parts(FeatureName("PVDF", "D1", "time", "std", "max"))
    assert kinds(own).count("fast channel") == kinds(own).count("std") == 3  # 4, 4 and 2 channels
    assert own["pooled", FeatureName("PVDF", "D1", "time", "std")] == 10
    same = costs.parts(FeatureName("PVDF", "D1", "time", "std", "min"))
    assert same == own


def test_a_table_of_columns_says_what_the_parts_say():
    costs = WorkCosts.measured(POOL, "m7")
    columns = [FeatureName("PVDF", f"D{m}", "freq", "std", "max") for m in (1, 1, 2)]
    needs, price, own = costs.table(columns)
    assert float(needs.amax(0) @ price) == pytest.approx(costs.cost(map(costs.parts, columns)))
    assert float(needs[0] @ price) == pytest.approx(costs.cost([costs.parts(columns[0])]))
    assert own == costs.costs["scaled"]


@pytest.mark.skipif(bool(reason_unavailable()), reason="no native engine")
def test_products_are_those_of_the_engine():
    plan = POOL.engine(torch.float64).plan
    found = WorkCosts(POOL, ONE, 1)._products

    def multiplications(matrices, index):
        matrix = ctypes.cast(matrices, ctypes.POINTER(_Matrix))[index]
        return 8 * matrix.num_blocks * matrix.width

    for m in range(4):
        assert found[f"level {m + 1}"] == sum(
            multiplications(each, m) for each in (plan.low, plan.high)
        )
        for place, kind in enumerate("AD"):
            assert found[f"{kind}{m + 1}"] == multiplications(plan.out, 2 * m + place)
        assert found[f"D{m + 1} lines"] == multiplications(plan.lines, 2 * m + 1)


@pytest.mark.parametrize("machine", MACHINES)
def test_the_table_covers_every_part_of_the_default_bank(machine):
    costs = WorkCosts.measured(POOL, machine)
    detector = SlipDetector.pretrained()
    every = [*POOL.names, *detector.selected_names]
    whole = costs.decision(every, len(every), 1)
    assert {part[0] for part in whole} == set(costs.costs)
    assert min(costs.costs.values()) >= 0
    cheap, dear = (costs.cost([costs.parts(named(f"PVDF1 {row}"))])
                   for row in ("raw time range", "D4 freq band_energy_ratio"))  # fmt: skip
    assert 0 < 3 * cheap < dear < costs.cost([whole])


def test_of_columns_of_equal_gain_the_cheaper_is_taken(rng):
    signal, other = torch.from_numpy(rng.standard_normal((2, 200)))
    targets = (signal + 0.3 * other)[:, None]
    columns = torch.stack([signal, signal, other], 1)
    needs = torch.tensor([[1, 1, 0, 0], [0, 0, 1, 0], [0, 0, 1, 1]]).double()  # parts
    ones = torch.ones(200).double()

    def taken(*prices):
        costs = ColumnCosts(needs, torch.tensor(prices).double(), 0.1)
        return forward_selection(columns, targets, ones, 2, costs=costs)

    assert forward_selection(columns, targets, ones, 2) == [0, 2]
    assert taken(1, 1, 3, 1) == [0, 2]
    assert taken(2, 2, 3, 1) == [1, 2]
    # a column of less gain comes first where that is dear, and what it has paid for is free then
    assert taken(500, 500, 9, 1)[0] == 1
    assert taken(1, 1, 1000, 1e-3) == [0, 2]


def test_costs_decide_nothing_where_all_columns_cost_alike(rng):
    columns = torch.from_numpy(rng.standard_normal((100, 8)))
    targets = columns @ torch.from_numpy(rng.standard_normal((8, 1)))
    ones = torch.ones(100).double()
    alike = ColumnCosts(torch.eye(8).double(), 7 * torch.ones(8).double(), 0.5)
    assert forward_selection(columns, targets, ones, 5, costs=alike) == forward_selection(
        columns, targets, ones, 5
    )


def test_a_recipe_that_counts_costs_takes_a_cheaper_set():
    bins, costs = drawn(num=40, num_groups=3), WorkCosts.measured(SMALL_POOL, "m7")
    taken = {}
    for machine in (None, "m7"):
        recipe = General(views=["channel"], num_features=4, per_cost=machine)
        names = recipe.fit_classes(bins, SMALL_POOL).selection.column_names
        assert len(names) == 4
        taken[machine] = costs.cost([costs.parts(name) for name in names])
    assert taken["m7"] < taken[None]

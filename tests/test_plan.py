"""Plans: every feature wanted finds its row, and no row is there that nobody wants."""

import random
from collections import Counter

import pytest

from tactslip_torch.features.names import FeatureName, pool_names
from tactslip_torch.features.plan import Plan, Row, make_plan
from tactslip_torch.hand import HandLayout
from tactslip_torch.signals.wavelet import branch_names

HAND = HandLayout.paper24()
POOL = pool_names(HAND, 4)


def read_back(plan: Plan, level: int = 4) -> list[str]:
    """The features that a plan says it yields, by column."""
    columns: dict[int, str] = {}

    def put(place: int, row: Row, descriptor: str) -> None:
        assert place not in columns
        component = "raw" if row.kind == "gauge" else branch_names(level)[row.branch]
        domain = "freq" if row.kind == "freq" else "time"
        columns[place] = f"{HAND.names[row.channel]} {component} {domain} {descriptor}"

    for wanted in plan.wanted:
        put(wanted.place, plan.rows[wanted.row], wanted.descriptor)
    for share in plan.shares:
        put(share.place, Row("freq", share.channel, share.branch), "band_energy_ratio")
    return [columns[place] for place in range(plan.num_features)]


@pytest.mark.parametrize("seed", range(5))
def test_every_column_is_the_feature_asked_for(seed: int) -> None:
    names = random.Random(seed).sample(POOL, 60)
    assert read_back(make_plan(HAND, 4, names)) == [str(name) for name in names]


def test_the_whole_pool_has_a_row_for_each_gauge_branch_and_spectrum() -> None:
    plan = make_plan(HAND, 4, POOL)
    assert read_back(plan) == [str(name) for name in POOL]
    assert Counter(row.kind for row in plan.rows) == {"gauge": 14, "time": 80, "freq": 80}
    assert plan.channels == tuple(range(24))
    assert len(plan.shares) == 80


@pytest.mark.parametrize("seed", range(5))
def test_nothing_is_there_that_nobody_wants(seed: int) -> None:
    names = random.Random(seed).sample(POOL, 12)
    plan = make_plan(HAND, 4, names)
    assert {wanted.row for wanted in plan.wanted} == set(range(len(plan.rows)))
    assert {HAND.names[channel] for channel in plan.channels} == {name.channel for name in names}
    assert len(set(plan.rows)) == len(plan.rows)


def test_a_ratio_alone_needs_a_channel_and_no_row() -> None:
    plan = make_plan(HAND, 4, ["PVDF4 D3 freq band_energy_ratio"])
    assert plan.rows == ()
    assert plan.channels == plan.share_channels == (HAND.names.index("PVDF4"),)


def test_a_feature_asked_for_twice_comes_twice() -> None:
    names = ["SG2 raw time std", "SG2 raw time std"]
    plan = make_plan(HAND, 4, names)
    assert read_back(plan) == names
    assert len(plan.rows) == 1


def test_names_and_texts_mean_the_same() -> None:
    names = [FeatureName("PVDF1", "D1", "time", "correlation"), POOL[3]]
    assert make_plan(HAND, 4, names) == make_plan(HAND, 4, [str(name) for name in names])


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ([], "empty selection, expected at least one feature"),
        (["PVDF3 A9 freq kurtosis"], "unknown feature 'PVDF3 A9 freq kurtosis'"),
        (["SG1 raw time correlation"], "unknown feature 'SG1 raw time correlation'"),
    ],
)
def test_bad_selections_are_one_line(names: list[str], message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        make_plan(HAND, 4, names)
    assert "\n" not in str(caught.value)

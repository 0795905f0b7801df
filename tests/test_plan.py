"""Plans: no row is there that nobody wants, and what is no feature is refused."""

import random

import pytest

from tactslip_torch.features.bank import make_plan, pool_names
from tactslip_torch.features.names import FeatureName
from tactslip_torch.hand import HandLayout

HAND = HandLayout.paper24()
POOL = pool_names(HAND, 4)


@pytest.mark.parametrize("seed", range(3))
def test_nothing_is_there_that_nobody_wants(seed):
    names = random.Random(seed).sample(POOL, 12)
    plan = make_plan(HAND, 4, names)
    assert make_plan(HAND, 4, [str(name) for name in names]) == plan
    assert {wanted.row for wanted in plan.wanted} == set(range(len(plan.rows)))
    assert {HAND.names[channel] for channel in plan.channels} == {name.channel for name in names}
    assert len(set(plan.rows)) == len(plan.rows)


def test_a_ratio_needs_no_row_and_a_feature_asked_for_twice_one():
    ratio = FeatureName("PVDF4", "D3", "freq", "band_energy_ratio")
    plan = make_plan(HAND, 4, [ratio])
    assert plan.rows == ()
    assert plan.channels == plan.share_channels == (HAND.names.index("PVDF4"),)
    twice = make_plan(HAND, 4, ["SG2 raw time std"] * 2)
    assert (len(twice.rows), twice.num_features) == (1, 2)


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ([], "^an empty selection, expected at least one feature"),
        (["PVDF3 A9 freq kurtosis"], "^unknown feature 'PVDF3 A9 freq kurtosis'"),
        (["SG1 raw time correlation"], "^unknown feature 'SG1 raw time correlation'"),
    ],
)
def test_bad_selections_are_one_line(names, message):
    with pytest.raises(ValueError, match=message) as caught:
        make_plan(HAND, 4, names)
    assert "\n" not in str(caught.value)

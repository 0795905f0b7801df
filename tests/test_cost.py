"""The bill of a selection by hand, the fit against known prices, and the clock."""

import json

import pytest
import torch
from small_detector import HAND, small_detector

from tactslip_torch.analysis.latency import (
    GROUPS,
    CostModel,
    Timing,
    main,
    measure_costs,
    parts_of,
    time_calls,
    time_in_fresh_process,
)
from tactslip_torch.features.plan import make_plan
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.features.ranking import rank_per_cost
from tactslip_torch.runtime import one_thread
from tactslip_torch.signals.filtering import ChannelFilter

POOL = FeaturePool(HAND)


def parts(*names):
    return parts_of(make_plan(HAND, 4, names))


def model(**prices):
    """Every part of a group costs its prime, the group itself a thousand times that."""
    primes = dict(zip(GROUPS, (2, 3, 5, 7, 11, 13, 17, 19, 23, 29, 31), strict=True))
    part_us = {name: float(prime) for name, prime in primes.items()}
    group_us = {name: 1000.0 * prime for name, prime in primes.items()}
    return CostModel(0.5, group_us, part_us, 100.0, 0.5, 2.0, 0.0, **prices)


def priced(*groups):
    """The bill by hand: each group once, and so many of its parts."""
    price = model()
    return 0.5 + sum(price.group_us[name] + num * price.part_us[name] for name, num in groups)


@pytest.mark.parametrize(
    ("names", "bill"),
    [
        (["SG1 raw time mean"], [("gauges", 1), ("moments", 1), ("columns", 1)]),
        (["SG1 raw time mode"], [("gauges", 1), ("sorts", 1), ("columns", 1)]),
        (
            ["PVDF1 A2 time std", "PVDF1 A2 time median", "PVDF1 A2 time iqr"],
            [("films", 1), ("branches", 1), ("moments", 1), ("sorts", 1), ("columns", 3)],
        ),
        (
            ["PVDF1 A2 time correlation", "PVDF2 A2 time entropy"],
            [("films", 2), ("branches", 2), ("correlations", 1), ("histograms", 1), ("columns", 2)],
        ),
        (
            ["PVDF1 D4 freq spectral_centroid", "PVDF1 D4 freq spectral_spread"],
            [("films", 1), ("spectra", 1), ("lines", 1), ("columns", 2)],
        ),
        (
            ["PVDF1 A1 freq band_energy_ratio", "PVDF1 D3 freq band_energy_ratio"],
            [("films", 1), ("energies", 1), ("columns", 2)],
        ),
    ],
)
def test_shared_work_is_on_the_bill_once(names, bill):
    needed = parts(*names)
    assert len(needed) == len(names)
    assert model().features_us(set().union(*needed)) == pytest.approx(priced(*bill))


def test_compute_is_of_the_whole_call_at_its_tail():
    (needed,) = parts("SG1 raw time mean")
    found = model().compute_us(needed, 1)
    assert found == pytest.approx(2.0 * (model().features_us(needed) + 100.5))


def test_pooling_has_a_price_and_one_for_each_feature_it_reads():
    (needed,) = parts("SG1 raw time mean")
    price = model(pooling_us=40.0, pooling_of_one_us=0.25)
    assert price.compute_us(needed, 3) == pytest.approx(model().compute_us(needed, 3))
    more = 2.0 * (40.0 + 0.25 * 28)
    assert price.compute_us(needed, 3, 28) == pytest.approx(model().compute_us(needed, 3) + more)


def test_the_bill_for_a_ranking_adds_up_and_no_column_is_free():
    names = ["SG1 raw time mean", "PVDF1 A2 time median", "PVDF1 A2 time std"]
    needed = parts(*names)
    needs, prices = model().bill(needed)
    own = needs.long() @ prices
    of_column = 500  # ns of the rest for one more feature
    for row, place in zip(needed, own.tolist(), strict=True):
        alone = model().features_us(row) - model().base_us
        assert place == round(1000 * alone) + of_column
    together = int(prices[needs.any(0)].sum())
    whole = model().features_us(set().union(*needed)) - model().base_us
    assert together == round(1000 * whole) + 3 * of_column
    free = CostModel(0.0, dict.fromkeys(GROUPS, 0.0), dict.fromkeys(GROUPS, 0.0), 9.0, 0.0, 1, 0)
    needs, prices = free.bill(needed)
    assert (needs.long() @ prices == 1).all()
    # of equal price the higher score wins: nothing is taken just because it is free
    assert rank_per_cost(torch.tensor([1.0, 3.0, 2.0]), needs, prices, 3).tolist() == [1, 2, 0]


def test_measured_prices_are_none_below_nothing():
    """How long anything took is not looked at."""
    costs = measure_costs(
        POOL, ChannelFilter([51, 51, 11, 11]), [4, 8], "auto", ["mean", "std"], calls=5
    )
    assert costs.to_dict()["groups"].keys() == GROUPS.keys()
    prices = (costs.rest_us, costs.rest_of_one_us, costs.pooling_us, costs.pooling_of_one_us)
    assert min(prices) >= 0
    few, many = (set().union(*parts(*names)) for names in (POOL.names[:1], POOL.names))
    assert 0 <= costs.features_us(few) <= costs.features_us(many)
    json.dumps(costs.to_dict(), allow_nan=False)


# The clock -----------------------------------------------------------------------------------


class Played:
    """A clock and calls that are played: microseconds as given, interrupted if negative."""

    def __init__(self, monkeypatch, *runs):
        self.now, self.switches = 0, 0
        self.left = iter([1, *(us for run in runs for us in run)])  # the first is not timed
        monkeypatch.setattr(
            "tactslip_torch.analysis.latency.time.perf_counter_ns", lambda: self.now
        )
        monkeypatch.setattr("tactslip_torch.analysis.latency._interruptions", lambda: self.switches)

    def __call__(self, given):
        us = next(self.left)
        self.now += 1000 * abs(us)
        self.switches += us < 0


def test_p50_and_p99_are_of_single_calls(monkeypatch):
    run = list(range(1, 101))
    played = Played(monkeypatch, run[::-1], [10 * us for us in run], run)
    # one run that a neighbour slows down does not decide
    assert time_calls(played, [None], 100, runs=3) == Timing(51.0, 99.0, 99.0, 100, 0.0)


def test_interrupted_calls_are_told_but_not_counted(monkeypatch):
    run = list(range(1, 101))
    played = Played(monkeypatch, [*run[:50], *[-5000] * 25, *run[50:]])
    assert time_calls(played, [None], 100, runs=1) == Timing(51.0, 99.0, 5000.0, 100, 0.2)
    played = Played(monkeypatch, [7, *[-5000] * 100])
    assert time_calls(played, [None], 100, runs=1).p50_us == 5000  # hardly one was left alone


def test_a_saved_detector_is_timed_in_a_process_of_its_own(tmp_path, capsys):
    path = tmp_path / "detector.pt"
    small_detector().save(path)
    timing = time_in_fresh_process(path, 20, "auto")
    assert timing.calls == 20
    assert 0 < timing.p50_us <= timing.p99_us <= timing.p99_all_us
    main([str(path), "10", "auto"])
    printed = json.loads(capsys.readouterr().out)
    assert printed["calls"] == 10
    with pytest.raises(ValueError, match=r"timing .*gone.pt in a fresh process failed: .*gone.pt"):
        time_in_fresh_process(tmp_path / "gone.pt", 20)
    with pytest.raises(
        SystemExit, match=r"usage: python -m tactslip_torch.analysis.latency detector.pt"
    ):
        main([])


def test_threads_are_given_back():
    def fails():
        with one_thread():
            assert torch.get_num_threads() == 1
            raise KeyError

    torch.set_num_threads(2)
    try:
        with pytest.raises(KeyError):
            fails()
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(1)

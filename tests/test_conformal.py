"""Thresholds that keep a coverage over recordings, beside their definition and by simulation."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from tactslip_torch.model.conformal import (
    NON_SLIP,
    SLIP,
    UNSURE,
    Thresholds,
    answers,
    fewest_recordings,
    thresholds,
)

Drawn = tuple[Tensor, Tensor, Tensor]


def mean_share(wrong: Tensor, unit: Tensor) -> float:
    """Mean over units of the share of their bins that are wrong."""
    return float(torch.stack([wrong[unit == u].double().mean() for u in unit.unique()]).mean())


def draw_recordings(num: int, generator: torch.Generator, apart: float = 0.8) -> Drawn:
    """Scores, truth and unit of recordings that differ in difficulty and in their number of bins.

    All bins of one class of a recording lie close together, as neighbours do; the classes' means
    lie twice ``apart``.
    """
    scores, truth, unit = [], [], []
    for index in range(num):
        for is_slip in (True, False):
            size = int(torch.randint(1, 8, (), generator=generator))
            centre = torch.randn((), generator=generator) + (apart if is_slip else -apart)
            scores.append(centre + 0.05 * torch.randn(size, generator=generator))
            truth.append(torch.full((size,), is_slip))
            unit.append(torch.full((size,), index))
    return torch.cat(scores).double(), torch.cat(truth), torch.cat(unit)


def risks(found: Thresholds, drawn: Drawn) -> tuple[float, float]:
    """Of slip and of non-slip: mean share of a recording that is answered with the other."""
    scores, is_slip, unit = drawn
    given = answers(scores, found.low, found.high)
    wrong_slip, wrong_rest = given[is_slip] == NON_SLIP, given[~is_slip] == SLIP
    return mean_share(wrong_slip, unit[is_slip]), mean_share(wrong_rest, unit[~is_slip])


def by_definition(x: Tensor, unit: Tensor, most_risk: float) -> float:
    """The highest value of x, or -inf, that may be the threshold below which truth is excluded."""
    num = len(unit.unique())
    good = [
        float(t) for t in x if (num * mean_share(x < t, unit) + 1) / (num + 1) <= most_risk + 1e-12
    ]
    return max(good, default=-math.inf)


@pytest.mark.parametrize("coverage", [0.5, 0.8, 0.9, 0.95])
@pytest.mark.parametrize("num", [3, 9, 10, 40])
def test_thresholds_are_the_boldest_that_the_definition_allows(num: int, coverage: float) -> None:
    generator = torch.Generator().manual_seed(num)
    scores, is_slip, unit = draw_recordings(num, generator)
    found = thresholds(scores, is_slip, unit, coverage)
    low = by_definition(scores[is_slip], unit[is_slip], 1 - coverage)
    high = -by_definition(-scores[~is_slip], unit[~is_slip], 1 - coverage)
    assert found.low == min(low, 0.0)
    assert found.high == max(math.nextafter(high, math.inf), 0.0)
    assert found.num_slip == found.num_non_slip == num


@pytest.mark.parametrize(("num", "coverage"), [(4, 0.75), (10, 0.8)])
def test_the_next_recording_is_covered_in_the_mean(num: int, coverage: float) -> None:
    # the promise is of the mean over calibration sets and the next recording alike
    generator = torch.Generator().manual_seed(1)
    trials = 600
    found, dropped = [], []
    for _ in range(trials):
        scores, is_slip, unit = draw_recordings(num + 1, generator, apart=0.0)
        past = unit < num
        ours = thresholds(scores[past], is_slip[past], unit[past], coverage)
        # without the + 1 of (n R + 1) / (n + 1): the coverage at which the two agree
        bolder = 1 - (num * (1 - coverage) + 1) / (num + 1)
        plain = thresholds(scores[past], is_slip[past], unit[past], bolder)
        newest = (scores[~past], is_slip[~past], unit[~past])
        found.append(risks(ours, newest))
        dropped.append(risks(plain, newest))
    most = 1 - coverage
    noise = 4 * math.sqrt(most * coverage / trials)  # four standard errors of a share of that mean
    ours, plain = (torch.tensor(rows).mean(0) for rows in (found, dropped))
    assert (ours <= most + noise).all(), ours
    assert (ours > 0).all()  # it is not by never answering
    assert (plain > most).all(), plain
    if num == 4:
        assert (plain > most + noise).all(), plain


def test_bins_taken_as_units_miss_what_recordings_keep() -> None:
    generator = torch.Generator().manual_seed(2)
    by_recording, by_bin = [], []
    for _ in range(600):
        drawn = draw_recordings(10, generator)
        scores, is_slip, unit = drawn
        past = unit < 9
        newest = (scores[~past], is_slip[~past], unit[~past])
        for units, into in ((unit, by_recording), (torch.arange(len(unit)), by_bin)):
            own = thresholds(scores[past], is_slip[past], units[past], 0.85)
            into.append(risks(own, newest))
    noise = 4 * math.sqrt(0.15 * 0.85 / 600)
    recordings, bins = (torch.tensor(rows).mean(0) for rows in (by_recording, by_bin))
    assert (recordings <= 0.15 + noise).all(), recordings
    assert (bins > recordings).all(), (bins, recordings)


def test_too_few_recordings_are_never_sure() -> None:
    generator = torch.Generator().manual_seed(3)
    assert fewest_recordings(0.9) == 9
    few = thresholds(*draw_recordings(8, generator), 0.9)
    assert (few.low, few.high) == (-math.inf, math.inf)
    enough = thresholds(*draw_recordings(9, generator), 0.9)
    assert math.isfinite(enough.low)
    assert math.isfinite(enough.high)


def test_classes_that_are_told_apart_leave_nothing_unsure() -> None:
    scores = torch.cat([torch.linspace(1, 2, 40), -torch.linspace(1, 2, 40)])
    found = thresholds(scores, scores > 0, torch.arange(80) % 20, 0.9)
    assert found[:2] == (0.0, 0.0)  # they would cross at 1 and -1
    assert answers(torch.tensor([0.0, -1e-9]), *found[:2]).tolist() == [SLIP, NON_SLIP]


def test_recordings_weigh_alike_whatever_their_length() -> None:
    # ten recordings of one bin each and one, of which all is wrong, of a thousand
    scores = torch.cat([torch.ones(19), torch.full((1000,), -1.0), -torch.ones(20)])
    is_slip = torch.arange(len(scores)) < 1019
    unit = torch.cat([torch.arange(19), torch.full((1000,), 19), torch.arange(20)])
    assert thresholds(scores, is_slip, unit, 0.9).low == 0  # one of twenty may be lost
    assert thresholds(scores, is_slip, torch.arange(len(scores)), 0.9).low == -1  # most may not


def test_answers_say_slip_non_slip_and_unsure_in_any_shape_and_dtype() -> None:
    scores = torch.tensor([[-2.0, -1.0, 0.0], [0.5, 3.0, math.nan]])
    expected = torch.tensor([[NON_SLIP, UNSURE, UNSURE], [SLIP, SLIP, UNSURE]], dtype=torch.int8)
    for dtype in (torch.float32, torch.float64):
        given = answers(scores.to(dtype), -1.0, 0.5)
        torch.testing.assert_close(given, expected)
    assert answers(torch.zeros(0), -1.0, 0.5).shape == (0,)


def test_the_order_of_bins_does_not_matter() -> None:
    scores, is_slip, unit = draw_recordings(30, torch.Generator().manual_seed(4))
    turn = torch.randperm(len(scores), generator=torch.Generator().manual_seed(5))
    assert thresholds(scores, is_slip, unit, 0.9) == thresholds(
        scores[turn], is_slip[turn], unit[turn], 0.9
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s, t, u: (s, t, u, 1.0), "coverage must lie between 0 and 1"),
        (lambda s, t, u: (s, t, u, True), "coverage must lie between 0 and 1"),
        (lambda s, t, u: (s[:-1], t, u, 0.9), "of one N"),
        (lambda s, t, u: (s / 0, t, u, 0.9), "must be finite"),
        (lambda s, t, u: (s, t | True, u, 0.9), "no non-slip bin"),
        (lambda s, t, u: (s, t & False, u, 0.9), "no slip bin"),
    ],
)
def test_what_cannot_be_is_refused(change: Callable[..., tuple[Tensor, ...]], message: str) -> None:
    drawn = draw_recordings(12, torch.Generator().manual_seed(6))
    with pytest.raises(ValueError, match=message):
        thresholds(*change(*drawn))  # type: ignore[arg-type]

"""Alarms against a plain loop of the definition: thresholds, cuts, re-arming, stretches."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from tactslip_torch.onset.latch import (
    Latch,
    alarm_counts,
    count_alarms,
    joined,
    latch,
    latch_start,
    stretches,
)

PLAIN = {"margin": 0.0, "rearm": 1, "refractory": 0}


def by_hand(
    values: list[float], threshold: float, margin: float, rearm: int, refractory: int
) -> tuple[list[bool], list[bool]]:
    """The definition, by the times of what happened and no counters."""
    last_alarm, last_not_low, armed = -math.inf, -math.inf, True
    alarms, standing = [], []
    for t, value in enumerate(values):
        if value >= threshold - margin:
            last_not_low = t
        if not armed and t - last_not_low >= max(rearm, 1):
            armed = True
        alarm = armed and value >= threshold and t - last_alarm >= refractory
        if alarm:
            armed, last_alarm = False, t
        alarms.append(alarm)
        standing.append(not armed)
    return alarms, standing


def raised(values: list[float], threshold: float = 1.0, **how) -> list[int]:
    """The numbers of the decisions that raise an alarm."""
    statistic = torch.tensor(values)
    state = latch_start(statistic[0])
    return latch(statistic, threshold, **{**PLAIN, **how}, state=state)[0].nonzero()[:, 0].tolist()


def drawn(seed: int) -> list[int]:
    """Whole numbers, so that a statistic meets threshold and re-arm level exactly, and often."""
    source = np.random.default_rng(seed)
    return source.integers(-4, 5, size=source.integers(1, 61)).tolist()


values = st.integers(0, 2**40).map(drawn)  # lists that hypothesis draws are too short and plain
rules = st.fixed_dictionaries(
    {
        "margin": st.integers(0, 3).map(float),
        "rearm": st.integers(0, 5),
        "refractory": st.integers(0, 9),
    }
)


# --------------------------------------------------------------------------------- the definition
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("copies", [1, 30])  # plain numbers and tensors
@given(values=values, threshold=st.integers(-3, 4), how=rules)
def test_equals_the_definition(dtype, copies: int, values, threshold: int, how: dict) -> None:
    statistic = torch.tensor(values, dtype=dtype).expand(copies, -1)
    state = latch_start(statistic[:, 0])
    is_alarm, is_on, _ = latch(statistic, float(threshold), **how, state=state)
    alarms, standing = by_hand(values, threshold, **how)
    assert is_alarm.tolist() == [alarms] * copies
    assert is_on.tolist() == [standing] * copies
    assert count_alarms(statistic, threshold, **how).tolist() == [sum(alarms)] * copies


@pytest.mark.parametrize("num_rows", [1, 3, 12])
@given(seed=st.integers(0, 2**20), cuts=st.lists(st.integers(0, 50), max_size=10), how=rules)
def test_any_cut_gives_the_same(num_rows: int, seed: int, cuts: list[int], how: dict) -> None:
    source = torch.Generator().manual_seed(seed)
    statistic = torch.randint(-4, 5, (num_rows, 50), generator=source).float()
    state = latch_start(statistic[:, 0])
    *whole, end = latch(statistic, 1.0, **how, state=state)
    pieces = []
    for first, last in zip([0, *sorted(cuts)], [*sorted(cuts), 50], strict=True):
        *piece, state = latch(statistic[:, first:last], 1.0, **how, state=state)
        assert [part.shape for part in piece] == [(num_rows, last - first)] * 2
        assert [part.dtype for part in piece] == [torch.bool] * 2
        pieces.append(piece)
    for k in range(2):
        assert torch.equal(torch.cat([piece[k] for piece in pieces], -1), whole[k])
    for got, expected in zip(state, end, strict=True):
        assert torch.equal(got, expected)
        assert got.dtype == expected.dtype


@given(seed=st.integers(0, 2**20), where=st.integers(0, 49))
def test_later_decisions_change_nothing_before(seed: int, where: int) -> None:
    statistic = torch.randn(50, generator=torch.Generator().manual_seed(seed))
    other = statistic.clone()
    other[where:] = 100.0
    state = latch_start(statistic[0])
    for got, changed in zip(
        latch(statistic, 0.5, margin=0.2, rearm=2, refractory=3, state=state)[:2],
        latch(other, 0.5, margin=0.2, rearm=2, refractory=3, state=state)[:2],
        strict=True,
    ):
        assert torch.equal(got[:where], changed[:where])


# ----------------------------------------------------------------------------------- one by one
def test_an_alarm_is_raised_once() -> None:
    assert raised([0, 1, 2, 3, 2, 1, 1, 0, 0]) == [1]
    assert raised([1, 0, 1, 0, 1]) == [0, 2, 4]


def test_at_the_threshold_is_an_alarm_and_at_the_rearm_level_not_low() -> None:
    assert raised([1.0], threshold=1.0) == [0]
    assert raised([0.999], threshold=1.0) == []
    assert raised([3, 2, 3, 1.9, 3], threshold=3.0, margin=1.0) == [0, 4]


def test_hysteresis_holds_an_alarm_above_the_margin() -> None:
    falls = [0, 2, 0.5, 2, 0.5, 2, -0.5, 2]
    assert raised(falls) == [1, 3, 5, 7]
    assert raised(falls, margin=1.0) == [1, 7]


def test_rearming_takes_so_many_low_decisions_in_a_row() -> None:
    dips = [2, 0, 2, 0, 0, 2, 0, 0, 0, 2]
    assert raised(dips, rearm=1) == [0, 2, 5, 9]
    assert raised(dips, rearm=2) == [0, 5, 9]
    assert raised(dips, rearm=3) == [0, 9]
    assert raised(dips, rearm=4) == [0]


def test_zero_decisions_to_rearm_are_one() -> None:
    assert raised([2, 2, 2, 0, 2], rearm=0) == [0, 4]


def test_refractory_time_puts_an_alarm_off_and_does_not_lose_it() -> None:
    assert raised([2, 0, 2, 0, 2, 0, 2], refractory=3) == [0, 4]
    assert raised([2, 0, 2, 2, 2, 2], refractory=4) == [0, 4]
    assert raised([2, 0, 2, 0], refractory=4) == [0]


def test_status_ends_when_the_latch_is_armed_again() -> None:
    statistic = torch.tensor([0.0, 2, 2, 0, 0, 0, 2])
    _, is_on, state = latch(
        statistic, 1.0, margin=0.0, rearm=2, refractory=0, state=latch_start(statistic[0])
    )
    assert is_on.tolist() == [False, True, True, True, False, False, True]
    assert [int(part) for part in state] == [1, 0, 0]


def test_what_is_remembered() -> None:
    statistic = torch.tensor([2.0, 0, 0, 0])
    start = latch_start(statistic[0])
    assert not start.is_on
    state = latch(statistic, 1.0, margin=0.0, rearm=9, refractory=0, state=start)[2]
    assert (bool(state.is_on), int(state.below), int(state.since)) == (True, 3, 3)


@pytest.mark.parametrize("copies", [1, 30])
def test_what_is_no_number_is_neither_above_nor_below(copies: int) -> None:
    statistic = torch.tensor([2, 0, math.nan, 0, 2, 0, 0, 2]).expand(copies, -1)
    state = latch_start(statistic[:, 0])
    is_alarm = latch(statistic, 1.0, margin=0.0, rearm=2, refractory=0, state=state)[0]
    assert is_alarm[0].nonzero()[:, 0].tolist() == [0, 7]
    infinite = torch.tensor([-math.inf, math.inf, -math.inf, math.inf]).expand(copies, -1)
    assert count_alarms(infinite, 1e30, **PLAIN).tolist() == [2] * copies
    assert count_alarms(infinite, math.inf, **PLAIN).tolist() == [2] * copies


# ------------------------------------------------------------------------------------- shapes
def test_thresholds_broadcast_against_streams(rng: np.random.Generator) -> None:
    statistic = torch.from_numpy(rng.standard_normal((5, 80)))
    levels = torch.tensor([-0.5, 0.0, 0.7, 1.5])
    how = {"margin": 0.3, "rearm": 2, "refractory": 4}
    state = latch_start(torch.zeros(4, 5))
    is_alarm, is_on, end = latch(statistic, levels[:, None], **how, state=state)
    assert is_alarm.shape == is_on.shape == (4, 5, 80)
    assert end.is_on.shape == (4, 5)
    # a state of the streams alone is spread over the thresholds
    again = latch(statistic, levels[:, None], **how, state=latch_start(statistic[:, 0]))[0]
    assert torch.equal(again, is_alarm)
    for g, level in enumerate(levels.tolist()):
        for r, row in enumerate(statistic):
            alone, on, after = latch(row, level, **how, state=latch_start(row[0]))
            assert torch.equal(alone, is_alarm[g, r])
            assert torch.equal(on, is_on[g, r])
            assert [int(part) for part in after] == [int(part[g, r]) for part in end]
    counts = count_alarms(statistic, levels[:, None], **how)
    assert torch.equal(counts, is_alarm.sum(-1))


@pytest.mark.parametrize("shape", [(), (3,), (2, 0), (2, 30)])
def test_no_decision_leaves_the_state(shape: tuple[int, ...]) -> None:
    state = Latch(torch.ones(shape, dtype=torch.bool), torch.full(shape, 3), torch.full(shape, 5))
    is_alarm, is_on, after = latch(torch.zeros(*shape, 0), 1.0, **PLAIN, state=state)
    assert is_alarm.shape == is_on.shape == (*shape, 0)
    assert is_alarm.dtype == is_on.dtype == torch.bool
    assert all(torch.equal(a, b) for a, b in zip(state, after, strict=True))
    assert (
        count_alarms(torch.zeros(*shape, 0), 1.0, **PLAIN).tolist() == torch.zeros(shape).tolist()
    )


def test_no_stream_is_no_trouble() -> None:
    statistic = torch.zeros(0, 7)
    is_alarm, is_on, state = latch(statistic, 1.0, **PLAIN, state=latch_start(statistic[:, 0]))
    assert is_alarm.shape == is_on.shape == (0, 7)
    assert state.since.shape == (0,)


@pytest.mark.parametrize("num_rows", [2, 40])
def test_inputs_stay_as_they_are(num_rows: int) -> None:
    statistic = torch.randn(num_rows, 20, generator=torch.Generator().manual_seed(1))
    statistic.requires_grad_()
    state = latch_start(statistic[:, 0])
    before = [part.clone() for part in (statistic, *state)]
    is_alarm, _, _ = latch(statistic, 0.0, margin=0.5, rearm=2, refractory=3, state=state)
    assert all(torch.equal(a, b) for a, b in zip(before, (statistic, *state), strict=True))
    assert not is_alarm.requires_grad
    strided = torch.stack([statistic, statistic + 1], dim=-1)[..., 0]
    again = latch(strided, 0.0, margin=0.5, rearm=2, refractory=3, state=state)[0]
    assert torch.equal(again, is_alarm)


def test_threshold_counts_in_the_dtype_of_the_statistic() -> None:
    # 0.1 in float32 is above 0.1; the statistic is that very number
    assert raised([0.1], threshold=0.1) == [0]


def test_on_the_device_of_the_statistic(device: torch.device) -> None:
    statistic = torch.tensor([0.0, 2, 0, 2], device=device).expand(12, -1)
    for rows in (statistic, statistic[:2]):
        state = latch_start(rows[:, 0])
        is_alarm, is_on, state = latch(rows, 1.0, **PLAIN, state=state)
        assert {x.device.type for x in (is_alarm, is_on, *state)} == {device.type}
    counts = alarm_counts([statistic[0], statistic[1]], [1.0, 3.0], **PLAIN)
    assert counts.tolist() == [[2, 2], [0, 0]]


@pytest.mark.parametrize("wrong", [{"margin": -0.1}, {"rearm": -1}, {"refractory": -2}])
def test_negative_settings_are_refused(wrong: dict) -> None:
    statistic = torch.zeros(3)
    with pytest.raises(ValueError, match="must not be negative") as error:
        latch(statistic, 1.0, **{**PLAIN, **wrong}, state=latch_start(statistic[0]))
    assert "\n" not in str(error.value)
    for count in (
        lambda: count_alarms(statistic, 1.0, **{**PLAIN, **wrong}),
        lambda: alarm_counts([statistic], [1.0], **{**PLAIN, **wrong}),
    ):
        with pytest.raises(ValueError, match="must not be negative"):
            count()


# ------------------------------------------------------------------------- recordings, in stretches
@given(
    recordings=st.lists(values, min_size=1, max_size=4),
    threshold=st.integers(-3, 5),
    how=rules,
)
def test_counts_in_recordings_are_those_of_the_latch(recordings, threshold: int, how) -> None:
    statistics = [torch.tensor(row, dtype=torch.float32) for row in recordings]
    counts = alarm_counts(statistics, [float(threshold), float(threshold) - 1], **how)
    assert counts.dtype == torch.int64
    assert counts.tolist() == [
        [sum(by_hand(row, level, **how)[0]) for row in recordings]
        for level in (threshold, threshold - 1)
    ]


@pytest.mark.parametrize("seed", range(3))
def test_counts_in_long_sparse_recordings(seed: int) -> None:
    # alarms whose memory reaches over many decisions that were left out
    source = torch.Generator().manual_seed(seed)
    statistics = [torch.randn(num, generator=source).double() for num in (3000, 1, 0, 2500)]
    how = {"margin": 0.4, "rearm": 12, "refractory": 30}
    levels = [1.5, 2.2, 2.8, 9.0]
    counts = alarm_counts(statistics, levels, **how)
    assert counts.tolist() == [
        [sum(by_hand(row.tolist(), level, **how)[0]) for row in statistics] for level in levels
    ]
    assert counts[0].sum() > 50  # something was counted


def test_stretches_hold_every_high_decision_and_no_other(rng: np.random.Generator) -> None:
    statistics = [torch.from_numpy(rng.standard_normal(num)) for num in (400, 300)]
    flat, recording = joined(statistics)
    found = list(stretches(flat, recording, torch.tensor(1.0), rearm=3, refractory=6))
    real = torch.cat([part.values[part.values.isfinite()] for part in found])
    assert torch.equal(real.sort().values, flat[flat >= 1].sort().values)
    owners = torch.cat([p.recording.repeat_interleave(p.values.isfinite().sum(-1)) for p in found])
    assert [int((owners == r).sum()) for r in (0, 1)] == [int((s >= 1).sum()) for s in statistics]
    for part in found:  # within one no gap is long enough for a latch to forget
        assert int(part.skipped.max()) < max(3, 6 - 1)
        assert bool((part.skipped[:, 0] == 0).all())
        lengths = part.values.isfinite().sum(-1)
        assert int(lengths.max()) < 2 * int(lengths.min())  # little is filled up
    assert len(found) > 1
    assert list(stretches(flat, recording, torch.tensor(99.0), rearm=3, refractory=6)) == []


def test_skipped_decisions_count_as_low_ones() -> None:
    values = [2.0, 0, 0, 0, 2, 0, 2, 2]
    kept, skipped = torch.tensor([2.0, 2, 2, 2]), torch.tensor([0, 3, 1, 0])
    for rearm in range(6):
        for refractory in range(9):
            how = {"margin": 0.0, "rearm": rearm, "refractory": refractory}
            expected = sum(by_hand(values, 1.0, **how)[0])
            assert int(count_alarms(kept, 1.0, **how, skipped=skipped)) == expected


def test_joined_recordings_know_their_own() -> None:
    flat, recording = joined([torch.ones(2), torch.ones(0), torch.zeros(1)])
    assert flat.tolist() == [1, 1, 0]
    assert recording.tolist() == [0, 0, 2]


@pytest.mark.parametrize(
    ("statistics", "said"),
    [
        ([], "no decision to count alarms in"),
        ([torch.zeros(0)], "no decision to count alarms in"),
        ([torch.zeros(2), torch.zeros(2, 3)], r"recording 1 must be a row .* got shape \(2, 3\)"),
        ([torch.tensor([0.0, math.nan])], "recording 0 must be a row of finite numbers"),
        ([torch.tensor([0.0, math.inf])], "recording 0 must be a row of finite numbers"),
    ],
)
def test_what_is_no_recording_is_refused(statistics: list[Tensor], said: str) -> None:
    with pytest.raises(ValueError, match=said) as error:
        alarm_counts(statistics, [1.0], **PLAIN)
    assert "\n" not in str(error.value)


def test_no_threshold_gives_no_row() -> None:
    assert alarm_counts([torch.zeros(3)], [], **PLAIN).shape == (0, 1)

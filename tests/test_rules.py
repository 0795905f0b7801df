"""Sequential rules, the latch, rates with intervals and the threshold for a target."""

from __future__ import annotations

import json
import math
from collections import deque
from itertools import pairwise
from unittest.mock import patch

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2

from tactslip_torch.onset import rules
from tactslip_torch.onset.rules import (
    NOTHING_YET,
    Budget,
    Cusum,
    KOfN,
    Latch,
    Rule,
    false_alarms,
    latch,
    lowest_threshold,
    rule_from_dict,
)

LIST = (KOfN(1, 1), KOfN(2, 3), KOfN(7, 20), Cusum(), Cusum(drift=0.3, evidence=0.2, ceiling=3.0))
LIST += (Cusum(np.float64(0.13), np.float64(0.37), 5.3),)
RULE = pytest.mark.parametrize("rule", LIST, ids=lambda rule: str(rule))


# ------------------------------------------------------------------------------------ the oracles
def k_of_n(rule: KOfN, llrs: list[float]) -> list[float]:
    last: deque[float] = deque(maxlen=rule.n)
    found = []
    for llr in llrs:
        last.append(llr)
        ranked = sorted(last, reverse=True)
        found.append(ranked[rule.k - 1] if len(ranked) >= rule.k else NOTHING_YET)
    return found


def cusum(rule: Cusum, llrs: list[float]) -> list[float]:
    total, found = 0.0, []
    for llr in llrs:
        total = min(max(total + rule.evidence * (llr - rule.drift), 0.0), rule.ceiling)
        found.append(total)
    return found


ORACLES = {"k_of_n": k_of_n, "cusum": cusum}


@RULE
@pytest.mark.parametrize(("dtype", "tol"), [(torch.float64, 1e-12), (torch.float32, 2e-5)])
@given(
    num=st.sampled_from([0, 1, 40, 200]),
    cuts=st.lists(st.integers(0, 200), max_size=12),
    seed=st.integers(0, 2**20),
)
def test_a_statistic_is_by_definition_and_the_same_bits_in_any_cut(
    rule: Rule, dtype, tol, num, cuts, seed
) -> None:
    source = torch.Generator().manual_seed(seed)
    llr = 3 * torch.randn(num, dtype=dtype, generator=source)
    values, kind = llr.tolist(), llr.numpy().dtype.type
    whole, _ = rule.scan_row(values, rule.start(), kind)
    assert whole == pytest.approx(ORACLES[rule.name](rule, values), rel=tol, abs=tol * max(num, 1))
    state, pieces = rule.start(), list[float]()
    for first, last in pairwise([0, *sorted(min(cut, num) for cut in cuts), num]):
        piece, state = rule.scan_row(values[first:last], state, kind)
        pieces += piece
    assert pieces == whole


# ----------------------------------------------------------------------------------- as plain data
@RULE
def test_survives_json(rule: Rule) -> None:
    plain = json.loads(json.dumps(rule.to_dict(), allow_nan=False))
    assert rule_from_dict(plain) == rule


NO_RULES = [
    ({"name": "viterbi"}, "no sequential rule is called 'viterbi'; there are k_of_n, "),
    ({"name": "k_of_n", "k": 2}, "do not fit.*'n'"),
    ({"name": "k_of_n", "k": 4, "n": 3}, "between 1 and n, got k=4 and n=3"),
    ({"name": "cusum", "evidence": 1.1}, r"evidence must lie in \(0, 1\], got 1.1"),
    ({"name": "cusum", "drift": math.inf}, "drift must be finite"),
    ({"name": "cusum", "ceiling": 0.0}, "ceiling must be positive"),
]


@pytest.mark.parametrize(("plain", "said"), NO_RULES)
def test_no_such_rule(plain: dict, said: str) -> None:
    with pytest.raises(ValueError, match=said) as error:
        rule_from_dict(plain)
    assert "\n" not in str(error.value)


# ===================================================================================== the latch


def by_hand(values, threshold, rearm, refractory):
    """The definition, by the times of what happened and no counters."""
    last_alarm, last_not_low, armed = -math.inf, -math.inf, True
    alarms, standing = [], []
    for t, value in enumerate(values):
        if value >= threshold:
            last_not_low = t
        if not armed and t - last_not_low >= max(rearm, 1):
            armed = True
        alarm = armed and value >= threshold and t - last_alarm >= refractory
        if alarm:
            armed, last_alarm = False, t
        alarms.append(alarm)
        standing.append(not armed)
    return alarms, standing


def drawn(seed: int) -> list[int]:
    """Whole numbers, so that a statistic meets a threshold exactly, and often."""
    source = np.random.default_rng(seed)
    return source.integers(-4, 5, size=source.integers(1, 61)).tolist()


drawn_values = st.integers(0, 2**40).map(drawn)  # hypothesis draws short plain lists
drawn_times = st.fixed_dictionaries({"rearm": st.integers(0, 5), "refractory": st.integers(0, 9)})


# --------------------------------------------------------------------------------- the definition
@given(
    values=drawn_values,
    threshold=st.integers(-3, 4),
    how=drawn_times,
    cuts=st.lists(st.integers(0, 60), max_size=10),
)
def test_the_latch_equals_its_definition_in_any_pieces(values, threshold, how, cuts) -> None:
    alarms, standing, state = [], [], Latch()
    for first, last in pairwise([0, *sorted(min(cut, len(values)) for cut in cuts), len(values)]):
        *piece, state = latch(values[first:last], threshold, **how, state=state)
        alarms += piece[0]
        standing += piece[1]
    *whole, end = latch(values, threshold, **how)
    assert whole == [alarms, standing] == list(by_hand(values, threshold, **how))
    assert end == state


def test_what_is_no_number_moves_nothing_but_the_time_since_an_alarm() -> None:
    values, nan = [2, 0, math.nan, 0, 2, 0, math.nan, 2], math.nan
    alarms, standing, _ = latch(values, 1.0, rearm=2, refractory=0)
    assert np.flatnonzero(alarms).tolist() == [0, 4]
    assert np.flatnonzero(standing).tolist() == [0, 1, 2, 4, 5, 6, 7]
    assert latch([2, 0, nan, 2], 1.0, rearm=1, refractory=3)[0] == [True, False, False, True]
    assert latch([nan, nan], -math.inf, rearm=1, refractory=0)[:2] == ([False] * 2, [False] * 2)
    values = [-math.inf, math.inf, -math.inf, math.inf]
    assert latch(values, math.inf, rearm=1, refractory=0)[0] == [False, True] * 2


# Budgets -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("confidence", [0.5, 0.95, 0.999])
def test_bounds_are_those_of_garwood(confidence: float) -> None:
    rate = Budget("held", 1.0, confidence)
    for alarms in (0, 1, 7, 199):
        upper = chi2.isf(1 - confidence, 2 * alarms + 2) / 2
        assert rate.bound(alarms, 2.5) == pytest.approx(upper / 2.5, rel=1e-9)
    assert rate.bound(0, 0.0) == math.inf


TOO_LITTLE = [
    (Budget("machine", 10.0), 0.29, r"0\.29 h of machine cannot show .* most 10 .* 0\.3 h"),
    (Budget("held", 1.0, confidence=0.9), 0.0, r"0 h of held .* at least 2\.303 h, or a la"),
]


@pytest.mark.parametrize(("budget", "amount", "match"), TOO_LITTLE)
def test_too_little_to_show_a_budget_is_refused_with_what_would_do(budget, amount, match) -> None:
    with pytest.raises(ValueError, match=match) as error:
        budget.allowed(amount)
    assert "\n" not in str(error.value)
    least = float(str(error.value).split("at least ")[1].split()[0])
    assert budget.allowed(least) == 0


NO_BUDGETS = [
    ({"limit": 0.0}, "onset.budget of held must be positive, got 0"),
    ({"limit": 1.0, "confidence": 1.0}, "onset.confidence must lie between 0 and 1, got 1"),
]


@pytest.mark.parametrize(("numbers", "match"), NO_BUDGETS)
def test_what_is_no_budget(numbers, match: str) -> None:
    with pytest.raises(ValueError, match=match):
        Budget("held", **numbers)


def by_latch(scores, quiet, threshold, how):
    """False alarms of all recordings, one decision after the other."""
    num = 0
    for row, is_quiet in zip(scores, quiet, strict=True):
        high = [float(x >= threshold) for x in row]
        num += int((np.array(latch(high, 1.0, **how)[0], bool) & is_quiet).sum())
    return num


@given(
    recordings=st.lists(drawn_values, min_size=1, max_size=4),
    allowed=st.integers(0, 6),
    how=drawn_times,
    seed=st.integers(0, 2**20),
    most=st.sampled_from([5, 200_000]),
    least_quiet=st.sampled_from([1, 4]),
    one_by_one=st.sampled_from([500, 2]),
)
def test_the_lowest_threshold_is_that_of_trying_every_value(
    recordings, allowed, how, seed, most, least_quiet, one_by_one
):
    source = np.random.default_rng(seed)
    fine = source.random() < 0.5  # else many values are equal
    scores = [(np.array(row) + fine * source.random(len(row))).astype("f4") for row in recordings]
    quiet = [source.random(len(row)) < 0.8 for row in scores]
    ranked = np.sort(np.concatenate([row[q] for row, q in zip(scores, quiet, strict=True)]))[::-1]
    limits = {"_MOST_TRIED": most, "_LEAST_QUIET": least_quiet, "_TRIED_ONE_BY_ONE": one_by_one}
    with patch.multiple(rules, **limits):
        if not len(ranked):
            with pytest.raises(ValueError, match="no decision to count alarms in"):
                lowest_threshold(scores, quiet, allowed, **how)
            return
        found = lowest_threshold(scores, quiet, allowed, **how)
    above = float(np.nextafter(ranked[0], np.float32(np.inf)))
    if found < above or by_latch(scores, quiet, above, how) <= allowed:
        assert by_latch(scores, quiet, found, how) <= allowed
    expected = above
    tried = max(1, min(most, len(ranked) // least_quiet))
    for value in dict.fromkeys(ranked[:tried].tolist()):
        if by_latch(scores, quiet, value, how) > allowed:
            break
        expected = value
    assert found == expected if one_by_one == 500 else found in {above, *ranked.tolist()}


@pytest.mark.parametrize(("num_quiet", "num_high"), [(39, 1), (40, 2), (400, 20)])
def test_a_score_is_no_alarm_that_is_high_in_more_than_one_of_20_quiet_decisions(
    num_quiet, num_high
):
    """However few alarms it raises: with a long re-arming all of these are one."""
    scores = np.arange(float(num_quiet))
    found = lowest_threshold([scores], [np.ones(num_quiet, bool)], 5, rearm=num_quiet, refractory=0)
    assert int((scores >= found).sum()) == num_high


@given(values=drawn_values, how=drawn_times, seed=st.integers(0, 2**20))
def test_false_alarms_are_those_of_the_latch_in_quiet(values, how, seed: int) -> None:
    quiet = np.random.default_rng(seed).random(len(values)) < 0.5
    expected = by_latch([values], [quiet], 1, how)
    assert len(false_alarms(np.array(values) >= 1, quiet, **how)) == expected

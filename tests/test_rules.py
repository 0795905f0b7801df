"""Sequential rules and the latch against plain loops: any cut, gradients, extremes."""

from __future__ import annotations

import json
import math
from collections import deque
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from oracles import assert_manners
from torch import Tensor

from tactslip_torch.onset.rules import (
    NOTHING_YET,
    RULES,
    Cusum,
    KOfN,
    Latch,
    Rule,
    latch,
    rule_from_dict,
)

LIST = (
    KOfN(1, 1),
    KOfN(2, 3),
    KOfN(7, 20),
    Cusum(),
    Cusum(drift=0.3, evidence=0.2, ceiling=3.0),
    Cusum(np.float64(0.13), np.float64(0.37), 5.3),
)
RULE = pytest.mark.parametrize("rule", LIST, ids=lambda rule: str(rule))
DTYPE = pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["f32", "f64"])


def scan(rule: Rule, llr: Tensor) -> Tensor:
    return rule.scan(llr, rule.start(llr.new_zeros(llr.shape[:-1])))[0]


def bytes_of(x: Tensor) -> bytes:
    return x.numpy().tobytes()


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


ORACLES: dict[str, Callable[..., list[float]]] = {
    "k_of_n": k_of_n,
    "cusum": cusum,
}


@RULE
@pytest.mark.parametrize(("dtype", "tol"), [(torch.float64, 1e-12), (torch.float32, 2e-5)])
@pytest.mark.parametrize("num", [0, 1, 200])
def test_equals_the_definition(rule: Rule, dtype, tol, num, rng: np.random.Generator) -> None:
    llr = torch.from_numpy(3 * rng.standard_normal((3, num))).to(dtype)
    expected = [ORACLES[rule.name](rule, row) for row in llr.tolist()]
    got = scan(rule, llr)
    torch.testing.assert_close(
        got,
        torch.tensor(expected, dtype=dtype).view(3, num),
        rtol=tol,
        atol=tol * (num if dtype.itemsize == 4 else 1),
    )


@RULE
def test_manners(rule: Rule, rng: np.random.Generator, device: torch.device) -> None:
    llr = torch.from_numpy(3 * rng.standard_normal((4, 30))).to(device)
    assert_manners(lambda x: scan(rule, x), llr)
    assert_manners(lambda x: scan(rule, x), llr.float(), rtol=1e-5)


@RULE
@DTYPE
@given(data=st.data())
def test_any_cut_gives_the_same_bits(rule: Rule, dtype: torch.dtype, data: st.DataObject) -> None:
    seed = data.draw(st.integers(0, 2**20))
    shape = data.draw(st.sampled_from([(), (1,), (5,), (2, 3), (3, 0)]))
    source = torch.Generator().manual_seed(seed)
    llr = 3 * torch.randn(*shape, 40, dtype=dtype, generator=source)
    state = rule.start(llr[..., 0])
    whole, end = rule.scan(llr, state)
    cuts = sorted(data.draw(st.lists(st.integers(0, 40), max_size=12)))
    pieces = []
    for first, last in zip([0, *cuts], [*cuts, 40], strict=True):
        piece, state = rule.scan(llr[..., first:last], state)
        assert piece.shape == (*shape, last - first)
        pieces.append(piece)
    assert bytes_of(torch.cat(pieces, -1)) == bytes_of(whole)
    assert bytes_of(state) == bytes_of(end)
    if not shape:
        start = rule.start(llr[0]).tolist()
        assert rule.scan_row(llr.tolist(), start, llr.numpy().dtype.type)[0] == whole.tolist()


@RULE
def test_a_state_holds_nothing_but_itself(rule: Rule) -> None:
    # a view would keep the whole of every piece alive
    llr = torch.randn(2, 500, generator=torch.Generator().manual_seed(0))
    _, state = rule.scan(llr, rule.start(llr[:, 0]))
    if state.numel():
        assert state.untyped_storage().nbytes() == state.numel() * state.element_size()


# ------------------------------------------------------------------------------------- gradients
@RULE
def test_gradients(rule: Rule, rng: np.random.Generator) -> None:
    llr = torch.from_numpy(rng.standard_normal((2, 9)))
    _, state = rule.scan(llr.roll(1, -1) + 0.01, rule.start(llr[:, 0]))
    if isinstance(rule, KOfN):  # no decision counts until it is one
        state = torch.from_numpy(rng.standard_normal(state.shape))
    llr.requires_grad_()
    state = state.detach().requires_grad_(bool(state.numel()))
    if not state.numel():  # gradcheck takes no empty tensor
        assert torch.autograd.gradcheck(lambda x: rule.scan(x, state)[0], (llr,), eps=1e-6)
        return
    assert torch.autograd.gradcheck(rule.scan, (llr, state), eps=1e-6)


@RULE
@DTYPE
@pytest.mark.parametrize("kind", ["ones", "huge", "least", "zeros", "steps"])
def test_finite_at_extremes_and_ties(rule: Rule, dtype: torch.dtype, kind: str) -> None:
    llr = {
        "ones": torch.ones(12),
        "huge": torch.full((12,), 1e30),
        "least": torch.full((12,), -1e30),
        "zeros": torch.zeros(12),
        "steps": torch.tensor([1e30, -1e30, 0.0, 0.0, -1e30, 1e30] * 2),
    }[kind].to(dtype)
    llr.requires_grad_()
    statistic = scan(rule, llr)
    assert bool(statistic.isfinite().all())
    statistic.sum().backward()
    assert llr.grad is not None
    assert bool(llr.grad.isfinite().all())


# ----------------------------------------------------------------------------------- as plain data
@RULE
def test_survives_json(rule: Rule) -> None:
    plain = json.loads(json.dumps(rule.to_dict(), allow_nan=False))
    assert rule_from_dict(plain) == rule
    assert type(rule_from_dict(plain)) is RULES[rule.name]


@pytest.mark.parametrize(
    ("plain", "said"),
    [
        ({"name": "viterbi"}, "no sequential rule is called 'viterbi'; there are k_of_n, "),
        ({}, "no sequential rule is called None"),
        ({"name": "k_of_n", "k": 2}, "do not fit.*'n'"),
        ({"name": "cusum", "drift": 0, "slope": 1}, "do not fit.*'slope'"),
        ({"name": "bayes"}, "no sequential rule is called 'bayes'; there are k_of_n, cusum"),
        ({"name": "k_of_n", "k": 4, "n": 3}, "between 1 and n, got k=4 and n=3"),
        ({"name": "k_of_n", "k": 0, "n": 3}, "between 1 and n, got k=0"),
        ({"name": "cusum", "evidence": 1.1}, r"evidence must lie in \(0, 1\], got 1.1"),
        ({"name": "cusum", "drift": math.inf}, "drift must be finite"),
        ({"name": "cusum", "ceiling": 0.0}, "ceiling must be positive"),
        ({"name": "cusum", "ceiling": math.nan}, "ceiling must be positive"),
    ],
)
def test_no_such_rule(plain: dict, said: str) -> None:
    with pytest.raises(ValueError, match=said) as error:
        rule_from_dict(plain)
    assert "\n" not in str(error.value)


@RULE
def test_a_state_of_other_streams_is_refused(rule: Rule) -> None:
    state = rule.start(torch.zeros(3))
    with pytest.raises(ValueError, match=r"expected llr \[\*, T\].*got \(2, 7\)"):
        rule.scan(torch.zeros(2, 7), state)
    with pytest.raises(ValueError, match="expected llr"):
        rule.scan(torch.tensor(1.0), state)


# ===================================================================================== the latch


def by_hand(
    values: list[float], threshold: float, rearm: int, refractory: int
) -> tuple[list[bool], list[bool]]:
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
drawn_times = st.fixed_dictionaries(
    {
        "rearm": st.integers(0, 5),
        "refractory": st.integers(0, 9),
    }
)


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


def test_what_is_no_number_is_neither_above_nor_below() -> None:
    alarms, _, _ = latch([2, 0, math.nan, 0, 2, 0, 0, 2], 1.0, rearm=2, refractory=0)
    assert np.flatnonzero(alarms).tolist() == [0, 7]
    values = [-math.inf, math.inf, -math.inf, math.inf]
    assert latch(values, math.inf, rearm=1, refractory=0)[0] == [False, True] * 2

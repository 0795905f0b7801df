"""Sequential rules against plain loops of their definitions, any cut, gradients, extremes."""

from __future__ import annotations

import json
import math
from collections import deque
from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from oracles import assert_manners
from scipy.linalg import expm
from torch import Tensor

from tactslip_torch.onset.sequential import (
    NEUTRAL,
    NOTHING_YET,
    RULES,
    BayesFilter,
    Cusum,
    Hysteresis,
    KOfN,
    Rule,
    rule_from_dict,
)

BAYES = BayesFilter(slips_per_s=0.3, slip_s=0.4, hop_s=0.01, evidence=0.2)
LIST = (
    KOfN(1, 1),
    KOfN(1, 4),
    KOfN(2, 3),
    KOfN(5, 5),
    KOfN(7, 20),
    Hysteresis(1.5),
    BAYES,
    BayesFilter(2.0, 5.0, 0.05),
    Cusum(),
    Cusum(drift=0.3, evidence=0.2, ceiling=3.0),
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


def transition(rule: BayesFilter) -> np.ndarray:
    """From [none, slip] to [none, slip] within a hop: the exponential of the rates."""
    begin, end = rule.slips_per_s, 1 / rule.slip_s
    return expm(np.array([[-begin, begin], [end, -end]]) * rule.hop_s)


def forward(rule: BayesFilter, llrs: list[float]) -> list[float]:
    """The forward algorithm of a hidden Markov model with explicit 2x2 matrices."""
    step = transition(rule)
    values, vectors = np.linalg.eig(step.T)  # at rest: the left eigenvector of eigenvalue 1
    alpha = vectors[:, np.argmax(values)]
    alpha = alpha / alpha.sum()
    found = []
    for llr in llrs:
        emission = np.diag([1.0, math.exp(rule.evidence * llr)])
        alpha = alpha @ step @ emission
        alpha = alpha / alpha.sum()
        found.append(math.log(alpha[1] / alpha[0]))
    return found


def cusum(rule: Cusum, llrs: list[float]) -> list[float]:
    total, found = 0.0, []
    for llr in llrs:
        total = min(max(total + rule.evidence * (llr - rule.drift), 0.0), rule.ceiling)
        found.append(total)
    return found


ORACLES: dict[str, Callable[..., list[float]]] = {
    "k_of_n": k_of_n,
    "hysteresis": lambda rule, llrs: llrs,
    "bayes": forward,
    "cusum": cusum,
}


@RULE
@pytest.mark.parametrize(("dtype", "tol"), [(torch.float64, 1e-12), (torch.float32, 2e-5)])
@pytest.mark.parametrize("num", [1, 2, 200])
def test_equals_the_definition(rule: Rule, dtype, tol, num, rng: np.random.Generator) -> None:
    llr = torch.from_numpy(3 * rng.standard_normal((3, num))).to(dtype)
    expected = [ORACLES[rule.name](rule, row) for row in llr.tolist()]
    got = scan(rule, llr)
    torch.testing.assert_close(
        got,
        torch.tensor(expected, dtype=dtype),
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


@RULE
def test_a_state_holds_nothing_but_itself(rule: Rule) -> None:
    # a view would keep the whole of every piece alive
    llr = torch.randn(2, 500, generator=torch.Generator().manual_seed(0))
    _, state = rule.scan(llr, rule.start(llr[:, 0]))
    if state.numel():
        assert state.untyped_storage().nbytes() == state.numel() * state.element_size()


@RULE
@given(where=st.integers(0, 39), by=st.floats(-1e30, 1e30), seed=st.integers(0, 2**20))
def test_later_decisions_change_nothing_before(rule: Rule, where, by, seed) -> None:
    llr = torch.randn(2, 40, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    other = llr.clone()
    other[:, where:] = by
    assert torch.equal(scan(rule, llr)[:, :where], scan(rule, other)[:, :where])
    if by > 100 and rule.name != "k_of_n":  # and the decision itself does count
        assert bool((scan(rule, llr)[:, where] != scan(rule, other)[:, where]).all())


@RULE
@DTYPE
def test_no_decision_at_all(rule: Rule, dtype: torch.dtype) -> None:
    for shape in [(), (3,), (2, 3)]:
        state = rule.start(torch.zeros(shape, dtype=dtype))
        statistic, after = rule.scan(torch.zeros(*shape, 0, dtype=dtype), state)
        assert (statistic.shape, statistic.dtype) == ((*shape, 0), dtype)
        assert torch.equal(after, state)
        assert after.dtype == dtype


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


def test_gradient_reaches_every_decision_that_counts() -> None:
    llr = torch.full((6,), 0.5, dtype=torch.float64, requires_grad=True)
    scan(BAYES, llr)[-1].backward()
    assert llr.grad is not None
    assert bool((llr.grad > 0).all())  # and the older the less
    assert bool((llr.grad.diff() > 0).all())


# ------------------------------------------------------------------------------- k of n, hysteresis
@given(data=st.data())
def test_k_of_n_reaches_a_threshold_if_k_of_the_last_n_do(data: st.DataObject) -> None:
    n = data.draw(st.integers(1, 8))
    k = data.draw(st.integers(1, n))
    llrs = data.draw(st.lists(st.integers(-3, 3), min_size=1, max_size=30))
    threshold = data.draw(st.integers(-3, 3))
    got = scan(KOfN(k, n), torch.tensor(llrs, dtype=torch.float64)) >= threshold
    hits = [llr >= threshold for llr in llrs]
    assert got.tolist() == [sum(hits[max(0, t - n + 1) : t + 1]) >= k for t in range(len(hits))]


def test_k_of_n_says_least_before_k_decisions() -> None:
    assert scan(KOfN(3, 5), torch.tensor([9.0, 8.0, 7.0])).tolist() == pytest.approx(
        [NOTHING_YET, NOTHING_YET, 7.0]
    )


def test_margins_and_ceilings() -> None:
    assert [(rule.margin, rule.ceiling) for rule in LIST if rule.name == "hysteresis"] == [
        (1.5, math.inf)
    ]
    assert {rule.margin for rule in LIST if rule.name != "hysteresis"} == {0.0}
    assert Cusum(ceiling=4.0).ceiling == 4.0
    assert {rule.ceiling for rule in LIST if rule.name != "cusum"} == {math.inf}


# ---------------------------------------------------------------------------------------- Bayes
@DTYPE
def test_certain_evidence_leaves_the_filter_able_to_change_its_mind(dtype: torch.dtype) -> None:
    none_to, slip_to = transition(BAYES)  # rows: where it comes from
    tol = 1e-12 if dtype == torch.float64 else 1e-5
    for certain, row in ((1e30, slip_to), (-1e30, none_to)):
        statistic = scan(BAYES, torch.tensor([certain, NEUTRAL, NEUTRAL], dtype=dtype))
        assert statistic[1].item() == pytest.approx(math.log(row[1] / row[0]), rel=tol)
        assert abs(statistic[2]) < abs(statistic[1])


def test_neutral_decisions_only_let_time_pass() -> None:
    llr = torch.zeros(50, dtype=torch.float64)
    rest = math.log(BAYES.slips_per_s * BAYES.slip_s)
    torch.testing.assert_close(scan(BAYES, llr), torch.full_like(llr, rest))
    # two hops are one of twice the length
    twice = BayesFilter(BAYES.slips_per_s, BAYES.slip_s, 2 * BAYES.hop_s, BAYES.evidence)
    start = torch.tensor([4.0], dtype=torch.float64)
    torch.testing.assert_close(
        BAYES.scan(llr, start)[0][1::2], twice.scan(llr[:25], start)[0], rtol=1e-12, atol=1e-12
    )


def test_slips_that_hardly_end_keep_their_digits_in_float32() -> None:
    rule = BayesFilter(slips_per_s=1e-9, slip_s=1e9, hop_s=0.01)
    llr = torch.cat([torch.full((30,), 2.0), torch.full((60,), -2.0)])
    exact = torch.tensor(forward(rule, llr.tolist()))
    assert float(exact.max()) > 20
    torch.testing.assert_close(scan(rule, llr), exact, rtol=1e-5, atol=1e-3)


def test_bayes_filter_is_calibrated_on_the_chain_it_assumes() -> None:
    # of decisions to which it gives odds of p, a share p is slip
    rule = BayesFilter(slips_per_s=2.0, slip_s=0.5, hop_s=0.02)
    source = np.random.default_rng(1)
    step = transition(rule)
    num, length = 400, 400
    is_slip = source.random(num) < rule.slips_per_s * rule.slip_s / 2
    llrs, truth = [], []
    for _ in range(length):
        is_slip = source.random(num) < step[is_slip.astype(int), 1]
        x = source.standard_normal(num) + 0.8 * is_slip  # N(0, 1) or N(0.8, 1)
        llrs.append(0.8 * x - 0.32)
        truth.append(is_slip)
    p = torch.sigmoid(scan(rule, torch.from_numpy(np.stack(llrs, -1)))).numpy()
    truth = np.stack(truth, -1)
    for low, high in [(0, 0.2), (0.2, 0.4), (0.4, 0.6), (0.6, 0.8), (0.8, 1)]:
        here = (p >= low) & (p < high)
        assert here.sum() > 2000
        assert truth[here].mean() == pytest.approx(p[here].mean(), abs=0.02)


# ---------------------------------------------------------------------------------------- CUSUM
@given(llrs=st.lists(st.floats(-50, 50), min_size=1, max_size=60), drift=st.floats(-2, 2))
def test_cusum_without_ceiling_is_the_sum_above_its_minimum(llrs: list[float], drift) -> None:
    steps = np.array(llrs) - drift
    sums = np.cumsum(steps)
    least = np.minimum.accumulate(np.minimum(sums, 0))
    got = scan(Cusum(drift=drift), torch.tensor(llrs, dtype=torch.float64))
    np.testing.assert_allclose(got.numpy(), sums - least, atol=1e-9)


def test_ceiling_bounds_how_long_the_sum_takes_to_come_down() -> None:
    rule = Cusum(drift=0.5, evidence=0.5, ceiling=10.0)
    statistic = scan(rule, torch.cat([torch.full((200,), 5.0), torch.zeros(60)]))
    assert float(statistic.max()) == 10.0
    assert int((statistic[200:] > 0).sum()) == 39  # 10 / 0.25, and the last of them is 0


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
        ({"name": "bayes", "slips_per_s": None, "slip_s": 1, "hop_s": 1}, "do not fit"),
        ({"name": "k_of_n", "k": 4, "n": 3}, "k=4 and n=3"),
    ],
)
def test_no_such_rule(plain: dict, said: str) -> None:
    with pytest.raises(ValueError, match=said) as error:
        rule_from_dict(plain)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: KOfN(0, 3), "between 1 and n, got k=0"),
        (lambda: KOfN(4, 3), "between 1 and n, got k=4"),
        (lambda: Hysteresis(-0.1), "not negative, got -0.1"),
        (lambda: Hysteresis(math.inf), "finite"),
        (lambda: BayesFilter(0.0, 1.0, 0.01), "slips_per_s must be positive"),
        (lambda: BayesFilter(1.0, -1.0, 0.01), "slip_s must be positive"),
        (lambda: BayesFilter(1.0, 1.0, math.nan), "hop_s must be positive"),
        (lambda: BayesFilter(1.0, 1.0, 0.01, 0.0), r"evidence must lie in \(0, 1\], got 0.0"),
        (lambda: Cusum(evidence=1.1), r"evidence must lie in \(0, 1\], got 1.1"),
        (lambda: Cusum(drift=math.inf), "drift must be finite"),
        (lambda: Cusum(ceiling=0.0), "ceiling must be positive"),
        (lambda: Cusum(ceiling=math.nan), "ceiling must be positive"),
    ],
)
def test_numbers_that_make_no_rule(make: Callable[[], Rule], said: str) -> None:
    with pytest.raises(ValueError, match=said) as error:
        make()
    assert "\n" not in str(error.value)


@RULE
def test_a_state_of_other_streams_is_refused(rule: Rule) -> None:
    state = rule.start(torch.zeros(3))
    with pytest.raises(ValueError, match=r"expected llr \[\*, T\].*got \(2, 7\)"):
        rule.scan(torch.zeros(2, 7), state)
    with pytest.raises(ValueError, match="expected llr"):
        rule.scan(torch.tensor(1.0), state)

"""Sequential rules: log likelihood ratios of decisions in, one statistic per decision out.

A single bin decides too little: at the paper's error rates a hand that watches every bin would
raise an alarm each second. A rule gathers evidence over several decisions, of which the paper's
outlook asks for a probability model. Every rule is causal, keeps a state of fixed size, and makes
the same statistic whatever pieces a stream comes in. Where the statistic has to lie for an alarm
is not its business (``onset.latch``, ``onset.rate``).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, ClassVar, Protocol

import torch
from torch import Tensor

NEUTRAL = 0.0
"""The log likelihood ratio of a decision that says nothing; it stands for invalid ones."""

NOTHING_YET = -1e30
"""What ``KOfN`` takes for decisions before the first; finite, and below every real one."""


class Rule(Protocol):
    """From log likelihood ratios to a statistic; a frozen dataclass of plain numbers.

    A decision that is not valid, or whose ratio is not finite, is to be made ``NEUTRAL`` by the
    caller. Finite ratios up to 1e30 of either sign give finite statistics and gradients.
    """

    @property
    def name(self) -> str:
        """Under which ``rule_from_dict`` knows it."""

    @property
    def margin(self) -> float:
        """How far below the threshold the statistic must fall to re-arm, 0 for most."""

    @property
    def ceiling(self) -> float:
        """What the statistic never exceeds; infinite if the rule sets no bound."""

    def start(self, like: Tensor) -> Tensor:
        """The state before the first decision, ``[*, S]`` for one ratio ``[*]`` of each stream."""

    def scan(self, llr: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """The statistic ``[*, T]`` of ratios ``[*, T]``, and the state after them.

        ``T`` may be 0; any cut of a stream gives the same bits. Differentiable in both.
        """

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types that ``rule_from_dict`` reads."""


@dataclass(frozen=True)
class KOfN:
    """The k-th largest of the last n log likelihood ratios.

    It reaches a threshold exactly if k of the last n do: the usual debounce. Among fewer than k
    decisions it is ``NOTHING_YET``. At ties the gradient goes to one of the equals.

    Raises:
        ValueError: unless ``1 <= k <= n``.
    """

    k: int
    n: int
    name: ClassVar[str] = "k_of_n"
    margin: ClassVar[float] = 0.0
    ceiling: ClassVar[float] = math.inf

    def __post_init__(self) -> None:
        if not 1 <= self.k <= self.n:
            raise ValueError(f"k must lie between 1 and n, got k={self.k} and n={self.n}")

    def start(self, like: Tensor) -> Tensor:
        """No decision yet: ``[*] -> [*, n - 1]``."""
        return like.new_full((*like.shape, self.n - 1), NOTHING_YET)

    def scan(self, llr: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """The k-th largest of each decision and the ``n - 1`` before it, ``[*, T]``."""
        _check(llr, state, self.n - 1)
        if llr.shape[-1] == 0:
            return llr, state
        known = torch.cat([state, llr], dim=-1)  # [*, n - 1 + T]
        statistic = known.unfold(-1, self.n, 1).kthvalue(self.n - self.k + 1, dim=-1).values
        return statistic, known[..., known.shape[-1] - self.n + 1 :].clone()

    def to_dict(self) -> dict[str, Any]:
        """Name, k and n."""
        return {"name": self.name, **asdict(self)}


@dataclass(frozen=True)
class Hysteresis:
    """The log likelihood ratio itself, re-armed only ``margin`` below the threshold.

    Raises:
        ValueError: if the margin is negative or not finite.
    """

    margin: float
    name: ClassVar[str] = "hysteresis"
    ceiling: ClassVar[float] = math.inf

    def __post_init__(self) -> None:
        if not 0 <= self.margin < math.inf:
            raise ValueError(f"margin must be finite and not negative, got {self.margin}")

    def start(self, like: Tensor) -> Tensor:
        """Nothing to remember: ``[*] -> [*, 0]``."""
        return like.new_empty((*like.shape, 0))

    def scan(self, llr: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """The ratios as they came, ``[*, T]``."""
        _check(llr, state, 0)
        return llr, state

    def to_dict(self) -> dict[str, Any]:
        """Name and margin."""
        return {"name": self.name, **asdict(self)}


@dataclass(frozen=True)
class BayesFilter:
    r"""Log odds of slip given all decisions so far, by a two-state forward filter.

    Slip begins at ``slips_per_s`` and ends at ``1 / slip_s``, whatever came before (a Markov chain
    in continuous time, looked at every ``hop_s``). With ``h`` the hop, ``r`` the sum of the two
    rates, ``c = exp(-r h)``, ``a = (1 - c) slips_per_s / r``, ``b = (1 - c) / (slip_s r)`` and
    ``p`` the probability of slip before:

    .. math:: L_t = \log\frac{a + c\,p_{t-1}}{b + c\,(1 - p_{t-1})} + evidence \cdot llr_t

    The first decision finds the chain at rest, at odds ``slips_per_s * slip_s``.

    Args:
        slips_per_s: slips that begin in a second without slip.
        slip_s: how long a slip lasts, in the mean.
        hop_s: distance of two decisions.
        evidence: share of a ratio that is new, in (0, 1]; overlapping bins tell less than as many
            apart, and hop / bin is the natural value.

    Raises:
        ValueError: if a rate or time is not positive and finite, or evidence out of range.

    Reference:
        Rabiner (1989), Proc. IEEE 77(2), 257-286, the forward recursion of section III.
    """

    slips_per_s: float
    slip_s: float
    hop_s: float
    evidence: float = 1.0
    name: ClassVar[str] = "bayes"
    margin: ClassVar[float] = 0.0
    ceiling: ClassVar[float] = math.inf

    def __post_init__(self) -> None:
        for name in ("slips_per_s", "slip_s", "hop_s"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be positive and finite, got {getattr(self, name)}")
        _check_evidence(self.evidence)

    def start(self, like: Tensor) -> Tensor:
        """Log odds at rest: ``[*] -> [*, 1]``."""
        return like.new_full((*like.shape, 1), math.log(self.slips_per_s * self.slip_s))

    def scan(self, llr: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Log odds of slip after each decision, ``[*, T]``."""
        _check(llr, state, 1)
        rate = self.slips_per_s + 1 / self.slip_s
        stay = math.exp(-rate * self.hop_s)
        begin = -math.expm1(-rate * self.hop_s) * self.slips_per_s / rate
        end = -math.expm1(-rate * self.hop_s) / (self.slip_s * rate)
        odds = state[..., 0]
        statistic = []
        for evidence in _by_decision(llr * self.evidence):
            is_slip = torch.log(begin + stay * torch.sigmoid(odds))  # sums of positive terms
            is_none = torch.log(end + stay * torch.sigmoid(-odds))
            odds = is_slip - is_none + evidence
            statistic.append(odds)
        return _together(statistic, llr), odds.unsqueeze(-1)

    def to_dict(self) -> dict[str, Any]:
        """Name, rates, hop and evidence."""
        return {"name": self.name, **asdict(self)}


@dataclass(frozen=True)
class Cusum:
    """Evidence for slip since it last seemed certain that there is none.

    ``S = clamp(S + evidence * (llr - drift), 0, ceiling)``, from 0. Page's test is drift 0 and no
    ceiling; a drift lets ratios that are a little positive for long fade, and the ceiling bounds
    how long the sum takes to come down after a slip. The gradient passes where a bound is met
    exactly, and is 0 beyond.

    Args:
        drift: ratio that a decision must exceed to add to the sum.
        evidence: share of a ratio that is new, in (0, 1], as in ``BayesFilter``.
        ceiling: largest sum; infinite for none.

    Raises:
        ValueError: if drift is not finite, evidence out of range or the ceiling not positive.

    Reference:
        Page (1954), Biometrika 41, 100-115.
    """

    drift: float = 0.0
    evidence: float = 1.0
    ceiling: float = math.inf
    name: ClassVar[str] = "cusum"
    margin: ClassVar[float] = 0.0

    def __post_init__(self) -> None:
        if not math.isfinite(self.drift):
            raise ValueError(f"drift must be finite, got {self.drift}")
        _check_evidence(self.evidence)
        if not self.ceiling > 0:
            raise ValueError(f"ceiling must be positive, got {self.ceiling}")

    def start(self, like: Tensor) -> Tensor:
        """Nothing gathered: ``[*] -> [*, 1]``."""
        return like.new_zeros((*like.shape, 1))

    def scan(self, llr: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """The sum after each decision, ``[*, T]``."""
        _check(llr, state, 1)
        total = state[..., 0]
        statistic = []
        for step in _by_decision(self.evidence * (llr - self.drift)):
            total = (total + step).clamp(0.0, self.ceiling)
            statistic.append(total)
        return _together(statistic, llr), total.unsqueeze(-1)

    def to_dict(self) -> dict[str, Any]:
        """Name, drift, evidence and ceiling, None for an infinite one."""
        plain = {"name": self.name, **asdict(self)}
        return plain if self.ceiling < math.inf else {**plain, "ceiling": None}


RULES: Mapping[str, type[KOfN | Hysteresis | BayesFilter | Cusum]] = {
    rule.name: rule for rule in (KOfN, Hysteresis, BayesFilter, Cusum)
}
"""Every rule by its name."""


def rule_from_dict(plain: Mapping[str, Any]) -> Rule:
    """The rule that ``to_dict`` wrote.

    Raises:
        ValueError: if there is no such rule, or a number of it is missing, unknown or refused.
    """
    numbers = dict(plain)
    name = numbers.pop("name", None)
    if name not in RULES:
        raise ValueError(f"no sequential rule is called {name!r}; there are {', '.join(RULES)}")
    if numbers.get("ceiling", 0) is None:
        numbers["ceiling"] = math.inf
    try:
        return RULES[name](**numbers)
    except TypeError as error:
        raise ValueError(f"numbers of the rule {name!r} do not fit: {error}") from error


def _check(llr: Tensor, state: Tensor, size: int) -> None:
    if llr.ndim == 0 or state.shape != (*llr.shape[:-1], size):
        raise ValueError(
            f"expected llr [*, T] and the state [*, {size}] that start or scan gave, "
            f"got {tuple(llr.shape)} and {tuple(state.shape)}"
        )


def _check_evidence(evidence: float) -> None:
    if not 0 < evidence <= 1:
        raise ValueError(f"evidence must lie in (0, 1], got {evidence}")


def _by_decision(x: Tensor) -> Iterable[Tensor]:
    """``[*, T]`` as ``T`` contiguous tensors ``[*]``: the same kernels run for any ``T``."""
    return x.movedim(-1, 0).contiguous().unbind(0)


def _together(statistic: list[Tensor], llr: Tensor) -> Tensor:
    return torch.stack(statistic, dim=-1) if statistic else llr

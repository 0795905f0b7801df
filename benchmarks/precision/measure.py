"""The measurements of ``benchmarks.precision``: scores, seconds, bytes; no judgement.

A variant is a way to features and a dtype of the head. Every variant scores the same held-out bins;
machines that are fitted again are fitted to the same training bins, with ranking, scaling and C
held.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from benchmarks.arithmetic import ARITHMETIC, FLOAT64, NATIVE, WIDE
from benchmarks.clocks import Way, in_turns, say, shuffled_rounds
from benchmarks.precision.data import ROLES, Experiment, described, pool_in
from benchmarks.precision.sizes import Sizes
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.kernel_elm import solve_kernel_elm_
from tactslip_torch.model.kernels import lower_gram
from tactslip_torch.model.quadratic import QuadraticForm, collapse
from tactslip_torch.training.recipe import recalls_mean

OF_FLOAT32, IN_FLOAT32 = "float64, of float32 features", "float32 matrix"  # solves
HALVES = {"bfloat16": torch.bfloat16, "float16": torch.float16}


class Variant(NamedTuple):
    """What is compared.

    Attributes:
        features: name of the arithmetic they are made by.
        head: dtype of scaled features and of the quadratic form; scaling is in float64.
        solve: the solve its machine comes from; a key of ``SOLVES``.
    """

    features: str
    head: torch.dtype
    solve: str


VARIANTS = {
    "float64": Variant(FLOAT64, torch.float64, FLOAT64),
    "float32": Variant(WIDE, torch.float32, FLOAT64),
    "float32 throughout": Variant(NATIVE, torch.float32, FLOAT64),
    "refitted, float64 solve": Variant(NATIVE, torch.float32, OF_FLOAT32),
    "refitted, float32 solve": Variant(NATIVE, torch.float32, IN_FLOAT32),
    "bfloat16 head": Variant(WIDE, torch.bfloat16, FLOAT64),
    "float16 head": Variant(WIDE, torch.float16, FLOAT64),
}
"""The first is what the others are compared with; refitted: to features in float32 throughout."""


class Fitted(NamedTuple):
    """A machine and how it was solved; without a machine, why not."""

    head: QuadraticForm | None
    condition: float | None
    refused: str | None


# -------------------------------------------------------------------------------------- solves
def _by_the_rule(experiment: Experiment, arithmetic: str, gram_dtype: torch.dtype) -> Fitted:
    """As the package solves a Gram matrix of this dtype, or the reason why it does not."""
    z = experiment.plan.frame(experiment.train.features[arithmetic]).to(gram_dtype)
    targets = torch.where(experiment.train.is_slip, 1.0, -1.0).to(gram_dtype)
    weights = experiment.weights.to(gram_dtype)
    plan = experiment.plan
    gram = lower_gram(plan.kernel, z)
    try:
        beta, report = solve_kernel_elm_(gram, targets, plan.penalty, weights)
    except ValueError as error:
        return Fitted(None, None, str(error))
    return Fitted(collapse(z, beta, plan.kernel), report.condition, None)


def _bare(experiment: Experiment, arithmetic: str) -> Fitted:
    """A Cholesky in float32 that asks nothing; the package has no such thing."""
    z = experiment.plan.frame(experiment.train.features[arithmetic]).float()
    targets = torch.where(experiment.train.is_slip, 1.0, -1.0).float()
    plan = experiment.plan
    gram = plan.kernel(z, z)
    gram.diagonal().add_(1 / (plan.penalty * experiment.weights.float()))
    factor, info = torch.linalg.cholesky_ex(gram)
    if bool(info.any()):
        return Fitted(None, None, "not positive definite in float32")
    beta = torch.cholesky_solve(targets[:, None], factor).squeeze(1)
    return Fitted(collapse(z, beta, plan.kernel), None, None)


SOLVES: dict[str, Callable[[Experiment], Fitted]] = {
    FLOAT64: lambda experiment: _by_the_rule(experiment, FLOAT64, torch.float64),
    OF_FLOAT32: lambda experiment: _by_the_rule(experiment, NATIVE, torch.float64),
    IN_FLOAT32: lambda experiment: _by_the_rule(experiment, NATIVE, torch.float32),
    "bare float32 Cholesky": lambda experiment: _bare(experiment, NATIVE),
}
"""By what they solve. Under the package's rule a float32 matrix is promoted or refused."""


def solves(experiment: Experiment, sizes: Sizes) -> tuple[dict[str, Fitted], list[dict[str, Any]]]:
    """Every machine; and rows of the seconds it took with its Gram matrix, and what it lost.

    Errors are those of the solve alone: on the same float32 features, scored in float64, beside
    the machine that float64 makes of them.
    """
    calls = {name: partial(solve, experiment) for name, solve in SOLVES.items()}
    found = in_turns(calls, sizes.repeats, "solve")
    machines = {name: machine for name, (_, machine) in found.items()}
    truth = judge(experiment, NATIVE, machines[OF_FLOAT32], torch.float64)
    assert truth is not None  # a float64 matrix is never refused for its precision
    rows = []
    for name, (seconds, fitted) in found.items():
        row = {"name": name, "seconds": seconds, "condition": fitted.condition}
        scores = judge(experiment, NATIVE, fitted, torch.float64)
        lost = errors(None if name == FLOAT64 else scores, truth)  # of other features
        rows.append(row | {"refused": fitted.refused} | lost)
    return machines, rows


# -------------------------------------------------------------------------------------- scores
def judge(
    experiment: Experiment, arithmetic: str, fitted: Fitted, dtype: torch.dtype
) -> Tensor | None:
    """Scores of all held-out bins, as float64; none from a machine that was refused."""
    if fitted.head is None:
        return None
    score = detector(experiment, fitted.head, dtype).score_features(
        selected(experiment, experiment.all_judged(arithmetic))
    )
    return score.double()


def detector(experiment: Experiment, head: QuadraticForm, dtype: torch.dtype) -> SlipDetector:
    """The machine as the package runs it in this dtype: it scales in float64 all the same."""
    frame = experiment.plan.frame
    parts = (experiment.pool, experiment.channel_filter, frame.selected)
    whole = SlipDetector(*parts, deepcopy(frame.scaler), deepcopy(head))  # to() works in place
    return whole.to(dtype)


def selected(experiment: Experiment, features: Tensor) -> Tensor:
    """The features in use, ``[N, K]``."""
    return features[:, list(experiment.plan.frame.selected)]


def errors(scores: Tensor | None, truth: Tensor) -> dict[str, Any]:
    """Errors of scores in standard deviations of the true ones, and decisions that flip.

    ``None`` where there are no scores, or one is not finite.
    """
    if scores is None or not bool(scores.isfinite().all()):
        return dict.fromkeys(("median_error", "worst_error", "flipped"))
    error = (scores - truth).abs() / truth.std()
    return {
        "median_error": float(error.median()),
        "worst_error": float(error.max()),
        "flipped": int(((scores >= 0) != (truth >= 0)).sum()),
    }


def accuracy(experiment: Experiment, scores: Tensor | None) -> dict[str, float | None]:
    """Balanced accuracy by role."""
    if scores is None:
        return dict.fromkeys(ROLES)
    parts = scores.split([len(experiment.judged[role].is_slip) for role in ROLES])
    return {
        role: recalls_mean(part >= 0, experiment.judged[role].is_slip)
        for role, part in zip(ROLES, parts, strict=True)
    }


# ---------------------------------------------------------------------------- seconds and bytes
def feature_seconds(experiment: Experiment, sizes: Sizes) -> dict[str, list[float]]:
    """Seconds a bin for its features, in every round, by arithmetic."""
    bins = _again(experiment.judged["test"].bins, sizes.timed_bins)
    ways = {
        name: Way(partial(described, pool_in(experiment.pool, name), bins.to(way.dtype)))
        for name, way in ARITHMETIC.items()
    }
    with torch.inference_mode():
        found = shuffled_rounds(ways, sizes.rounds, sizes.seed)
    return {name: [taken / len(bins) for taken in seconds] for name, seconds in found.items()}


def head_seconds(
    experiment: Experiment, head: QuadraticForm, sizes: Sizes
) -> dict[str, list[float]]:
    """Seconds a bin for scaling and score, in every round, by features and dtype of the head."""
    ways = {}
    for arithmetic, dtype in {(of.features, of.head) for of in VARIANTS.values()}:
        features = _again(experiment.all_judged(arithmetic), sizes.scored_bins)
        score = detector(experiment, head, dtype).score_features
        call = partial(score, selected(experiment, features).contiguous())
        ways[head_name(arithmetic, dtype)] = Way(call)
    with torch.inference_mode():
        found = shuffled_rounds(dict(sorted(ways.items())), sizes.rounds, sizes.seed)
    return {name: [t / sizes.scored_bins for t in seconds] for name, seconds in found.items()}


def head_name(arithmetic: str, dtype: torch.dtype) -> str:
    """A key of ``head_seconds``."""
    return f"{str(dtype).removeprefix('torch.')} on {arithmetic}"


def num_bytes(experiment: Experiment, head: QuadraticForm, variant: Variant) -> dict[str, int]:
    """Of a bin, of its features, of scaling and head, and of the three."""
    features = experiment.judged["test"].features[variant.features]
    whole = detector(experiment, head, variant.head)
    pool = experiment.pool
    found = {
        "bin": len(pool.hand) * pool.bin_samples * ARITHMETIC[variant.features].dtype.itemsize,
        "features": features[0].nbytes,
        "head": sum(of.nbytes for part in (whole.scaler, whole.head) for of in part.buffers()),
    }
    return found | {"all": sum(found.values())}


def refusals(experiment: Experiment) -> dict[str, str]:
    """What the pool says to bins in half precision."""
    found = {}
    for name, dtype in HALVES.items():
        try:
            experiment.pool(experiment.judged["test"].bins[:1].to(dtype))
        except ValueError as error:
            found[name] = str(error)
    return found


@torch.no_grad()
def measure_variants(experiment: Experiment, sizes: Sizes) -> dict[str, Any]:
    """Everything that is measured, JSON-able."""
    machines, solve_rows = solves(experiment, sizes)
    head = machines[FLOAT64].head
    truth = judge(experiment, FLOAT64, machines[FLOAT64], torch.float64)
    assert head is not None and truth is not None  # noqa: PT018  as in solves
    say("timing")
    of_features = feature_seconds(experiment, sizes)
    of_heads = head_seconds(experiment, head, sizes)
    rows = []
    for name, variant in VARIANTS.items():
        fitted = machines[variant.solve]
        scores = judge(experiment, variant.features, fitted, variant.head)
        rows.append(
            {
                "name": name,
                "features": variant.features,
                "head": str(variant.head).removeprefix("torch."),
                "solve": variant.solve,
                "refused": fitted.refused,
                "features_s": of_features[variant.features],
                "head_s": of_heads[head_name(variant.features, variant.head)],
                "bytes": num_bytes(experiment, head, variant),
                "balanced_accuracy": accuracy(experiment, scores),
                **errors(scores, truth),
            }
        )
    return {"variants": rows, "solves": solve_rows, "pool_refuses": refusals(experiment)}


def _again(rows: Tensor, num: int) -> Tensor:
    """``num`` rows, from the start again if they are too few."""
    return rows[torch.arange(num) % len(rows)].clone()

"""Gradients through the fit, beside autograd through the factorisation.

``python -m benchmarks.gradients``: a loss on other bins, or of groups left out, and its gradient in
features, C, c and weights; each in a process of its own, with the memory that it took.
"""

from __future__ import annotations

from dataclasses import dataclass
from statistics import median
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import softplus

from benchmarks.harness import Benchmark, Job, say
from benchmarks.tables import Table
from benchmarks.timing import in_fresh_process, peak_bytes, timed
from tactslip_torch.model.fit import (
    HeldOut,
    TrainingBins,
    fit_machine,
    fit_quadratic,
    held_out_scores,
)
from tactslip_torch.model.kernels import Polynomial

FORWARD, OURS, PEER = "forward alone", "differentiable", "autograd"
NUM_GROUPS, NUM_SCORED, PENALTY, OFFSET = 6, 1000, 1.0, 0.5


@dataclass(frozen=True)
class Gradients(Benchmark):
    """Every way of every problem, in turns.

    Args:
        problems: to go back through: the machine of all bins (``fit``) or the scores of groups left
            out, numbers of bins and of features, and whether autograd goes through the same.
        rounds: of every way.
        threads: of every process.
    """

    title = "Gradients through the fit"
    about = "a loss and its gradient in features, C, c and weights, on synthetic bins"
    charts: ClassVar = {"": (("Forward and back", ("forward, s", "backward, s")),)}
    quick = "problems=[[left_out,200,12,true]] rounds=1"
    is_simulated = False
    problems: tuple[tuple[str, int, int, bool], ...] = (
        ("fit", 8000, 120, True),
        ("fit", 2000, 120, True),
        ("left_out", 4800, 120, False),
        ("left_out", 2000, 60, True),
    )
    rounds: int = 3
    threads: int = 2

    def measure(self, job: Job) -> dict[str, Any]:
        """Seconds and bytes of every round, each in a process of its own."""
        rounds: dict[tuple[str, str], list[Any]] = {}
        for _ in range(self.rounds):
            for kind, num_bins, num_features, has_peer in self.problems:
                about = f"{kind.replace('_', ' ')}, {num_bins:,} x {num_features}"
                for way in (FORWARD, OURS, *([PEER] if has_peer else [])):
                    say(f"gradients: {about}, {way}")
                    sizes = {"num_bins": num_bins, "num_features": num_features}
                    given: dict[str, Any] = {"kind": kind, "way": way, "threads": self.threads}
                    answer = in_fresh_process("benchmarks.gradients:one_way", **sizes, **given)
                    rounds.setdefault((about, way), []).append(answer)
        cells = []
        for (about, way), own in rounds.items():
            peer, differs = rounds.get((about, PEER)), None
            if peer is not None and way == OURS:
                ours, theirs = np.array([own[0]["gradient"], peer[0]["gradient"]])
                differs = float(np.abs((ours - theirs) / theirs).max())
            cells.append(
                {
                    "bins x features": f"{about}: {way}",
                    "forward, s": [of["forward_s"] for of in own],
                    "backward, s": None if way == FORWARD else [of["backward_s"] for of in own],
                    "memory, MB": median(of["bytes"] for of in own) / 1e6,
                    "off autograd": differs,
                }
            )
        note = f"{self.threads} threads; memory: the most beyond what was held before."
        return {"tables": {"Forward and back": Table(cells, note)}}


def synthetic_bins(num_bins: int, num_features: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Bounded, correlated features ``[N, K]`` in float64, and labels ``[N]`` by a quadratic rule.

    They are correlated about as the main job's scaled features are; noise mislabels some bins.
    """
    rule = np.random.default_rng(num_features)
    mix = 0.25 * rule.normal(size=(16, num_features)) * np.arange(1.0, 17)[:, None] ** -0.7
    directions = rule.normal(size=(3, num_features)) / np.sqrt(num_features)
    draws = np.random.default_rng([seed, 1])
    common = draws.normal(size=(num_bins, 16)) @ mix
    z = np.tanh(common + 0.15 * draws.normal(size=(num_bins, num_features)))
    a, b, c = directions @ z.T / (directions @ z.T).std(1, keepdims=True)
    score = a * b + c + 0.3 * draws.normal(size=num_bins)
    return torch.from_numpy(z), torch.from_numpy(score > 0)


def one_way(kind: str, num_bins: int, num_features: int, way: str, threads: int) -> dict[str, Any]:
    """One loss and its gradient, after a small one that loads and starts what there is.

    Returns:
        ``forward_s``, ``backward_s`` (``None`` of the way that has none), ``bytes``, the most
        beyond what was held before, ``loss``, and ``gradient``, its size along drawn directions.
    """
    torch.set_num_threads(threads)
    _loss(kind, way, *_learned(min(300, num_bins), num_features))
    tensors = _learned(num_bins, num_features)
    before, backward_s, gradient = peak_bytes(), None, None
    forward_s, loss = timed(lambda: _loss(kind, way, *tensors))
    if way != FORWARD:
        backward_s, slopes = timed(lambda: torch.autograd.grad(loss, tensors))
        generator = torch.Generator().manual_seed(0)
        draws = [torch.randn(s.shape, generator=generator, dtype=s.dtype) for s in slopes]
        gradient = [float((s * draw).sum()) for s, draw in zip(slopes, draws, strict=True)]
    return {
        "forward_s": forward_s,
        "backward_s": backward_s,
        "bytes": peak_bytes() - before,
        "loss": loss.item(),
        "gradient": gradient,
    }


def _learned(num_bins: int, num_features: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """What a gradient is wanted of: features, C, c and weights."""
    z, _ = synthetic_bins(num_bins, num_features)
    penalty, offset = (torch.tensor(of, dtype=torch.float64) for of in (PENALTY, OFFSET))
    weights = torch.linspace(0.5, 1.5, num_bins, dtype=torch.float64)
    for tensor in (z, penalty, offset, weights):
        tensor.requires_grad_()
    return z, penalty, offset, weights


def _loss(
    kind: str, way: str, z: Tensor, penalty: Tensor, offset: Tensor, weights: Tensor
) -> Tensor:
    """Mean logistic loss on other bins, or of groups left out."""
    _, is_slip = synthetic_bins(*z.shape)
    groups = torch.arange(len(z)) % NUM_GROUPS
    new, new_is_slip = synthetic_bins(NUM_SCORED, z.shape[1], seed=1)
    targets = torch.where(is_slip, 1.0, -1.0).double()
    fixed = TrainingBins(z.detach(), is_slip, weights.detach())
    kernel = Polynomial(2, offset.item())

    def by_autograd(rows: Tensor, of: Tensor) -> Tensor:
        """Scores of rows by a fit to others, as anybody would write it first."""
        system = (z[of] @ z[of].mT + offset) ** 2 + torch.diag(1 / (penalty * weights[of]))
        beta = torch.cholesky_solve(targets[of, None], torch.linalg.cholesky(system))[:, 0]
        return (rows @ z[of].mT + offset) ** 2 @ beta

    if kind == "fit":
        every = torch.ones_like(is_slip)
        if way == FORWARD:
            scores = fit_machine(fixed, penalty.item(), kernel)(new)
        elif way == OURS:
            scores = fit_quadratic(z, is_slip, penalty, offset, weights)(new)
        else:
            scores = by_autograd(new, every)
        truth = new_is_slip
    else:
        truth = is_slip
        if way == FORWARD:
            scores = HeldOut(fixed, groups, kernel).at(penalty.item()).scores
        elif way == OURS:
            scores = held_out_scores(z, is_slip, groups, penalty, offset, weights)
        else:
            scores = torch.zeros_like(targets)
            for group in groups.unique():
                own = groups == group
                scores = scores.index_put((own,), by_autograd(z[own], ~own))
    return softplus(torch.where(truth, -scores, scores)).mean()


if __name__ == "__main__":
    raise SystemExit(Gradients().run())

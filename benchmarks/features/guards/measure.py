"""What guards cost: seconds of every round, no judgement.

Bins are simulated: those of one recording, filtered as in training; a solve takes synthetic
features. What is compared is timed in one process, in an order of its own in every round.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor

from benchmarks.arithmetic import ARITHMETIC
from benchmarks.bins import WINDOW_LENGTHS, simulated_bins
from benchmarks.clocks import Way, on_threads, say, shuffled_rounds
from benchmarks.features.guards.off import guards_off, textbook
from benchmarks.features.sizes import Sizes
from benchmarks.machine import threads_text
from benchmarks.model.synthetic import SyntheticBins
from tactslip_torch.features.extractor import FeatureExtractor
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.hand import HandLayout
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.kernels import PAPER_KERNEL, QuadraticForm, gram_matrix
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.model.solve import solve_symmetric
from tactslip_torch.signals.filtering import ChannelFilter

NUM_FEATURES, PENALTY = 120, 0.1  # of the machine that is timed


def extract(sizes: Sizes) -> dict[str, Any]:
    """Features of bins with guards, without, and by the textbook."""
    rows = []
    for threads in sizes.threads:
        say(f"extract on {threads_text(threads)}")
        ways: dict[str, Way] = {}
        for name, (dtype, arithmetic) in ARITHMETIC.items():
            pool = FeaturePool(HandLayout.paper24(), arithmetic=arithmetic)
            call = partial(_reference(pool), simulated_bins(sizes.bins).to(dtype))
            ways |= {
                f"{name} guards": Way(call),
                f"{name} off": Way(call, guards_off),
                f"{name} textbook": Way(call, textbook),
            }
        with torch.inference_mode(), on_threads(threads):
            seconds = shuffled_rounds(ways, sizes.rounds, sizes.seed)
        rows += [
            {"bins": sizes.bins, "arithmetic": name, "threads": threads}
            | {f"{kind}_s": seconds[f"{name} {kind}"] for kind in ("guards", "off", "textbook")}
            for name in ARITHMETIC
        ]
    return {"rows": rows}


def score(sizes: Sizes) -> dict[str, Any]:
    """``SlipDetector.judge`` beside its bare score without guards."""
    rows = []
    for threads in sizes.threads:
        for num_bins in sizes.scored:
            say(f"scores of {num_bins} at a time on {threads_text(threads)}")
            bins = simulated_bins(num_bins)
            ways: dict[str, Way] = {}
            for name, dtype in (("float64", torch.float64), ("float32", torch.float32)):
                judge = untrained_detector().to(dtype)
                cast = bins.to(dtype)
                ways |= {
                    f"{name} guards": Way(partial(judge.judge, cast, "mask")),
                    f"{name} off": Way(partial(judge, cast), guards_off),
                }
            with torch.inference_mode(), on_threads(threads):
                seconds = shuffled_rounds(ways, sizes.rounds, sizes.seed)
            rows += [
                {"bins": num_bins, "arithmetic": name, "threads": threads}
                | {f"{kind}_s": seconds[f"{name} {kind}"] for kind in ("guards", "off")}
                for name in ("float64", "float32")
            ]
    return {"rows": rows}


def solve(sizes: Sizes) -> dict[str, Any]:
    """The solve with its report, condition and all, beside a bare factorisation; both copy."""
    rows = []
    for threads in sizes.threads:
        for num_bins in sizes.solved:
            say(f"solve of {num_bins} bins on {threads_text(threads)}")
            z, is_slip = SyntheticBins(NUM_FEATURES).training(num_bins)
            gram, targets = gram_matrix(PAPER_KERNEL, z), torch.where(is_slip, 1.0, -1.0).double()
            ways = {
                "guards": Way(partial(_reported, gram, targets)),
                "off": Way(partial(_bare, gram, targets)),
            }
            with torch.inference_mode(), on_threads(threads):
                seconds = shuffled_rounds(ways, sizes.rounds, sizes.seed)
            rows.append(
                {"bins": num_bins, "arithmetic": "float64", "threads": threads}
                | {f"{kind}_s": taken for kind, taken in seconds.items()}
            )
    return {"rows": rows}


SECTIONS: dict[str, Callable[[Sizes], dict[str, Any]]] = {
    "extract": extract,
    "score": score,
    "solve": solve,
}


# ---------------------------------------------------------------------------------------- parts
def _reference(pool: FeaturePool) -> FeatureExtractor:
    return FeatureExtractor(pool, engine="reference")  # guards are its


@torch.no_grad()
def untrained_detector() -> SlipDetector:
    """A detector of the usual size that nobody trained: its time is that of any."""
    pool = FeaturePool(HandLayout.paper24())
    selected = list(range(0, len(pool.names), len(pool.names) // NUM_FEATURES))[:NUM_FEATURES]
    scaler = FeatureScaler.fit(_reference(pool)(simulated_bins(64))[:, selected], compress=True)
    generator = torch.Generator().manual_seed(0)
    weights = torch.randn(NUM_FEATURES + 1, NUM_FEATURES, generator=generator, dtype=torch.float64)
    head = QuadraticForm(weights[1:] + weights[1:].T, weights[0], weights[0, 0])
    return SlipDetector(pool, ChannelFilter(WINDOW_LENGTHS), selected, scaler, head)


def _reported(gram: Tensor, targets: Tensor) -> Tensor:
    return solve_symmetric(gram, targets, PENALTY).x


def _bare(gram: Tensor, targets: Tensor) -> Tensor:
    system = gram.clone()
    system.diagonal().add_(1 / PENALTY)
    return torch.cholesky_solve(targets[:, None], torch.linalg.cholesky(system))[:, 0]

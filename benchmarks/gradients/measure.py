"""The measurement of ``benchmarks.gradients``: every way of every problem, in turns."""

from __future__ import annotations

import random
from dataclasses import asdict
from typing import Any

from benchmarks.clocks import say
from benchmarks.gradients.sizes import Sizes
from benchmarks.gradients.ways import BASE, OURS, PEER
from benchmarks.gradients.worker import measured

MEASURED = ("forward_s", "backward_s", "forward_bytes", "whole_bytes")


def gradients(sizes: Sizes) -> dict[str, Any]:
    """Seconds and bytes of every round, each in a process of its own, in an order of its own."""
    shuffle = random.Random(sizes.seed)
    ways = [
        (problem, way)
        for problem in sizes.problems
        for way in (BASE, OURS, *([PEER] if problem.has_peer else []))
    ]
    answers: dict[Any, list[dict[str, Any]]] = {way: [] for way in ways}
    for place in range(sizes.rounds):
        for problem, way in shuffle.sample(ways, len(ways)):
            answer = measured(
                kind=problem.kind,
                way=way,
                num_bins=problem.num_bins,
                num_features=problem.num_features,
                threads=sizes.threads,
                groups=sizes.groups,
                scored=sizes.scored,
                penalty=sizes.penalty,
                offset=sizes.offset,
            )
            answers[problem, way].append(answer)
            taken = answer["forward_s"] + answer.get("backward_s", 0.0)
            say(f"gradients, round {place + 1} of {sizes.rounds}: {problem}, {way} {taken:.2f} s")
    rows = [
        {
            "problem": str(problem),
            **asdict(problem),
            "way": way,
            **{of: [answer[of] for answer in found] for of in MEASURED if of in found[0]},
            "loss": found[0]["loss"],
            "gradient": found[0].get("gradient"),
        }
        for (problem, way), found in answers.items()
    ]
    return {"rows": rows}

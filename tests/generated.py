"""Generated bins for property tests: drawn by hypothesis, made by torch, and named.

``TACTSLIP_SEED`` drives both generators; the head of a run says which seed it has. A failure says
which kind of bin stood in which channel.
"""

from __future__ import annotations

import os
from dataclasses import dataclass

import torch
from extremes import EXTREMES, extreme_bins
from hypothesis import strategies as st
from torch import Tensor

SEED = int(os.environ.get("TACTSLIP_SEED", "1"))
ORDINARY = ("plain", "integers", "ramp")  # drawn as often as all the others together


def generator(drawn: int) -> torch.Generator:
    """Random numbers that depend on the run's seed and a number that hypothesis drew."""
    return torch.Generator().manual_seed((SEED * 1_000_003 + drawn) % 2**63)


@dataclass(frozen=True)
class Batch:
    """Bins ``[N, C, n]`` and what kind each channel of each is, ``kinds[bin][channel]``."""

    bins: Tensor
    kinds: list[list[str]]
    drawn: int

    def __repr__(self) -> str:
        return f"Batch(drawn={self.drawn}, seed={SEED}, {tuple(self.bins.shape)})"

    def blame(self, wrong: Tensor, names: list[str], channels: dict[str, int]) -> str:
        """The first features ``[N, F]`` that are wrong, with the kind of their bin; "" if none."""
        found = [
            f"bin {row}, {names[column]}, {self.kinds[row][channels[names[column].split()[0]]]}"
            for row, column in wrong.nonzero()[:5].tolist()
        ]
        return "; ".join([f"{int(wrong.sum())} wrong", *found]) if found else ""


def make_batch(drawn: int, num: int, channels: int, samples: int, dtype: torch.dtype) -> Batch:
    """Bins whose channels are of random kinds, each its own."""
    source = generator(drawn)
    menu = (*EXTREMES, *ORDINARY * (len(EXTREMES) // len(ORDINARY)))
    choice = torch.randint(len(menu), (num, channels), generator=source)
    bins = torch.empty(num, channels, samples, dtype=dtype)
    for index, kind in enumerate(menu):
        here = choice == index
        bins[here] = extreme_bins(kind, (int(here.sum()), samples), source, dtype)
    kinds = [[menu[index] for index in row] for row in choice.tolist()]
    return Batch(bins, kinds, drawn)


def batches(
    num: int, dtype: torch.dtype, channels: int = 24, samples: int = 100
) -> st.SearchStrategy[Batch]:
    """Batches of ``num`` bins; the number hypothesis shrinks is the seed, which is as good as any.

    Draw through ``data.draw`` where the dtype is a parameter of the test.
    """
    seeds = st.integers(0, 2**40)
    return seeds.map(lambda drawn: make_batch(drawn, num, channels, samples, dtype))

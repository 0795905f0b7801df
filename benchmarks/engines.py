"""The engines of the package by name, and in which dtype they work."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from importlib.util import find_spec

import torch

from benchmarks.arithmetic import Way
from tactslip_torch.features.extractor import EngineName, FeatureExtractor
from tactslip_torch.features.pool import Arithmetic, FeaturePool
from tactslip_torch.hand import HandLayout

ENGINES: tuple[EngineName, ...] = (
    ("compiled", "eager") if find_spec("numba") is not None else ("eager",)
)
"""Those that are fast and can run here, the fastest first."""
FLOAT32, FLOAT64 = "float32", "float64"
DTYPES = {FLOAT32: Way(torch.float32, "native"), FLOAT64: Way(torch.float64, "double")}
"""float32: linear maps in float64, statistics in float32 of rows scaled to order one."""


@cache
def pool_of(dtype: str) -> FeaturePool:
    """The paper's pool."""
    return FeaturePool(HandLayout.paper24(), arithmetic=arithmetic_of(dtype))


def arithmetic_of(dtype: str) -> Arithmetic:
    """What the pool is told."""
    return DTYPES[dtype].arithmetic


@cache
def extractor(engine: EngineName, dtype: str) -> FeatureExtractor:
    """The whole pool by an engine."""
    return FeatureExtractor(pool_of(dtype), engine=engine)


def selected_extractor(engine: EngineName, dtype: str, selected: Sequence[int]) -> FeatureExtractor:
    """Some of its features."""
    return FeatureExtractor(pool_of(dtype), selected, engine)

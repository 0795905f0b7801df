"""The same tree without its guards: what the ordinary path would do if no bin were extreme.

A guard is whatever looks for a constant, a zero, a NaN, an Inf or a size whose square leaves the
dtype, and what then replaces or rescales it. ``guards_off`` puts the plain formula in the place of
each where it is looked up. Two-pass moments of shifted values over the span stay: they are how a
descriptor is computed. ``textbook`` takes those away too, for the price of all care together.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest import mock

import torch
from torch import Tensor

from benchmarks.features.guards.plain import PlainSample, TextbookSample, describer
from tactslip_torch.features import extractor, pool
from tactslip_torch.model import detector


@contextmanager
def guards_off() -> Iterator[None]:
    """Plain formulas in the place of every guard of features and scores.

    The policy about NaN and Inf is off where ``SlipDetector.forward`` is called, not ``judge``.
    """
    with _replacing(_OFF):
        yield


@contextmanager
def textbook() -> Iterator[None]:
    """Neither guards nor shifted and scaled sums."""
    with _replacing(_TEXTBOOK):
        yield


def replaced() -> list[str]:
    """What ``guards_off`` replaces, by full name; ``Sample`` goes with ``describe``."""
    return [f"{_name_of(owner)}.{name}" for owner, name, _ in _OFF]


# ------------------------------------------------------------------------------- plain formulas
def _settle(x: Tensor, scale: Tensor) -> Tensor:
    return x


def _ratio(spectra: Tensor) -> Tensor:
    energies = (spectra * spectra).sum(-1)
    return energies / energies.sum(-1, keepdim=True)


def _branches(self: pool.FeaturePool, films: Tensor) -> Tensor:
    is_approximation = self._constant("is_approximation", films)[:, None]
    first = films[..., None, :1].detach()
    shifted = _textbook_branches(self, (films[..., None, :] - first).squeeze(-2))
    return shifted + torch.where(is_approximation, first, 0.0)


def _textbook_branches(self: pool.FeaturePool, films: Tensor) -> Tensor:
    matrix = self._constant("branches", films)
    branches: Tensor = (films @ matrix.flatten(0, 1).T).unflatten(-1, matrix.shape[:2])
    return branches


def _amplitudes(self: pool.FeaturePool, branches: Tensor) -> Tensor:
    real = branches @ self._constant("cosine", branches).T
    imaginary = branches @ self._constant("sine", branches).T
    return (real * real + imaginary * imaginary).sqrt()


# ------------------------------------------------------------------------------------- switches
_Place = tuple[Any, str, object]
_OFF: tuple[_Place, ...] = (
    (pool, "describe", describer(PlainSample)),
    (pool, "settle", _settle),
    (pool, "band_energy_ratio", _ratio),
    (pool, "saturating", Tensor.to),
    (pool.FeaturePool, "branches", _branches),
    (pool.FeaturePool, "amplitudes", _amplitudes),
    (extractor, "saturating", Tensor.to),
    (detector, "saturating", Tensor.to),
)
_TEXTBOOK: tuple[_Place, ...] = (
    *_OFF,
    (pool, "describe", describer(TextbookSample)),
    (pool.FeaturePool, "branches", _textbook_branches),
)


@contextmanager
def _replacing(places: Sequence[_Place]) -> Iterator[None]:
    with ExitStack() as stack:
        for owner, name, plain in places:
            stack.enter_context(mock.patch.object(owner, name, plain))
        yield


def _name_of(owner: Any) -> str:
    if isinstance(owner, type):
        return f"{owner.__module__}.{owner.__qualname__}"
    return str(owner.__name__)

"""Bins that try the fast engines, and how these compare with the reference (features of issue 5).

Every second bin of a degenerate kind is a random one, so that the standard deviation of a column
says what is usual in it.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from tactslip_torch import HandLayout

PLAIN_KINDS = ("random", "tied", "near_constant")
DEGENERATE_KINDS = ("zeros", "constants", "ramps", "impulses", "square", "rails", "dead_channel")
KINDS = PLAIN_KINDS + DEGENERATE_KINDS
LARGE_CV = 3e4  # a mean good to 15 eps of the spread is then good to 1e-10 of itself
FLOOR_CV = 9e5  # beyond it the mean is rounding (descriptors.CV_FLOOR), its sign too


def some_hand(kinds: str) -> HandLayout:
    """A hand by letters: ``"GFF"`` is a gauge and two films."""
    words = {"G": ("SG", "SG"), "F": ("PVDF", "PVDF")}
    rows, counts = [], {"G": 0, "F": 0}
    for letter in kinds:
        counts[letter] += 1
        stem, kind = words[letter]
        name = f"{stem}{counts[letter]}"
        rows.append({"name": name, "kind": kind, "finger": "index", "segment": "distal"})
    return HandLayout.from_rows(rows)


def bins_of(kind: str, num: int, hand: HandLayout, n: int, generator: torch.Generator) -> Tensor:
    """``[num, C, n]`` float64 volts of one kind."""
    shape = (num, len(hand), n)
    noise = torch.randn(shape, generator=generator, dtype=torch.float64)
    each = torch.randn(num, len(hand), 1, generator=generator, dtype=torch.float64)
    time = torch.arange(n, dtype=torch.float64)
    match kind:
        case "random":
            return noise
        case "tied":  # counts of a 16-bit converter: few of them here, many there
            counts = torch.where(each > 0, 2.0, 900.0) * noise
            return counts.round() * (10 / 2**16)
        case "near_constant":  # a vibration on an offset; in every third bin it is rounding
            part = torch.where(torch.arange(num) % 3 == 2, 1e-16, 1e-3)[:, None, None]
            return (each.sign() * (1 + each.abs())) * (1 + part * noise)
        case "zeros":
            odd = torch.zeros(shape, dtype=torch.float64)
        case "constants":
            odd = each.expand(shape)
        case "ramps":
            odd = each * time / n
        case "impulses":
            place = torch.randint(n, each.shape, generator=generator)
            odd = each * (time == place)
        case "square":
            odd = each * torch.where(time % 20 < 10, 1.0, -1.0)
        case "rails":
            odd = (3 * noise).clamp(-2.0, 2.0)
        case "dead_channel":
            odd = noise.clone()
            odd[:, -1] = 0.0
        case _:
            raise KeyError(kind)
    is_odd = (torch.arange(num) % 2 == 0)[:, None, None]
    return torch.where(is_odd, odd, noise).contiguous()


def worst_errors(
    found: Tensor, reference: Tensor, names: Sequence[str], large_cv: float = torch.inf
) -> dict[str, float]:
    """Largest error of each descriptor, over max(magnitude of the reference, std of its column).

    Entropy is in bits, and mode is the share of values that are elsewhere than the reference's by
    1e-4 of that size. A cv beyond ``FLOOR_CV`` in the reference, where only the floor under the
    mean is left, counts without its sign; one beyond ``large_cv`` counts by as much less, its mean
    being that much nearer to rounding. A spread below 1e-5 of what is usual is a root of
    rounding, and counts by its square.
    """
    assert found.shape == reference.shape == (len(found), len(names))
    assert reference.isfinite().all(), "the reference itself is not finite"
    assert found.isfinite().all(), f"not finite at {(~found.isfinite()).nonzero()[:5].tolist()}"
    found, reference = found.double(), reference.double()
    usual = reference.std(0, correction=0)
    size = torch.maximum(reference.abs(), usual)
    error = (found - reference).abs()
    relative = torch.where(error == 0, 0.0, error / size)
    is_cv = torch.tensor([str(n)[-2:] == "cv" for n in names])
    has_no_sign = (reference.abs() > FLOOR_CV) & is_cv
    relative = torch.where(has_no_sign, (found.abs() - reference.abs()).abs() / size, relative)
    relative = torch.where(is_cv, relative / (reference.abs() / large_cv).clamp(min=1), relative)
    squared = (found.square() - reference.square()).abs() / size.square()
    is_spread = torch.tensor([str(n).endswith("spread") for n in names])
    relative = torch.where(is_spread & (reference < 1e-5 * size), squared, relative)
    worst: dict[str, float] = {}
    for name in sorted({str(n).split()[-1] for n in names}):
        columns = [i for i, n in enumerate(names) if str(n).split()[-1] == name]
        one = relative[:, columns]
        if name == "entropy":
            one = error[:, columns]
        worst[name] = float((one > 1e-4).double().mean() if name == "mode" else one.max())
    return worst


def assert_equals_reference(
    found: Tensor, reference: Tensor, names: Sequence[str], mixed: bool
) -> None:
    """1e-10 in float64, mode included; mixed 1e-4 and .1 bit of entropy, mode passed over.

    In float32 values near each other count as equal that are not.
    """
    limits = {"entropy": 0.1, "mode": 1.0} if mixed else {"mode": 0.0}
    usual = 1e-4 if mixed else 1e-10
    worst = worst_errors(found, reference, names, LARGE_CV)
    beyond = {name: worst[name] for name in worst if worst[name] > limits.get(name, usual)}
    assert not beyond, f"errors beyond the rule ({'mixed' if mixed else 'float64'}): {beyond}"

"""What rounding can do to a quadratic form over the box of scaled features: a bound, and examples.

The bound counts roundings (Higham 2002, chapter 3): a value that went through ``n`` of them is off
by the factor ``1 + theta``, ``|theta| <= gamma(n) = n u / (1 - n u)``. In ``z' Q z + l' z + a`` of
K features an entry of Q meets at most ``2 K + 3``: one when it is stored in the narrower dtype, one
product and K sums in the row, one product and K sums over the rows. That count is of no order of
summation, and an FMA only saves some of it, so the bound holds for any BLAS, thread count and batch
size that computes in the dtype. TF32 and bfloat16 products are not of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from tactslip_torch.model.kernels import QuadraticForm

_CHUNK = 16  # points that are differentiated together
_WIDE = 2.0**-52  # twice the unit roundoff of the float64 sums below


def gamma(count: int, dtype: torch.dtype) -> float:
    """``n u / (1 - n u)`` for ``n`` roundings, ``u`` half an eps; infinite from ``n u = 1`` on."""
    share = count * torch.finfo(dtype).eps / 2  # exact: a whole number times a power of 2
    return math.nextafter(share / (1 - share), math.inf) if share < 1 else math.inf


def rounding_bound(head: QuadraticForm, dtype: torch.dtype = torch.float32) -> float:
    """How far a head may be off, computed in ``dtype``, for any z of that dtype in ``[-1, 1]^K``.

    Infinite where a coefficient or a sum may pass the largest number of the dtype. Its own
    coefficients are taken as exact, so that storing them in ``dtype`` counts. Underflow counts as
    well, also where the processor flushes subnormal numbers to 0.

    Args:
        head: the quadratic form, as fitted.
        dtype: in which it is stored and computed.

    Raises:
        ValueError: if a coefficient is NaN.

    Reference:
        Higham (2002), Accuracy and Stability of Numerical Algorithms, lemma 3.1 and section 3.1.

    Example:
        >>> one = torch.ones(1, 1, dtype=torch.float64)
        >>> head = QuadraticForm(one, one[0], one[0, 0])
        >>> f"{rounding_bound(head) / 2**-24:.3f}"  # 5 + 4 + 2 roundings
        '11.000'
    """
    num = head.num_features
    quadratic, linear, constant = (
        float(part.detach().double().abs().sum())
        for part in (head.dense_quadratic, head.linear, head.constant)
    )
    if math.isnan(quadratic + linear + constant):
        raise ValueError("a coefficient of the head is NaN; fit it again")
    facts = torch.finfo(dtype)
    most = gamma(2 * num + 3, dtype)
    outward = 1 + (num + 4) ** 2 * _WIDE  # the sums above and the few steps below, in float64
    # what each of 3 K^2 + 3 K + 1 results loses if it is too small for the dtype
    underflow = (3 * num * (num + 1) + 1) * facts.tiny * (1 + most)
    largest = ((quadratic + linear + constant) * (1 + most) + underflow) * outward
    if not largest < facts.max:
        return math.inf
    rounded = (
        most * quadratic + gamma(2 * num + 2, dtype) * linear + gamma(num + 1, dtype) * constant
    )
    return (rounded + underflow) * outward


def worst_error(
    head: QuadraticForm,
    dtype: torch.dtype = torch.float32,
    *,
    seed: int = 0,
    num_points: int = 2048,
    also: Tensor | None = None,
) -> float:
    """The worst error at points of the box; infinite for a score that is not finite.

    In ``dtype`` against float64, both on the same z of ``dtype``; so it is known to the
    ``rounding_bound`` of float64. Looks at points and corners at random, and at the signs of the
    rows and eigenvectors of Q.

    Args:
        head: the quadratic form, as fitted.
        dtype: in which it is stored and computed.
        seed: of the points.
        num_points: random points, and as many corners.
        also: points to look at, scaled bins for instance.

    Shape:
        - also: ``[N, K]``, within ``[-1, 1]``

    Raises:
        ValueError: if ``also`` has another number of features or leaves the box.
    """
    num = head.num_features
    parts = (head.dense_quadratic, head.linear, head.constant)
    exact, rounded = (
        QuadraticForm(*(part.detach().cpu().to(to) for part in parts))
        for to in (torch.float64, dtype)
    )
    generator = torch.Generator().manual_seed(seed)
    inside = 2 * torch.rand(num_points, num, generator=generator, dtype=torch.float64) - 1
    corners = torch.randn(num_points, num, generator=generator, dtype=torch.float64)
    bend = exact.dense_quadratic
    points = [corners, bend, -bend, exact.linear[None], torch.ones(1, num)]
    if bool(bend.isfinite().all()):
        vectors = torch.linalg.eigh(bend + bend.mT).eigenvectors.mT
        points += [vectors, -vectors]
    points = [inside, *(torch.where(x < 0, -1.0, 1.0).double() for x in points)]
    if also is not None:
        if also.ndim != 2 or also.shape[1] != num or bool((also.abs() > 1).any()):
            raise ValueError(
                f"expected points [N, {num}] within [-1, 1], got {tuple(also.shape)}; scale them "
                "first"
            )
        points.append(also.detach().cpu().double())
    z = torch.cat(points).to(dtype)
    errors = (rounded(z).double() - exact(z.double())).abs()
    return float(errors.nan_to_num(nan=math.inf, posinf=math.inf).max())


def head_facts(head: nn.Module, also: Tensor | None = None, seed: int = 0) -> dict[str, Any]:
    """Bound and worst error seen of a head in float32, as plain values.

    Args:
        head: any; only a quadratic form has a bound.
        also: as ``worst_error``.
        seed: of the search.

    Returns:
        ``kind``, ``bound`` and ``overflows``, ``worst_seen`` and its ``ratio`` to the bound, the
        ``reference_bound`` of float64, which the search compares with, and a ``note``. ``None``
        for what there is not.
    """
    facts: dict[str, Any] = {"kind": type(head).__name__}
    if not isinstance(head, QuadraticForm):
        note = "no bound for this head: only what was measured on bins"
        absent = ("bound", "worst_seen", "ratio", "reference_bound")
        return facts | dict.fromkeys(absent) | {"overflows": False, "note": note}
    bound, seen = rounding_bound(head), worst_error(head, seed=seed, also=also)
    return facts | {
        "bound": bound,
        "worst_seen": seen,
        "ratio": bound / seen if seen else None,
        "reference_bound": rounding_bound(head, torch.float64),
        "overflows": math.isinf(bound),
        "note": "a coefficient or a sum may pass the largest float32" if math.isinf(bound) else "",
    }


def gradient_facts(function: Callable[[Tensor], Tensor], points: Tensor) -> dict[str, float | int]:
    """By how much a small error in a point is magnified: Euclidean norms of the gradients.

    Args:
        function: of points, one value for each point alone.
        points: where, ``[N, *]``.

    Returns:
        The ``largest`` norm, the ``median`` one, and how many ``bins``.

    Example:
        >>> gradient_facts(lambda z: z[:, 0] * 3 + z[:, 1] * 4, torch.zeros(2, 2))
        {'largest': 5.0, 'median': 5.0, 'bins': 2}
    """
    norms = []
    for part in points.split(_CHUNK):
        given = part.detach().clone().requires_grad_()
        with torch.enable_grad():  # the caller may have turned it off
            value = function(given).sum()
        (slope,) = torch.autograd.grad(value, given)
        norms.append(torch.linalg.vector_norm(slope.flatten(1), dim=-1))
    found = torch.cat(norms)
    return {"largest": float(found.max()), "median": float(found.median()), "bins": len(found)}


def error_facts(error: Tensor, sd: float) -> dict[str, float | None]:
    """Worst, 99th percentile and median, in units of the score and of its standard deviation.

    ``None`` for each if there is no error to tell of.

    Args:
        error: sizes of score errors, infinite where a score is not finite.
        sd: standard deviation of the score.

    Shape:
        - error: ``[N]``
    """
    if not len(error):
        return dict.fromkeys(("worst", "p99", "median", "worst_sd", "p99_sd", "median_sd"))
    shares = torch.tensor([1.0, 0.99, 0.5], dtype=error.dtype)
    worst, p99, median = error.quantile(shares, interpolation="higher").tolist()
    found = {"worst": worst, "p99": p99, "median": median}
    return found | {f"{name}_sd": value / sd for name, value in found.items()}


def score_sd(scores: Tensor) -> float:
    """Standard deviation of the scores of calibration bins, the unit of errors.

    Shape:
        - scores: ``[N]``

    Raises:
        ValueError: if scores are not finite, or differ by no more than rounding.
    """
    num, sd = len(scores), float(scores.std()) if len(scores) > 1 else 0.0
    if num_bad := int((~scores.isfinite()).sum()):
        bad = f"scores of {num_bad} of {num} calibration bins are not finite in float64"
        raise ValueError(f"{bad}; the head is broken, fit it again")
    if sd <= 64 * torch.finfo(scores.dtype).eps * float(scores.abs().amax()):
        sd = 0.0  # equal bins
    if not 0 < sd < math.inf:
        found = f"{num} calibration bins have scores of standard deviation {sd:g}"
        cure = "give more bins, of both classes" if sd == 0 else "scale the head down, or fit again"
        raise ValueError(f"{found}; {cure}")
    return sd

"""Ridge regression of classes, with class weights and a free intercept: primal and dual.

Every class weighs the same, whatever its number of bins; the intercept is not penalised. With ``n``
the sum of all weights, ``a`` the ridge and ``v_i`` the weights times ``n / (classes * weight of the
class)``,

    minimise  sum_i v_i |f(u_i) - t_i|^2 + a |f|^2,    f = linear . u + intercept.

Targets ``t`` are those of the class of a bin, one or several. All is float64 and differentiable.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor


class _Solution(NamedTuple):
    """Weights of columns (primal) or of bins (dual), and the intercept.

    Shape:
        - weights: ``[S, R]`` or ``[N, R]``; intercept: ``[R]``
    """

    weights: Tensor
    intercept: Tensor


def class_targets(num_classes: int) -> Tensor:
    """+1 and -1 of each class, ``[L, R]``: of two classes one target, else one for each class."""
    if num_classes == 2:
        return torch.tensor([[-1.0], [1.0]], dtype=torch.float64)
    return 2 * torch.eye(num_classes, dtype=torch.float64) - 1


class ClassSums:
    """Weights, sums and products of the columns of bins, class by class; additive.

    Args:
        num_classes: L.
        num_columns: S.

    Attributes:
        weight: ``[L]``; total: ``[L, S]``; product: ``[L, S, S]``; all float64.
    """

    def __init__(self, num_classes: int, num_columns: int) -> None:
        shape = num_classes, num_columns, num_columns
        self.weight, self.total, self.product = (
            torch.zeros(shape[:num], dtype=torch.float64) for num in (1, 2, 3)
        )

    def update(self, columns: Tensor, labels: Tensor, weights: Tensor) -> None:
        """Add bins.

        Shape:
            - columns: ``[N, S]``, float64; labels: ``[N]``, whole numbers; weights: ``[N]``
        """
        for label in range(len(self.weight)):
            own = labels == label
            u, w = columns[own], weights[own]
            self.weight[label] += w.sum()
            self.total[label] += w @ u
            self.product[label] += u.mT @ (u * w[:, None])

    @property
    def tensors(self) -> tuple[Tensor, Tensor, Tensor]:
        """All of it, to be added over processes."""
        return self.weight, self.total, self.product

    @classmethod
    def added(cls, parts: Sequence[ClassSums]) -> ClassSums:
        """All of the bins of several."""
        whole = cls(*parts[0].total.shape)
        for part in parts:
            for mine, theirs in zip(whole.tensors, part.tensors, strict=True):
                mine += theirs
        return whole

    def without(self, other: ClassSums) -> ClassSums:
        """Without the bins of another one, which are part of it."""
        rest = ClassSums(*self.total.shape)
        pairs = zip(self.tensors, other.tensors, strict=True)
        rest.weight, rest.total, rest.product = (mine - theirs for mine, theirs in pairs)
        return rest

    def take(self, columns: Sequence[int], factor: Tensor | float = 1.0) -> ClassSums:
        """Of some of the columns alone, times a factor."""
        part = ClassSums(len(self.weight), len(columns))
        part.weight = self.weight
        part.total = self.total[:, columns] * factor
        part.product = self.product[:, columns][:, :, columns] * factor**2
        return part

    @property
    def has_all(self) -> bool:
        """Whether every class has a bin."""
        return bool((self.weight > 1e-9 * self.weight.sum()).all())

    def solve(self, ridges: Sequence[float], targets: Tensor) -> Iterator[_Solution]:
        """The machine for each ridge, by the primal.

        Shape:
            - targets: ``[L, R]``

        Raises:
            ValueError: if a class has no bin.
        """
        if not self.has_all:
            raise ValueError("a machine needs bins of every class; add recordings")
        num = self.weight.sum()
        share = num / (len(self.weight) * self.weight)
        each = share * self.weight  # n / L
        middle, level = (share @ self.total) / num, (each @ targets) / num
        system = torch.einsum("l,lij->ij", share, self.product) - num * middle.outer(middle)
        right = (self.total * share[:, None]).mT @ targets - num * middle.outer(level)
        eye = torch.eye(len(system), dtype=system.dtype)
        for ridge in ridges:
            factor = torch.linalg.cholesky(system + ridge * eye)
            linear = torch.cholesky_solve(right, factor)
            yield _Solution(linear, level - middle @ linear)


def balanced_weights(labels: Tensor, weights: Tensor, num_classes: int) -> Tensor:
    """Weights of the same sum of which every class has the same, ``[N]``.

    Raises:
        ValueError: if a class has no bin.
    """
    of_class = torch.zeros(num_classes, dtype=torch.float64)
    of_class.index_put_((labels,), weights, accumulate=True)
    if not bool((of_class > 0).all()):
        raise ValueError("a machine needs bins of every class; add recordings")
    return weights * (weights.sum() / (num_classes * of_class))[labels]


def solve_dual(
    gram: Tensor, labels: Tensor, weights: Tensor, ridges: Sequence[float], targets: Tensor
) -> Iterator[_Solution]:
    """The machine for each ridge, by the dual: the score is ``kernel @ weights + intercept``.

    Args:
        gram: kernel of the training bins.
        labels: of them.
        weights: of them, before classes are balanced.
        ridges: as parts of the kernel's mean diagonal, which should be about 1.
        targets: of the classes.

    Shape:
        - gram: ``[N, N]``, float64; labels, weights: ``[N]``; targets: ``[L, R]``

    Raises:
        ValueError: if a class has no bin.
    """
    root = balanced_weights(labels, weights, len(targets)).sqrt()
    scaled = gram * root[:, None] * root
    right = torch.cat([targets[labels] * root[:, None], root[:, None]], 1)
    eye = torch.eye(len(gram), dtype=gram.dtype)
    for ridge in ridges:
        factor = torch.linalg.cholesky(scaled + ridge * eye)
        found = torch.cholesky_solve(right, factor)
        sums = root @ found
        intercept = sums[:-1] / sums[-1]
        yield _Solution((found[:, :-1] - found[:, -1:] * intercept) * root[:, None], intercept)

"""Sums over training bins of one size, which add, and the machine that is solved from them.

Offset, penalty and class weights come later. Batches may come in any order, over any number of
workers; the order shows in the last digits alone.
"""

from __future__ import annotations

import os
from typing import Literal

import torch
from torch import Tensor

from tactslip_torch.model.fit import check_weights, solve_normal_equations
from tactslip_torch.model.kernels import Polynomial, ProductSums, QuadraticForm
from tactslip_torch.package_files import SUMS, load_table, reading, save_table

_CLASSES = ("non-slip", "slip")


class SufficientStats:
    """Sums over training bins, from which any class balance, penalty and offset are solved.

    Memory does not grow with the number of bins: 168 MB for 120 features at degree 2, and the
    name of every batch.

    Args:
        num_features: ``K``.
        degree: of the machine, 1 or 2.

    Attributes:
        sums: ``[2, num_held]``, float64: of non-slip and slip, as ``ProductSums`` lays them out.
        count: ``[2]``, int64: number of bins.
        seen_batches: names of batches.

    Raises:
        ValueError: for no feature or another degree.

    Example:
        >>> stats = SufficientStats(2)
        >>> z = torch.tensor([[0.5, -0.25], [-0.5, 0.0], [1.0, 0.5]])
        >>> stats.update("M1/c00", z, torch.tensor([True, False, True]))
        >>> stats.count, len(stats.seen_batches)
        (tensor([1, 2]), 1)
        >>> stats.solve(penalty=1.0)(z.double()) > 0
        tensor([ True, False,  True])
    """

    def __init__(self, num_features: int, degree: int = 2) -> None:
        self.num_features, self.degree = num_features, degree
        self._layout = ProductSums(num_features, degree)
        self.sums = torch.zeros(2, self._layout.num_held, dtype=torch.float64)
        self.count = torch.zeros(2, dtype=torch.int64)
        self.seen_batches = set[str]()

    def __repr__(self) -> str:
        quiet, slip = self.count.tolist()
        return (
            f"SufficientStats({len(self.seen_batches)} batches, {slip} slip and {quiet} non-slip "
            f"bins of {self.num_features} features, degree {self.degree})"
        )

    @property
    def weight(self) -> Tensor:
        """``[2]``, float64: sum of the weights of bins."""
        return self.sums[:, 0].clone()

    def update(
        self, batch_id: str, z: Tensor, is_slip: Tensor, weights: Tensor | None = None
    ) -> None:
        """Add the bins of a batch: all of them or, on an error, none.

        Args:
            batch_id: a name of its own, such as that of the recording.
            z: scaled features, in [-1, 1].
            is_slip: 1 or True for slip.
            weights: positive weight of each bin; default 1. Classes are balanced in ``solve``.

        Shape:
            - z: ``[N, K]``; is_slip, weights: ``[N]``

        Raises:
            ValueError: if the batch is in already, for another shape or a value that is not
                allowed.
        """
        z, is_slip, weights = self._checked(batch_id, z, is_slip, weights)
        self.seen_batches.add(batch_id)
        for label, own in enumerate((~is_slip, is_slip)):
            self._layout.add_(self.sums[label], z[own], weights[own])
            self.count[label] += int(own.sum())

    def merge(self, other: SufficientStats) -> None:
        """Add the batches of other sums: all of them or, on an error, none.

        Raises:
            ValueError: if a batch is in both, or if the two differ in degree or in the number of
                features.
        """
        for name in ("num_features", "degree"):
            ours, theirs = getattr(self, name), getattr(other, name)
            if ours != theirs:
                raise ValueError(f"cannot merge sums that differ in {name}: {ours} and {theirs}")
        if both := sorted(self.seen_batches & other.seen_batches):
            raise ValueError(
                f"{len(both)} batches are in both statistics, such as {both[0]!r}; "
                "merge each shard once"
            )
        self.seen_batches |= other.seen_batches
        self.sums += other.sums
        self.count += other.count

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a file, whole or not at all."""
        metadata = {
            "num_features": self.num_features,
            "degree": self.degree,
            "batches": sorted(self.seen_batches),
        }
        save_table(path, SUMS, metadata, {"sums": self.sums, "count": self.count})

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> SufficientStats:
        """The sums in a file.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if it holds no sums, or is damaged.
        """
        metadata, tensors = load_table(path, SUMS)
        with reading(path):
            stats = cls(metadata["num_features"], metadata["degree"])
            stats.seen_batches = set(metadata["batches"])
            for name, value in tensors.items():
                own = getattr(stats, name)
                if (value.shape, value.dtype) != (own.shape, own.dtype):
                    raise ValueError(f"{name} must be {own.dtype} of shape {list(own.shape)}")
                own.copy_(value)
        return stats

    def solve(
        self,
        penalty: float,
        offset: float = 0.5,
        balance: Literal["weights", "none"] = "weights",
    ) -> QuadraticForm:
        """The kernel machine of all bins, as ``fit_machine`` makes it of them through the primal.

        Takes two float64 matrices of ``P`` by ``P`` monomials beside the sums (436 MB each for 120
        features at degree 2).

        Args:
            penalty: the paper's ``C``; ``inf`` for the pseudo-inverse, which takes several such
                matrices and much longer.
            offset: the kernel's ``c``, 0 or more.
            balance: ``weights`` gives both classes the same total weight; ``none`` takes the
                bins' own.

        Raises:
            ValueError: if a class is absent, or an argument is not allowed.

        Reference:
            Zong, Huang and Chen (2013), Neurocomputing 101, 229-242 (weighted ELM).
        """
        kernel, weight = Polynomial(self.degree, offset), self.weight
        for name, num in zip(_CLASSES, self.count.tolist(), strict=True):
            if num == 0:
                raise ValueError(f"there is no {name} bin in these sums; add bins of both classes")
        if balance not in ("weights", "none"):
            raise ValueError(f"balance must be 'weights' or 'none', got {balance!r}")
        factor = weight.sum() / (2 * weight) if balance == "weights" else torch.ones(2).double()
        rest, slip = self.sums[0] * factor[0], self.sums[1] * factor[1]
        scale = kernel.scale(self.num_features)
        moment = self._layout.moment_vector(slip - rest, scale)
        normal = self._layout.normal_matrix(rest.add_(slip), scale)
        return solve_normal_equations(normal, moment, penalty, kernel, self.num_features)[0]

    def _checked(
        self, batch_id: str, z: Tensor, is_slip: Tensor, weights: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The batch in float64 and bool, with weights."""
        if batch_id in self.seen_batches:
            raise ValueError(f"batch {batch_id!r} is in these statistics already; add it once")
        shapes = [tuple(each.shape) for each in (z, is_slip, weights) if each is not None]
        if z.ndim != 2 or z.shape[1] != self.num_features or {*shapes[1:]} != {(len(z),)}:
            raise ValueError(
                f"batch {batch_id!r}: expected z [N, {self.num_features}], is_slip [N] and "
                f"weights [N], got {', '.join(map(str, shapes))}"
            )
        z = z.detach().cpu().double()
        weights = z.new_ones(len(z)) if weights is None else weights.detach().cpu().double()
        if len(outside := (~(z.abs() <= 1)).nonzero()):
            number, feature = outside[0].tolist()
            raise ValueError(
                f"batch {batch_id!r}: z must be within [-1, 1], got {float(z[number, feature]):g} "
                f"at bin {number}, feature {feature}; scale it and clip"
            )
        try:
            check_weights(weights)
        except ValueError as error:
            raise ValueError(f"batch {batch_id!r}: {error}") from None
        return z, is_slip.cpu().bool(), weights

"""All that the primal solve needs to know of its bins: exact, additive, of one size.

The fourth moments of each class stand on a grid of ``2**-grid_bits`` as int64 (``fourth_moments``).
Integers add without rounding, so batches may come in any order, over any number of workers and
threads, and go again: the bits are those of the batches that are in. What is rounded to the grid is
a batch (256 bins at a time, counted from its first), so the same batches must be passed; the same
bins cut elsewhere give sums that differ in the last bits.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import torch
from torch import Tensor

from tactslip_torch.ledger import Ledger, content_digest, first_difference
from tactslip_torch.model.cholesky import from_above
from tactslip_torch.model.fourth_moments import (
    ProductSums,
    add_products_,
    check_room,
    from_grid,
    moment_vector,
    normal_matrix,
)
from tactslip_torch.model.quadratic import QuadraticForm, from_primal
from tactslip_torch.model.symmetric_solve import solve_symmetric_
from tactslip_torch.runtime import load_table, save_table

FORMAT = "tactslip_torch sums 1"
_CLASSES = ("non-slip", "slip")
_MOST = 2**62  # of any sum: half of what int64 holds


class SufficientStats:
    """Sums over training bins, from which any class weights, penalty, offset and size are solved.

    Memory does not grow with the number of bins: 168 MB for 120 features, and a name and a digest
    for every batch.

    Args:
        num_features: ``K``.
        about: what the features are (hand, names, scaling), as JSON holds it; only sums that
            agree in it merge.
        grid_bits: of the fraction of a sum. With 38, the sum of a batch is off by 2e-12 at most,
            and a class takes 16 million bins of weight 1.

    Attributes:
        sums: ``[2, num_held]``, int64: of non-slip and slip, as ``ProductSums`` lays them out.
        count: ``[2]``, int64: number of bins.
        ledger: names and digests of batches.
        about: as given.

    Raises:
        ValueError: if JSON does not hold ``about``, or ``grid_bits`` is not in 0..42.

    Example:
        >>> stats = SufficientStats(2)
        >>> z = torch.tensor([[0.5, -0.25], [-0.5, 0.0], [1.0, 0.5]])
        >>> stats.update("M1/c00", z, torch.tensor([True, False, True]))
        >>> stats.count, len(stats.ledger)
        (tensor([1, 2]), 1)
        >>> stats.solve(penalty=1.0)(z.double()) > 0
        tensor([ True, False,  True])
    """

    def __init__(
        self, num_features: int, about: Mapping[str, Any] | None = None, grid_bits: int = 38
    ) -> None:
        if not 0 <= grid_bits <= 42:
            raise ValueError(f"grid_bits must be in 0..42, got {grid_bits}")
        try:
            text = json.dumps(about or {}, sort_keys=True, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise ValueError(f"about must be what JSON holds: {error}") from None
        self.about: dict[str, Any] = json.loads(text)
        self.num_features = num_features
        self.grid_bits = grid_bits
        self.sums = torch.zeros(2, ProductSums(num_features).num_held, dtype=torch.int64)
        self.count = torch.zeros(2, dtype=torch.int64)
        self.ledger = Ledger()

    @property
    def weight(self) -> Tensor:
        """``[2]``, float64: sum of the weights of bins, on the grid."""
        return from_grid(self.sums[:, 0], self.grid_bits)

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
                allowed, or if the sums have no room for it.
        """
        z, is_slip, weights = self._checked(batch_id, z, is_slip, weights)
        steps = 2.0**self.grid_bits
        self.check_capacity([int(weights[of].sum() * steps) for of in (~is_slip, is_slip)])
        self.ledger.add(batch_id, content_digest(z, is_slip, weights))
        self._add(z, is_slip, weights, 1)

    def remove(
        self, batch_id: str, z: Tensor, is_slip: Tensor, weights: Tensor | None = None
    ) -> None:
        """Take the bins of a batch out again; afterwards the sums are as if they never were in.

        Args:
            batch_id: as given to ``update``, like the others.
            z: scaled features.
            is_slip: classes.
            weights: of the bins.

        Raises:
            ValueError: if the batch was never added or held something else.
        """
        z, is_slip, weights = self._checked(batch_id, z, is_slip, weights)
        self.ledger.remove(batch_id, content_digest(z, is_slip, weights))
        self._add(z, is_slip, weights, -1)

    def merge(self, other: SufficientStats) -> None:
        """Add the batches of other sums: all of them or, on an error, none.

        Raises:
            ValueError: if a batch is in both, if the two differ in what they are about, in the
                number of features or in the grid, or if there is no room.
        """
        for name in ("num_features", "grid_bits", "about"):
            if found := first_difference(getattr(self, name), getattr(other, name), name):
                raise ValueError(f"cannot merge sums that differ in {found}")
        self.check_capacity(other.sums[:, 0].tolist())
        self.ledger.merge(other.ledger)
        self.sums += other.sums
        self.count += other.count

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a file, whole or not at all; the same bytes for the same batches."""
        facts = {
            "num_features": self.num_features,
            "grid_bits": self.grid_bits,
            "about": self.about,
            "batches": self.ledger.entries,
        }
        save_table(path, FORMAT, facts, {"sums": self.sums, "count": self.count})

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> SufficientStats:
        """The sums in a file.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if it holds no sums, or is damaged.
        """
        facts, tensors = load_table(path, FORMAT)
        stats = cls(facts["num_features"], facts["about"], facts["grid_bits"])
        stats.ledger = Ledger(facts["batches"])
        stats.sums, stats.count = tensors["sums"], tensors["count"]
        return stats

    def solve(
        self,
        penalty: float,
        offset: float = 0.5,
        num_features: int | None = None,
        balance: Literal["weights", "none"] = "weights",
    ) -> QuadraticForm:
        """The kernel machine of degree 2 of all bins: what ``solve_primal`` makes of them.

        Takes one float64 matrix of ``P`` by ``P`` monomials beside the sums (436 MB for 120
        features). The same bits on any number of threads. The grid leaves an error in that matrix;
        a machine of which C makes a thousandth its doing is refused.

        Args:
            penalty: the paper's ``C``; ``inf`` for the pseudo-inverse, which takes several such
                matrices and much longer.
            offset: the kernel's ``c``, 0 or more.
            num_features: take the first so many features alone; default all.
            balance: ``weights`` gives both classes the same total weight; ``none`` takes the
                bins' own.

        Raises:
            ValueError: if a class is absent, an argument is not allowed, or the grid is too coarse
                for this penalty.

        Reference:
            Zong, Huang and Chen (2013), Neurocomputing 101, 229-242 (weighted ELM).
        """
        normal, moment, noise = self.normal_equations(penalty, offset, num_features, balance)
        weights, report = solve_symmetric_(
            normal,
            moment,
            penalty,
            name="X'WX",
            restore=from_above,
            noise=noise,
            in_span=True,
        )
        machine = from_primal(weights, num_features or self.num_features, offset)
        machine.solved = report
        return machine

    def normal_equations(
        self, penalty: float, offset: float, num_features: int | None, balance: str
    ) -> tuple[Tensor, Tensor, float]:
        """``X' W X``, ``[P, P]``, ``X' W t``, ``[P]``, and what the grid does to the first.

        Arguments and errors are those of ``solve``.
        """
        if not penalty > 0:
            raise ValueError(f"penalty (the paper's C) must be positive, got {penalty}")
        if not 0 <= offset < math.inf:
            raise ValueError(f"offset (the kernel's c) must be 0 or more, got {offset}")
        if balance not in ("weights", "none"):
            raise ValueError(f"balance must be 'weights' or 'none', got {balance!r}")
        weight = self.weight
        for name, of_class in zip(_CLASSES, weight.tolist(), strict=True):
            if of_class <= 0:
                raise ValueError(f"there is no {name} bin in these sums; add bins of both classes")
        scale = weight.sum() / (2 * weight) if balance == "weights" else torch.ones_like(weight)
        rest, slip = (from_grid(self.sums[i], self.grid_bits).mul_(scale[i]) for i in (0, 1))
        terms = (self.num_features, offset, num_features)
        moment = moment_vector(slip, *terms) - moment_vector(rest, *terms)
        rest += slip
        del slip
        normal = normal_matrix(rest, *terms)
        # every 256 bins or fewer are off by half a step at most; the size is that of random signs
        parts = float(self.count.sum()) / 256 + 2 * len(self.ledger)
        step = 2.0**-self.grid_bits * float(scale.max()) * max(2.0, 2 * offset, offset**2)
        return normal, moment, 2 * step * math.sqrt(parts * len(normal))

    def _checked(
        self, batch_id: str, z: Tensor, is_slip: Tensor, weights: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The batch in float64 and bool, with weights."""
        shapes = [tuple(part.shape) for part in (z, is_slip, weights) if part is not None]
        if z.ndim != 2 or z.shape[1] != self.num_features or {*shapes[1:]} != {(len(z),)}:
            raise ValueError(
                f"batch {batch_id!r}: expected z [N, {self.num_features}], is_slip [N] and "
                f"weights [N], got {', '.join(map(str, shapes))}"
            )
        z = z.detach().cpu().double()
        is_slip = is_slip.cpu().bool()
        weights = z.new_ones(len(z)) if weights is None else weights.detach().cpu().double()
        if not bool((z.abs() <= 1).all()):
            number, feature = (~(z.abs() <= 1)).nonzero()[0].tolist()
            raise ValueError(
                f"batch {batch_id!r}: z must be within [-1, 1], got {float(z[number, feature]):g} "
                f"at bin {number}, feature {feature}; scale it and clip"
            )
        if not bool((weights > 0).all()):
            number = int((~(weights > 0)).nonzero()[0])
            raise ValueError(
                f"batch {batch_id!r}: weights must be positive, got {float(weights[number]):g} "
                f"at bin {number}"
            )
        try:
            for of in (~is_slip, is_slip):
                check_room(z[of], weights[of], self.grid_bits)
        except ValueError as error:
            raise ValueError(f"batch {batch_id!r}: {error}") from None
        return z, is_slip, weights

    def check_capacity(self, brought: Sequence[int]) -> None:
        """Refuse what the sums have no room for.

        The first sum, of weights, is the largest: no product of four is above 1.

        Args:
            brought: what is to be added to the first sum of non-slip and of slip.

        Raises:
            ValueError: if that is too much.
        """
        for name, held, more in zip(_CLASSES, self.sums[:, 0].tolist(), brought, strict=True):
            if held + more > _MOST:
                raise ValueError(
                    f"{(held + more) / 2.0**self.grid_bits:.9g} {name} bins are too many: with "
                    f"grid_bits={self.grid_bits} sums have room for {_MOST >> self.grid_bits} of "
                    "weight 1 in each class; take fewer grid_bits"
                )

    def _add(self, z: Tensor, is_slip: Tensor, weights: Tensor, sign: int) -> None:
        for label, of in enumerate((~is_slip, is_slip)):
            if bool(of.any()):
                add_products_(self.sums[label], z[of], weights[of], self.grid_bits, sign)
            self.count[label] += sign * int(of.sum())

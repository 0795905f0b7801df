"""Sums of float32 values and of their squares without rounding, so no order and no split shows.

A float32 value is ``+-M * 2^(E - 150)``: ``M`` an integer of 24 bits, ``E`` its exponent field,
1..254 (1 also for 0 and what lies below the normal range). Eight exponents share a bucket of unit
``2^(8 b - 149)``, ``b = (E - 1) // 8``, in which the value is an integer ``A`` below 2^31 and its
square one below 2^62, kept as two halves of 31 bits. Each fits ``MOST_ROWS`` times into int64, and
integers add exactly in any order. At the end Python's long integers put the buckets together.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

MOST_ROWS = 2**32
_BUCKETS = 32
_WORDS = 3  # sums of A, of the upper half of A^2, of the lower
_HALF_BITS = 31
_CHUNK_VALUES = 40_000  # at a time: temporaries stay in the processor's cache


class Totals(NamedTuple):
    """What exact sums amount to, each number the float64 nearest to the exact one.

    Attributes:
        sum: ``[R, K]``.
        mean: ``[R, K]``; 0 without rows.
        sum_sq_dev: ``[R, K]``, of squared deviations from the exact mean.
    """

    sum: Tensor
    mean: Tensor
    sum_sq_dev: Tensor


class ExactSums:
    """Sums of the columns of float32 matrices, apart for each class of rows.

    Bit-identical however rows are ordered, sharded and merged. 768 bytes a column and class,
    whatever the number of rows.

    Args:
        num_columns: ``K``, of every matrix.
        num_classes: ``R``, kinds of rows that are summed apart.

    Attributes:
        count: ``[R]``, int64, rows so far.
        words: ``[3, R, K, 32]``, int64, the buckets.
    """

    def __init__(self, num_columns: int, num_classes: int = 1) -> None:
        self.count = torch.zeros(num_classes, dtype=torch.int64)
        self.words = torch.zeros(_WORDS, num_classes, num_columns, _BUCKETS, dtype=torch.int64)

    def update(self, values: Tensor, of_class: Tensor | None = None) -> None:
        """Add the rows of a matrix.

        Args:
            values: float32, finite.
            of_class: of each row, 0..R - 1; all 0 if not given.

        Shape:
            - values: ``[N, K]``
            - of_class: ``[N]``

        Raises:
            ValueError: for another shape or dtype, a value that is not finite, a class out of
                range or more than ``MOST_ROWS`` rows of a class; nothing is added then.
        """
        of_class = self._checked(values, of_class)
        count = self.count + torch.bincount(of_class, minlength=len(self.count))
        _refuse_overflow(count)
        _add(values, of_class, self.words)
        self.count = count

    def merge(self, other: ExactSums) -> None:
        """Add what another object holds.

        Raises:
            ValueError: if columns or classes differ, or there are more than ``MOST_ROWS`` rows
                of a class; nothing is added then.
        """
        if self.words.shape != other.words.shape:
            raise ValueError(
                f"cannot merge sums of {list(self.words.shape[1:3])} and "
                f"{list(other.words.shape[1:3])} classes and columns"
            )
        count = self.count + other.count
        _refuse_overflow(count)
        self.words = self.words + other.words
        self.count = count

    def remove(self, values: Tensor, of_class: Tensor | None = None) -> None:
        """Take out rows that were added, exactly; arguments as for ``update``.

        Raises:
            ValueError: as for ``update``, or if what would remain cannot be sums of rows; nothing
                is taken out then. Not everything that was never added shows that way.
        """
        of_class = self._checked(values, of_class)
        count = self.count - torch.bincount(of_class, minlength=len(self.count))
        taken = torch.zeros_like(self.words)
        _add(values, of_class, taken)
        words = self.words - taken
        if bool((count < 0).any()) or bool((words[1:] < 0).any()):
            raise ValueError("cannot remove rows that were never added to these sums")
        self.words = words
        self.count = count

    def totals(self) -> Totals:
        """Sum, mean and sum of squared deviations of every column in every class."""
        num_classes, num_columns = self.words.shape[1:3]
        sums, squares = self._long_integers()
        rows: list[tuple[float, float, float]] = []
        for cell, (first, second) in enumerate(zip(sums, squares, strict=True)):
            count = max(int(self.count[cell // num_columns]), 1)
            # in units of 2^-149 and 2^-298; Python rounds a quotient of integers correctly
            deviations = count * second - first * first
            rows.append((first / (1 << 149), first / (count << 149), deviations / (count << 298)))
        table = torch.tensor(rows, dtype=torch.float64).reshape(num_classes, num_columns, 3)
        return Totals(*(part.contiguous() for part in table.unbind(-1)))

    def state_dict(self) -> dict[str, Tensor]:
        """Plain tensors; only buckets that hold something, in order."""
        place = self._occupied()
        return {
            "count": self.count.clone(),
            "size": torch.tensor(self.words.shape[1:3]),
            "place": place,
            "words": self.words.view(_WORDS, -1)[:, place],
        }

    @classmethod
    def from_state_dict(cls, state: dict[str, Tensor]) -> ExactSums:
        """The sums that ``state_dict`` described."""
        num_classes, num_columns = state["size"].tolist()
        sums = cls(num_columns, num_classes)
        sums.count = state["count"].clone()
        sums.words.view(_WORDS, -1)[:, state["place"]] = state["words"]
        return sums

    def _checked(self, values: Tensor, of_class: Tensor | None) -> Tensor:
        num_classes, num_columns = self.words.shape[1:3]
        if values.dtype != torch.float32:
            raise ValueError(f"expected float32 values, got {values.dtype}; hand values.float()")
        if values.ndim != 2 or values.shape[1] != num_columns:
            raise ValueError(f"expected values [N, {num_columns}], got {tuple(values.shape)}")
        if values.numel() and not bool(torch.stack(values.aminmax()).isfinite().all()):
            row, column = (~values.isfinite()).nonzero()[0].tolist()
            raise ValueError(
                f"expected finite values, got {float(values[row, column])} in row {row}, "
                f"column {column}"
            )
        if of_class is None:
            return torch.zeros(len(values), dtype=torch.int64)
        if of_class.shape != values.shape[:1]:
            raise ValueError(
                f"expected the classes of {len(values)} rows, got {tuple(of_class.shape)}"
            )
        of_class = of_class.to("cpu", torch.int64)
        if bool(((of_class < 0) | (of_class >= num_classes)).any()):
            raise ValueError(
                f"classes must lie in 0..{num_classes - 1}, got {of_class.min()}..{of_class.max()}"
            )
        return of_class

    def _occupied(self) -> Tensor:
        """Flat indices of buckets that are not empty, ascending."""
        return (self.words != 0).any(0).view(-1).nonzero().squeeze(-1)

    def _long_integers(self) -> tuple[list[int], list[int]]:
        """Exact sums of values in units of 2^-149 and of squares in 2^-298, class by class."""
        num_cells = self.words[0, ..., 0].numel()
        sums, squares = [0] * num_cells, [0] * num_cells
        place = self._occupied()
        words = self.words.view(_WORDS, -1)[:, place].tolist()
        for index, first, upper, lower in zip(place.tolist(), *words, strict=True):
            cell, bucket = divmod(index, _BUCKETS)
            sums[cell] += first << (8 * bucket)
            squares[cell] += ((upper << _HALF_BITS) + lower) << (16 * bucket)
        return sums, squares


def _refuse_overflow(count: Tensor) -> None:
    if bool((count > MOST_ROWS).any()):
        raise ValueError(f"exact sums hold at most {MOST_ROWS} rows of a class, got {count.max()}")


def _add(values: Tensor, of_class: Tensor, words: Tensor) -> None:
    """Add rows to buckets in place, with integer operations alone."""
    num_columns = words.shape[2]
    flat = words.view(_WORDS, -1)
    column = torch.arange(num_columns) * _BUCKETS
    start = of_class[:, None] * (num_columns * _BUCKETS)
    rows = max(_CHUNK_VALUES // max(num_columns, 1), 1)
    chunks = values.cpu().split(rows)
    for chunk, chunk_start in zip(chunks, start.split(rows), strict=True):
        bits = chunk.contiguous().view(torch.int32)
        field = (bits >> 23) & 0xFF
        mantissa = (bits & 0x7FFFFF) | (field.clamp(max=1) << 23)
        exponent = field.clamp(min=1) - 1
        size = (mantissa << (exponent & 7)).long()
        sign = (bits >> 31).long()  # 0 or -1, which turns x into -x as (x ^ -1) - -1
        square = size * size
        place = ((exponent >> 3).long() + column + chunk_start).view(-1)
        flat[0].scatter_add_(0, place, ((size ^ sign) - sign).view(-1))
        flat[1].scatter_add_(0, place, (square >> _HALF_BITS).view(-1))
        flat[2].scatter_add_(0, place, (square & ((1 << _HALF_BITS) - 1)).view(-1))

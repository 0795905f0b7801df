"""Samples of a NumPy array that stay in their file and are read by stretches."""

from __future__ import annotations

import math
from typing import IO, Any, NamedTuple

import numpy as np
import torch
from numpy.lib import format as npy
from torch import Tensor

_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}

MOST_SAMPLES = 2**40  # an array without channels could claim any number


class StoredSamples(NamedTuple):
    """Samples ``[C, T]`` in an open file from byte ``start`` on.

    The samples of a channel stand together there or, if not ``is_by_channel``, those of an instant.
    """

    file: IO[bytes]
    start: int
    stored: np.dtype[Any]
    num_channels: int
    num_samples: int
    is_by_channel: bool

    @property
    def dtype(self) -> torch.dtype:
        """``float32`` for what it holds exactly, else ``float64``."""
        small = self.stored.itemsize <= (4 if self.stored.kind == "f" else 2)
        return torch.float32 if small else torch.float64

    def read(self, first: int, stop: int) -> Tensor:
        """Samples from ``first`` to before ``stop``, as far as there are any, ``[C, n]``.

        Raises:
            ValueError: if the file has been cut since it was opened.
        """
        count = max(min(stop, self.num_samples) - first, 0)
        step, width = 1 if self.is_by_channel else self.num_channels, self.stored.itemsize
        rows = self.num_channels // step
        content = bytearray()
        for row in range(rows):
            self.file.seek(self.start + (row * self.num_samples + first * step) * width)
            content += self.file.read(count * step * width)
        if len(content) < self.num_channels * count * width:
            raise ValueError(f"{self.file.name} was cut while it was read; make it again")
        wanted = np.float32 if self.dtype == torch.float32 else np.float64
        values = np.frombuffer(content, self.stored).astype(wanted, copy=False)
        by_channel = values.reshape(rows, count, step).swapaxes(1, 2)
        return torch.from_numpy(by_channel.reshape(self.num_channels, count))


class ArrayHead(NamedTuple):
    """What the header of an array says, and where its values begin."""

    shape: tuple[int, ...]
    is_fortran: bool
    dtype: np.dtype[Any]
    start: int

    @property
    def end(self) -> int:
        """Where its values end."""
        return self.start + math.prod(self.shape) * self.dtype.itemsize


def array_head(file: IO[bytes]) -> ArrayHead:
    """The header of the array that begins where the file is.

    Raises:
        ValueError: if it is not of numbers in two dimensions, or not all there.
    """
    version = npy.read_magic(file)  # type: ignore[no-untyped-call]
    shape, is_fortran, dtype = _HEADERS[version](file)  # type: ignore[no-untyped-call]
    head = ArrayHead(shape, is_fortran, dtype, file.tell())
    is_number = dtype.kind in "iu" or (dtype.kind == "f" and dtype.itemsize in (4, 8))
    if len(shape) != 2 or not is_number or not any(shape) or min(shape) < 0:
        raise ValueError("samples must be numbers in two dimensions")
    if head.end > file.seek(0, 2) or max(shape) > MOST_SAMPLES:
        raise ValueError("samples must be all there")
    return head


def stored_samples(file: IO[bytes], head: ArrayHead, *, is_time_first: bool) -> StoredSamples:
    """The samples behind such a header, ``[T, C]`` or ``[C, T]``.

    Raises:
        ValueError: if there is no channel.
    """
    num_channels, num_samples = reversed(head.shape) if is_time_first else head.shape
    if not num_channels:
        raise ValueError("samples must be of a channel at least")
    is_by_channel = head.is_fortran == is_time_first
    return StoredSamples(file, head.start, head.dtype, num_channels, num_samples, is_by_channel)

"""Which batches a statistic holds, and of what: none twice, none taken out unseen, none mixed."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor


class Ledger:
    """Batch ids and a digest of what each batch held.

    Args:
        entries: id to digest.
    """

    def __init__(self, entries: Mapping[str, str] | None = None) -> None:
        self.entries = dict(entries or {})

    def __len__(self) -> int:
        return len(self.entries)

    def add(self, batch_id: str, digest: str) -> None:
        """Note a batch.

        Raises:
            ValueError: if the id is there already.
        """
        if batch_id in self.entries:
            raise ValueError(f"batch {batch_id!r} is in these statistics already; add it once")
        self.entries[batch_id] = digest

    def remove(self, batch_id: str, digest: str) -> None:
        """Strike a batch out.

        Raises:
            ValueError: if it was never added, or held something else.
        """
        if batch_id not in self.entries:
            raise ValueError(f"batch {batch_id!r} was never added to these statistics")
        if self.entries[batch_id] != digest:
            raise ValueError(
                f"batch {batch_id!r} was added with other content; remove what was added"
            )
        del self.entries[batch_id]

    def merge(self, other: Ledger) -> None:
        """Take over the entries of another ledger.

        Raises:
            ValueError: if a batch is in both; nothing is taken over then.
        """
        both = sorted(self.entries.keys() & other.entries.keys())
        if both:
            raise ValueError(
                f"{len(both)} batches are in both statistics, such as {both[0]!r}; "
                "merge each shard once"
            )
        self.entries |= other.entries


def content_digest(*tensors: Tensor) -> str:
    """A digest of dtype, shape and bytes of tensors."""
    digest = hashlib.blake2b(digest_size=16)
    for tensor in tensors:
        digest.update(f"{tensor.dtype}{tuple(tensor.shape)}".encode())
        if tensor.numel():  # an empty one may have strides that no view of bytes takes
            flat = tensor.detach().cpu().contiguous().as_strided((tensor.numel(),), (1,))
            content = flat.view(torch.uint8)  # which strides of axes of length 1 would not allow
            digest.update(content.numpy().data)  # no copy, and NumPy need not know the dtype
    return digest.hexdigest()


def first_difference(ours: Any, theirs: Any, name: str = "") -> str:
    """The path of the first differing key of nested mappings and lists, with both values."""
    if ours == theirs:
        return ""
    if type(ours) is type(theirs) is list:
        ours, theirs = dict(enumerate(ours)), dict(enumerate(theirs))
    if type(ours) is type(theirs) is dict:
        for key in sorted(ours.keys() | theirs.keys()):
            ours_there = ours.get(key, _ABSENT)
            found = first_difference(ours_there, theirs.get(key, _ABSENT), f"{name}.{key}")
            if found:
                return found
    return f"{name.removeprefix('.')}: {_shown(ours)} and {_shown(theirs)}"


_ABSENT = object()


def _shown(value: Any) -> str:
    if value is _ABSENT:
        return "nothing"
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."

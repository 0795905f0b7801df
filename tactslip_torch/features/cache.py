"""Features on disk, one file per recording, found again by everything that determines them."""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tactslip_torch.runtime import PACKAGE, __version__, whole_file

log = logging.getLogger(__name__)


def default_cache_folder() -> Path:
    """``tactslip_torch`` in the user's cache folder (``XDG_CACHE_HOME`` or ``~/.cache``)."""
    root = os.environ.get("XDG_CACHE_HOME")
    return (Path(root) if root else Path.home() / ".cache") / "tactslip_torch"


def cache_key(facts: Mapping[str, Any]) -> str:
    """A file name for JSON-able facts: equal facts, equal name.

    Example:
        >>> cache_key({"a": 1, "b": 2}) == cache_key({"b": 2, "a": 1})
        True
    """
    text = json.dumps(facts, sort_keys=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def source_digest(package: Path = PACKAGE) -> str:
    """A digest of every source below a folder, so that features of changed code are not served."""
    digest = hashlib.sha256()
    for path in sorted(p for p in package.rglob("*") if p.suffix in (".py", ".cpp", ".h")):
        digest.update(path.relative_to(package).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def versions() -> dict[str, str]:
    """What made a result, for files that say so."""
    return {
        "tactslip_torch": __version__,
        "torch": torch.__version__,
        "code": source_digest(),
    }


class FeatureCache:
    """Float32 features by key, in NPZ files, which have a checksum.

    A damaged file counts as absent, and is written again.

    Args:
        folder: made when first written to.
        most_bytes: ``prune`` deletes the least recently used files beyond this.
    """

    def __init__(self, folder: str | os.PathLike[str], most_bytes: int = 4 * 2**30) -> None:
        self.folder = Path(folder)
        self.most_bytes = most_bytes

    def load(self, key: str) -> tuple[Tensor, int] | None:
        """Features ``[N, F]`` and the longest run of equal samples; ``None`` if damaged or none."""
        path = self._path(key)
        try:
            with path.open("rb") as file, np.load(file) as content:
                features = torch.from_numpy(content["features"])
                longest_run = int(content["longest_run"])
            os.utime(path)  # prune drops what was used longest ago
        except FileNotFoundError:
            return None
        except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile):
            log.warning("cached features %s are damaged; computing them again", path)
            return None
        return features, longest_run

    def store(self, key: str, features: Tensor, longest_run: int) -> None:
        """Write features ``[N, F]`` and the longest run, whole or not at all."""
        with whole_file(self._path(key)) as temporary, temporary.open("wb") as file:
            array = features.numpy().astype("<f4", order="C")
            np.savez(file, features=array, longest_run=np.int64(longest_run))

    def prune(self) -> None:
        """Delete the least recently used files until the folder holds at most ``most_bytes``."""
        found = []
        for path in self.folder.glob("*/[!.]*.npz"):  # a dot begins one being written
            with contextlib.suppress(FileNotFoundError):  # another run may prune as well
                status = path.stat()
                found.append((status.st_mtime, status.st_size, path))
        total = sum(size for _, size, _ in found)
        for _, size, path in sorted(found):
            if total <= self.most_bytes:
                return
            path.unlink(missing_ok=True)
            total -= size

    def _path(self, key: str) -> Path:
        return self.folder / key[:2] / f"{key}.npz"

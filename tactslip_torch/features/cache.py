"""Features on disk, one file per recording, found again by everything that determines them."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import logging
import os
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from tactslip_torch.runtime import PACKAGE, __version__, whole_file

log = logging.getLogger(__name__)
_MAKE_FEATURES = (
    "hand.py",
    "runtime.py",
    "package_files.py",
    "signals",
    "data",
    "features",
    "native",
    "training/bins.py",
    "training/datamodule.py",
)
_reported: set[tuple[str, str]] = set()


def default_cache_folder() -> Path:
    """``tactslip_torch`` in the user's cache folder (``XDG_CACHE_HOME`` or ``~/.cache``)."""
    root = os.environ.get("XDG_CACHE_HOME")
    return (Path(root) if root else Path.home() / ".cache") / "tactslip_torch"


def cache_key(metadata: Mapping[str, Any]) -> str:
    """A file name for JSON-able metadata: equal metadata, equal name.

    Example:
        >>> cache_key({"a": 1, "b": 2}) == cache_key({"b": 2, "a": 1})
        True
    """
    text = json.dumps(metadata, sort_keys=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def source_digest(package: Path = PACKAGE, parts: Sequence[str] = (".",)) -> str:
    """A digest of every source below some files and folders of a package."""
    digest = hashlib.sha256()
    roots = [package / part for part in parts]
    paths = {path for root in roots for path in (root, *root.rglob("*"))}
    sources = [p for p in paths if p.suffix in (".py", ".cpp", ".h") and p.is_file()]
    for path in sorted(sources):
        digest.update(path.relative_to(package).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def features_digest(package: Path = PACKAGE, *, simulated: bool) -> str:
    """A digest of the sources that make features, of simulated recordings those of samples too.

    What else a package holds, such as hosts in a wheel, does not count.
    """
    return source_digest(package, [*_MAKE_FEATURES, *(["simulation"] if simulated else [])])


def versions() -> dict[str, str]:
    """What made a result, for files that say so."""
    return {
        "tactslip_torch": __version__,
        "torch": torch.__version__,
        "code": source_digest(),
    }


class KeptFeatures(NamedTuple):
    """What is kept of the bins of a recording.

    Attributes:
        features: ``[N, F]``, float32.
        span: of each filtered channel, 0 if it is within the rounding of the raw samples,
            ``[N, C]``, float64.
        run: most equal raw samples in a row of each channel, ``[N, C]``, int64.
        longest_run: of all channels that move, of the whole recording.
    """

    features: Tensor
    span: Tensor
    run: Tensor
    longest_run: int


_ARRAYS = (*KeptFeatures._fields, "columns")


class FeatureCache:
    """Features of recordings by key, in NPZ files, which have a checksum.

    It never ends a run: what cannot be read counts as absent, what cannot be written is left out,
    and the log warns once for each cause and folder.

    Args:
        folder: made when first written to.
        most_bytes: ``prune`` deletes the least recently used files beyond this.
    """

    def __init__(self, folder: str | os.PathLike[str], most_bytes: int = 4 * 2**30) -> None:
        self.folder = Path(folder)
        self.most_bytes = most_bytes

    def load(self, key: str, columns: Sequence[int]) -> KeptFeatures | None:
        """What is kept of a recording.

        Args:
            key: of the file.
            columns: numbers of the features in the whole pool.

        Returns:
            ``None`` if there is no file, it is damaged, or lacks a column.
        """
        path = self._path(key)
        try:
            with zipfile.ZipFile(path) as content:  # to their ends, where the checksums are
                features, span, run, longest_run, stored = (
                    np.load(io.BytesIO(content.read(f"{name}.npy"))) for name in _ARRAYS
                )
        except FileNotFoundError:
            return None
        except OSError as error:
            self._warn(f"cannot be read: {_cause(error)}", path)
            return None
        except Exception:  # zipfile, zlib and NumPy raise many of damaged bytes
            self._warn("are damaged", path)
            return None
        with contextlib.suppress(OSError):
            os.utime(path)  # prune drops what was used longest ago
        if stored.tolist() != list(columns):
            place = {column: index for index, column in enumerate(stored.tolist())}
            if not place.keys() >= set(columns):
                return None
            features = features[:, [place[column] for column in columns]]
        features, span, run = map(torch.from_numpy, (features, span, run))
        return KeptFeatures(features, span, run, int(longest_run))

    def store(self, key: str, columns: Sequence[int], made: KeptFeatures) -> None:
        """Write what is kept of a recording and its features' numbers, whole or not at all."""
        arrays: dict[str, Any] = made._asdict() | {"columns": np.array(columns, dtype=np.int64)}
        arrays["features"] = made.features.numpy().astype("<f4", order="C")
        try:
            with whole_file(self._path(key)) as temporary, temporary.open("wb") as file:
                np.savez(file, **arrays)
        except OSError as error:
            self._warn(f"cannot be stored: {_cause(error)}", self._path(key))

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
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)
            total -= size

    def _warn(self, cause: str, path: Path) -> None:
        if (str(self.folder), cause) not in _reported:
            _reported.add((str(self.folder), cause))
            log.warning("cached features %s %s; they are computed anew", path, cause)

    def _path(self, key: str) -> Path:
        return self.folder / key[:2] / f"{key}.npz"


def _cause(error: OSError) -> str:
    return os.strerror(error.errno) if error.errno else str(error)

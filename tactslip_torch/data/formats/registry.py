"""Which format a file is of, by its ending; a further format is a further line."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tactslip_torch.data.formats.header import Archived
from tactslip_torch.data.formats.reading import AS_IT_SAYS, Opened, Reading
from tactslip_torch.data.recording import Recording
from tactslip_torch.hand import HandLayout

ROSBAG_METADATA = "metadata.yaml"


@dataclass(frozen=True)
class Format:
    """How recordings are kept in files.

    Args:
        name: of the module beside this one.
        endings: of its files, the first that of files that are written.
        is_folder: whether a recording is a folder, known by ``metadata.yaml``.
    """

    name: str
    endings: tuple[str, ...]
    is_folder: bool = False

    def save(
        self, path: Path, recording: Recording, hand: HandLayout, key: Mapping[str, Any]
    ) -> None:
        """Write a recording, whole or not at all."""
        self._function("save")(path, recording, hand, key)

    def load(self, path: Path) -> Archived:
        """Read a recording of ours, bit for bit."""
        found: Archived = self._function("load")(path)
        return found

    def key(self, path: Path) -> dict[str, Any]:
        """Read no more of a recording of ours than its key."""
        found: dict[str, Any] = self._function("key")(path)
        return found

    def open(self, path: Path, how: Reading = AS_IT_SAYS) -> AbstractContextManager[Opened]:
        """Open a file, ours or another's, to read its samples by stretches."""
        found: AbstractContextManager[Opened] = self._function("open")(path, how)
        return found

    def _function(self, name: str) -> Callable[..., Any]:
        module = importlib.import_module(f"tactslip_torch.data.formats.{self.name}")
        function: Callable[..., Any] = getattr(module, name)
        return function


FORMATS = {
    form.name: form
    for form in (
        Format("npz", ("npz", "npy")),
        Format("text", ("csv", "tsv", "txt", "dat", "lvm")),
        Format("hdf5", ("h5", "hdf5", "he5")),
        Format("mat", ("mat",)),
        Format("mcap", ("mcap",)),
        Format("parquet", ("parquet",)),
        Format("rosbag2", ("bag2",), is_folder=True),
    )
}
"""By name; each is imported when it is first used."""


def endings() -> tuple[str, ...]:
    """Endings of files that can be read."""
    return tuple(ending for form in FORMATS.values() for ending in form.endings)


def find_format(path: Path) -> Format | None:
    """The format of a file, or of a folder that is a bag; None if there is none."""
    if path.is_dir():
        is_bag = (path / ROSBAG_METADATA).is_file()
        return next((f for f in FORMATS.values() if f.is_folder and is_bag), None)
    ending = "" if path.name.startswith(".") else path.suffix[1:].lower()
    return next((f for f in FORMATS.values() if ending in f.endings and not f.is_folder), None)


def format_of(path: Path) -> Format:
    """The format of a file or bag.

    Raises:
        FileNotFoundError: if there is nothing.
        ValueError: if it is of no format that is known.
    """
    if not path.exists():
        raise FileNotFoundError(f"no file or folder at {path}")
    found = find_format(path)
    if found is None:
        known = " or ".join(f".{ending}" for ending in endings())
        raise ValueError(f"{path} must end in {known} to be read as a recording")
    return found


def named_format(name: str) -> Format:
    """The format of that name, or of files with that ending, such as ``npz`` or ``h5``.

    Raises:
        ValueError: if there is none.
    """
    for form in FORMATS.values():
        if name == form.name or name in form.endings:
            return form
    raise ValueError(f"format must be one of {', '.join(FORMATS)}, got {name!r}")


def open_file(path: Path, how: Reading = AS_IT_SAYS) -> AbstractContextManager[Opened]:
    """Open a recording of any format; errors as ``format_of`` and the format's ``open``."""
    return format_of(path).open(path, how)

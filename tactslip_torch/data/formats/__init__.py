"""Recordings in files: NumPy, text, HDF5, MAT, Parquet, MCAP, and rosbag2 and LeRobot to read.

Whatever a library raises of a file becomes one line that names it. Nothing in a file is executed,
and what it claims is held against its size before anything is allocated; beyond that the libraries
are trusted. Files are written to a temporary name and renamed.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from tactslip_torch.data.formats import _parquet
from tactslip_torch.data.formats._inference import Refused
from tactslip_torch.data.formats._reading import (
    Archived,
    Opened,
    Reading,
    Samples,
    guarded,
    header_of,
    pieces,
    unfolded,
)
from tactslip_torch.data.recording import Recording
from tactslip_torch.hand import HandLayout
from tactslip_torch.runtime import whole_file

__all__ = [
    "FORMATS",
    "Archived",
    "Format",
    "Opened",
    "Reading",
    "Refused",
    "Samples",
    "endings",
    "episodes_of",
    "file_of",
    "find_format",
    "format_of",
    "is_there",
    "named_format",
    "open_file",
    "pieces",
]


@dataclass(frozen=True)
class Format:
    """How recordings are kept in files.

    Args:
        name: of the format.
        endings: of its files, the first that of files that are written.
        module: the adapter, with its functions ``write`` and ``read``.
        kind: behind the names of these functions, where a module serves several formats.
        is_folder: whether a recording is a folder, known by ``metadata.yaml``; only read.
    """

    name: str
    endings: tuple[str, ...]
    module: str
    kind: str = ""
    is_folder: bool = False

    def save(
        self, path: Path, recording: Recording, hand: HandLayout, key: Mapping[str, Any]
    ) -> None:
        """Write a recording, whole or not at all; equal input, equal bytes.

        Args:
            path: of the file.
            recording: samples in float32 or float64; tuples in its provenance come back as lists.
            hand: its channels, in the order of its rows.
            key: JSON-able metadata that determined the samples, kept to find the file again.

        Raises:
            ValueError: if the format's library is absent, the hand has another number of channels,
                the samples another dtype, a word holds a NUL, provenance or key is not JSON-able,
                or the format cannot hold that much.
        """
        header = header_of(recording, hand, key)
        samples = recording.samples.detach().cpu().contiguous().numpy()
        with whole_file(path) as temporary:
            try:
                self._adapter("write")(temporary, samples, header)
            except Refused as error:
                raise Refused(f"{path} {error}".replace(str(temporary), str(path))) from None

    def load(self, path: Path) -> Archived:
        """Read a package file, bit for bit (of text a NaN is a NaN).

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if it is damaged or no package file.
        """
        with self.open(path) as opened:
            if opened.archived is None:
                raise Refused(f"{path} is no recording of this package")
            samples = opened.samples.read(0, opened.samples.num_samples)
            recording = replace(opened.archived.recording, samples=samples)
            return opened.archived._replace(recording=recording)

    def is_native(self, path: Path) -> bool:
        """Whether a file is a package file, even one that is damaged: only such may be replaced."""
        try:
            with self.open(path) as opened:
                return opened.archived is not None
        except ValueError:
            is_file = path.is_file()
            return is_file and b"tactslip_torch" in path.read_bytes().replace(b"\0", b"")

    @contextmanager
    def open(self, path: Path, how: Reading | None = None) -> Iterator[Opened]:
        """Open a file, native or foreign, to read its samples by stretches.

        Args:
            path: of the file or folder.
            how: what the file does not say itself.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: in one line that names the file, if it is damaged, its library is absent, or
                it does not show which samples are meant.
        """
        how = how or Reading()
        with ExitStack() as stack:
            with guarded(path):
                self._check(path)
                opened = self._adapter("read")(path, how, stack)
                if opened.archived is None:
                    if how.label is not None and opened.labels is None:
                        raise Refused(f"is of {self.name}, of which labels.column is not read")
                    if how.samples_per_row > 1:
                        opened = unfolded(opened, how)
            yield opened

    def _adapter(self, action: str) -> Callable[..., Any]:
        module = importlib.import_module(f"tactslip_torch.data.formats.{self.module}")
        call: Callable[..., Any] = getattr(module, action + self.kind)
        return call

    def _check(self, path: Path) -> None:
        """Refuse what is no plain file or folder: reading a pipe would wait for ever."""
        if self is _EPISODE:
            return
        if not path.exists():
            raise FileNotFoundError(path)
        if not (path.is_dir() if self.is_folder else path.is_file()):
            raise Refused(f"must be a {'folder' if self.is_folder else 'file'}")
        if not self.is_folder:
            with path.open("rb") as file:
                head = file.read(len(_LFS))
            if not head:
                raise Refused("is empty")
            if head == _LFS:
                raise Refused("is a Git LFS pointer, not the file itself; run: git lfs pull")


_LFS = b"version https://git-lfs.github.com/spec/"
FORMATS = {
    form.name: form
    for form in (
        Format("npz", ("npz", "npy"), "_arrays", "_npz"),
        Format("text", ("csv", "tsv", "txt", "dat", "lvm"), "_text"),
        Format("hdf5", ("h5", "hdf5", "he5"), "_arrays", "_hdf5"),
        Format("mat", ("mat",), "_arrays", "_mat"),
        Format("parquet", ("parquet",), "_parquet"),
        Format("mcap", ("mcap",), "_messages", "_mcap"),
    )
}
"""By name; all are written and read."""
_BAG = Format("rosbag2", ("bag2",), "_messages", "_rosbag2", is_folder=True)
_EPISODE = Format("LeRobot", (_parquet.EPISODE_ENDING[1:],), "_parquet", "_episode")


def episodes_of(folder: Path) -> list[Path] | None:
    """The recordings of a LeRobot dataset, which are no files; ``None`` of another folder.

    Raises:
        ValueError: if it is a damaged one.
    """
    with guarded(folder):
        return _parquet.episodes_of(folder) if _parquet.is_dataset(folder) else None


def is_there(path: Path) -> bool:
    """Whether there is such a file or folder, or the dataset that an episode is named of."""
    return path.exists() or find_format(path) is _EPISODE


def file_of(path: Path) -> Path:
    """The file or folder that holds a recording: itself, or the table that an episode is in.

    Raises:
        ValueError: if there is no such episode.
    """
    with guarded(path):
        return _parquet.table_of(path) if find_format(path) is _EPISODE else path


def endings() -> tuple[str, ...]:
    """Endings of files that can be read."""
    return tuple(ending for form in FORMATS.values() for ending in form.endings)


def find_format(path: Path) -> Format | None:
    """The format of a file, or of a folder that is a bag; None if there is none."""
    if path.is_dir():
        return _BAG if (path / "metadata.yaml").is_file() else None
    if path.suffix == _parquet.EPISODE_ENDING and _parquet.is_dataset(path.parent):
        return _EPISODE
    ending = "" if path.name.startswith(".") else path.suffix[1:].lower()
    return next((form for form in FORMATS.values() if ending in form.endings), None)


def format_of(path: Path) -> Format:
    """The format of a file or bag.

    Raises:
        FileNotFoundError: if there is nothing.
        ValueError: if it is of no format that is known.
    """
    if not is_there(path):
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
    known = ", ".join(form.endings[0] for form in FORMATS.values())
    raise ValueError(f"format must be one of {known}, got {name!r}")


@contextmanager
def open_file(path: Path, how: Reading | None = None) -> Iterator[Opened]:
    """Open a recording of any format; errors as ``format_of`` and ``Format.open``."""
    with format_of(path).open(path, how) as opened:
        yield opened

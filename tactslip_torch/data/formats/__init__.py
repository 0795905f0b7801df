"""Recordings in files: NumPy, text, HDF5, MAT, Parquet, MCAP and rosbag2, through one door.

Episodes of LeRobot datasets are read as well, each as if it were a file (``_lerobot``).

Whatever a library raises of a file becomes one line that names it; nothing in a file is executed;
what it claims is held against its size before anything is allocated; files are written to a
temporary name and renamed. ``reading.isolate`` reads in a process of its own, with a limit of
memory and of time, since libraries written in C may be kept busy for ever, take all memory or die
of a file made on purpose. It costs the start of a Python with torch, a few seconds a file.
"""

from __future__ import annotations

import importlib
import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from tactslip_torch.data.formats import _lerobot
from tactslip_torch.data.formats._reading import (
    MOST_WHOLE,
    Archived,
    Opened,
    Reading,
    Refused,
    Samples,
    guarded,
    header_of,
    opened_from,
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
        is_folder: whether a recording is a folder, known by ``metadata.yaml``.
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
            path: of the file or folder.
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
        with (_whole_folder if self.is_folder else whole_file)(path) as temporary:
            try:
                self._adapter("write")(temporary, samples, header)
            except Refused as error:
                raise Refused(f"{path} {error}".replace(str(temporary), str(path))) from None

    def load(self, path: Path) -> Archived:
        """Read a recording of ours, bit for bit (of text a NaN is a NaN).

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if it is damaged or no file of ours.
        """
        with self.open(path) as opened:
            if opened.archived is None:
                raise Refused(f"{path} is no recording of ours")
            samples = opened.samples.read(0, opened.samples.num_samples)
            recording = replace(opened.archived.recording, samples=samples)
            return opened.archived._replace(recording=recording)

    def is_ours(self, path: Path) -> bool:
        """Whether a file is ours, even one that is damaged: only such may be replaced."""
        try:
            with self.open(path) as opened:
                return opened.archived is not None
        except ValueError:
            files = [f for f in path.rglob("*") if f.is_file()] if path.is_dir() else [path]
            return any(b"tactslip_torch" in f.read_bytes().replace(b"\0", b"") for f in files)

    @contextmanager
    def open(self, path: Path, how: Reading | None = None) -> Iterator[Opened]:
        """Open a file, ours or another's, to read its samples by stretches.

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
                opened = (_isolated if how.isolate else self._adapter("read"))(path, how, stack)
                if opened.archived is None and not how.isolate:
                    if how.speed is not None and opened.speed is None:
                        raise Refused(f"is of {self.name}, of which reading.speed is not read")
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


FORMATS = {
    form.name: form
    for form in (
        Format("npz", ("npz", "npy"), "_npz"),
        Format("text", ("csv", "tsv", "txt", "dat", "lvm"), "_text"),
        Format("hdf5", ("h5", "hdf5", "he5"), "_hdf5"),
        Format("mat", ("mat",), "_mat"),
        Format("mcap", ("mcap",), "_messages", "_mcap"),
        Format("parquet", ("parquet",), "_parquet"),
        Format("rosbag2", ("bag2",), "_messages", "_rosbag2", is_folder=True),
    )
}
"""By name; all can be written."""
_LFS = b"version https://git-lfs.github.com/spec/"
_EPISODE = Format("LeRobot", (_lerobot.ENDING[1:],), "_lerobot")


def episodes_of(folder: Path) -> list[Path] | None:
    """The recordings of a LeRobot dataset, which are no files; ``None`` of another folder.

    Raises:
        ValueError: if it is a damaged one.
    """
    with guarded(folder):
        return _lerobot.episodes_of(folder) if _lerobot.is_dataset(folder) else None


def is_there(path: Path) -> bool:
    """Whether there is such a file or folder, or the dataset that an episode is named of."""
    return path.exists() or find_format(path) is _EPISODE


def file_of(path: Path) -> Path:
    """The file or folder that holds a recording: itself, or the table that an episode is in.

    Raises:
        ValueError: if there is no such episode.
    """
    with guarded(path):
        return _lerobot.table_of(path) if find_format(path) is _EPISODE else path


def endings() -> tuple[str, ...]:
    """Endings of files that can be read."""
    return tuple(ending for form in FORMATS.values() for ending in form.endings)


def find_format(path: Path) -> Format | None:
    """The format of a file, or of a folder that is a bag; None if there is none."""
    if path.is_dir():
        return FORMATS["rosbag2"] if (path / "metadata.yaml").is_file() else None
    if path.suffix == _lerobot.ENDING and _lerobot.is_dataset(path.parent):
        return _EPISODE
    ending = "" if path.name.startswith(".") else path.suffix[1:].lower()
    return next((f for f in FORMATS.values() if ending in f.endings and not f.is_folder), None)


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
    raise ValueError(f"format must be one of {', '.join(FORMATS)}, got {name!r}")


@contextmanager
def open_file(path: Path, how: Reading | None = None) -> Iterator[Opened]:
    """Open a recording of any format; errors as ``format_of`` and ``Format.open``."""
    with format_of(path).open(path, how) as opened:
        yield opened


@contextmanager
def _whole_folder(path: Path) -> Iterator[Path]:
    """A folder to write, put in the place of ``path`` when all went well.

    Raises:
        Refused: if something other than a bag is there.
    """
    if path.exists() and not _is_only_bag(path):
        raise Refused(f"{path} is there and no folder of rosbag2; give another name")
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as around:
        made = Path(around, path.name)
        yield made
        if path.exists():
            path.rename(Path(around, f"{path.name}.before"))
        made.rename(path)


def _is_only_bag(path: Path) -> bool:
    """Whether a folder holds the files of a bag and nothing else, so that it may be replaced."""
    if not path.is_dir() or path.is_symlink():
        return False
    files = list(path.iterdir())
    are_of_bags = all(file.suffix in (".db3", ".mcap", ".yaml") for file in files)
    return not files or (find_format(path) is not None and are_of_bags)


# A process of its own ---------------------------------------------------------------------------

_STRETCH = 2**16  # samples at a time
_LIBRARIES = ("scipy.io", "h5py", "pyarrow.parquet", "mcap.reader", "rosbags.rosbag2")


def _isolated(path: Path, how: Reading, stack: ExitStack) -> Opened:
    """A file as a process of its own reads it, all samples in a temporary folder (``TMPDIR``).

    Raises:
        Refused: if it is refused there, or the process goes beyond a limit or dies.
    """
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
    asked = {"path": str(path), "how": asdict(replace(how, isolate=False))}
    program = "from tactslip_torch.data import formats; formats._read_for_parent()"
    try:
        done = subprocess.run(
            [sys.executable, "-c", program, folder],
            input=json.dumps(asked).encode(),
            capture_output=True,
            timeout=how.isolate_s,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise Refused(
            f"took more than {how.isolate_s:g} s to read; raise reading.isolate_s if it may"
        ) from None
    answer = folder / "answer.json"
    if done.returncode or not answer.exists():
        name = signal.Signals(-done.returncode).name if done.returncode < 0 else done.returncode
        raise Refused(
            f"ended the process that read it ({name}), within {how.isolate_gib:g} GiB of "
            "memory; raise reading.isolate_gib if it may take more"
        )
    found = json.loads(answer.read_text())
    if "refused" in found:
        raise Refused(found["refused"])
    kept: dict[str, Any] = {}
    for path_of in folder.glob("*.npy"):
        kept[path_of.stem] = np.load(path_of, mmap_mode="r")
    if found["header"] is not None:
        return opened_from(found["header"], path, kept["samples"])
    stamps, speed = (Samples(path, [kept[n]]) if n in kept else None for n in ("times", "speed"))
    names = None if found["names"] is None else tuple(found["names"])
    samples, rate = Samples(path, kept["samples"]), found["sample_rate_hz"]
    return Opened(samples, None, names, stamps, "s", rate, speed, tuple(found["left_out"]))


def _read_for_parent() -> None:
    """Read the file that standard input names, within the limits it states."""
    folder, asked = Path(sys.argv[1]), json.loads(sys.stdin.read())
    path, how = Path(asked["path"]), Reading(**asked["how"])
    for name in _LIBRARIES:
        with suppress(ImportError):
            importlib.import_module(name)
    _limit(how)
    try:
        with open_file(path, how) as opened:
            answer = _written(opened, folder)
    except (OSError, ValueError, MemoryError) as error:
        answer = {"refused": str(error) or f"{path} needs more memory than reading.isolate_gib"}
    (folder / "answer.json").write_text(json.dumps(answer))


def _limit(how: Reading) -> None:
    """Limits of memory beyond what is in use, of computing time, and of files written."""
    import resource  # of Unix alone

    torch.set_num_threads(1)
    in_use = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    limits = {
        resource.RLIMIT_AS: in_use + int(how.isolate_gib * 2**30),
        resource.RLIMIT_CPU: int(how.isolate_s) + 1,
        resource.RLIMIT_FSIZE: 16 * MOST_WHOLE,
        resource.RLIMIT_CORE: 0,
    }
    for limit, most in limits.items():
        resource.setrlimit(limit, (most, most))


def _written(opened: Opened, folder: Path) -> dict[str, Any]:
    """Samples, times and speed as arrays in files, and the rest as plain values."""
    samples, archived, times, speed = opened.samples, opened.archived, opened.times(), opened.speed
    head = {"fortran_order": False, "shape": (samples.num_samples, samples.num_channels)}
    head["descr"] = "<f4" if samples.dtype == torch.float32 else "<f8"
    with (folder / "samples.npy").open("wb") as file:
        np.lib.format.write_array_header_1_0(file, head)  # type: ignore[no-untyped-call]
        for piece in pieces(samples, _STRETCH):
            file.write(piece.T.contiguous().numpy().data)
    if times is not None:
        np.save(folder / "times.npy", times)
    if speed is not None:
        np.save(folder / "speed.npy", speed.read(0, speed.num_samples)[0].double())
    header = None
    if archived is not None:
        header = header_of(archived.recording, archived.hand, archived.key)
        header["shape"] = [samples.num_channels, samples.num_samples]
    plain = {name: getattr(opened, name) for name in ("names", "sample_rate_hz", "left_out")}
    return plain | {"header": header}

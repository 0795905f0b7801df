"""Recordings as MAT files: ours, and the variables that people have.

Ours are of version 5, written by SciPy. Both versions are read: 5 as it stands (``mat5``), with no
library; 7.3, which is HDF5 underneath, by h5py and with MATLAB's order of rows and columns.
Version 5 has no check sums, so a damaged number is not noticed there.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tactslip_torch.data.formats.arrays import Array, Contents, MatrixSamples
from tactslip_torch.data.formats.choosing import LABEL_NAMES, choose
from tactslip_torch.data.formats.header import Archived, archived_from, facts_of, header_of
from tactslip_torch.data.formats.mat5 import look_through
from tactslip_torch.data.formats.mat5_elements import HEADER_BYTES, is_mat5, unpacked
from tactslip_torch.data.formats.mat73 import look_through_73
from tactslip_torch.data.formats.reading import AS_IT_SAYS, Opened, Reading, needs
from tactslip_torch.data.formats.refusing import Refused, is_ours, refusing
from tactslip_torch.data.recording import Recording
from tactslip_torch.files import whole_file
from tactslip_torch.hand import HandLayout

_TITLE = b"MATLAB 5.0 MAT-file, written by tactslip_torch"
_TITLE_BYTES = 116
_MOST_BYTES = 2**31 - 2**10  # of a variable of version 5


class _Variables(NamedTuple):
    arrays: Sequence[Array]
    words: Mapping[str, tuple[str, ...]]
    refused: Mapping[str, str]


def save(
    path: str | os.PathLike[str], recording: Recording, hand: HandLayout, key: Mapping[str, Any]
) -> None:
    """Write a recording to a MAT file of version 5, whole or not at all; equal input, equal bytes.

    The file holds ``samples`` ``[C, T]``, ``sample_rate_hz``, ``units``, the cell array
    ``channel_name``, and everything else as JSON text in ``header``.

    Args:
        path: of the file.
        recording: samples in float32 or float64, of less than 2 GiB; tuples in its provenance come
            back as lists.
        hand: its channels, in the order of its rows.
        key: JSON-able facts that determined the samples, kept to find the file again.

    Raises:
        ValueError: if SciPy is absent, the samples are too many or of another dtype, the hand has
            another number of channels, or provenance or key is not JSON-able.
    """
    scipy_io = needs("scipy.io", "writing .mat")
    header = header_of(recording, hand, key)
    samples = recording.samples.detach().cpu().numpy()
    if samples.nbytes > _MOST_BYTES:
        raise ValueError(
            f"{os.fspath(path)}: {samples.nbytes} bytes of samples, a MAT file of version 5 holds "
            f"{_MOST_BYTES}; save as .h5"
        )
    names = np.empty((len(hand), 1), dtype=object)
    names[:, 0] = hand.names
    content = {
        "header": header,
        "samples": samples,
        "sample_rate_hz": float(recording.sample_rate_hz),
        "units": recording.units,
        "channel_name": names,
    }
    with whole_file(path) as temporary, temporary.open("w+b") as file:
        scipy_io.savemat(file, content, format="5", do_compression=False)
        file.seek(0)
        file.write(_TITLE.ljust(_TITLE_BYTES))  # instead of the time of day


def load(path: str | os.PathLike[str]) -> Archived:
    """What ``save`` wrote, bit for bit.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is damaged or none of ours.
    """
    with ExitStack() as stack, refusing(path):
        found = _variables(path, stack)
        samples = _our_samples(found)
        return archived_from(_our_header(found, path), samples.read(0, samples.num_samples))


def key(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The key of a file that ``save`` wrote; its samples are not read.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is none of ours.
    """
    with ExitStack() as stack, refusing(path):
        return dict(facts_of(_our_header(_variables(path, stack), path))["key"])


@contextmanager
def open(path: str | os.PathLike[str], how: Reading = AS_IT_SAYS) -> Iterator[Opened]:
    """A file of ours or of others, its samples to be read by stretches.

    Of others: the only matrix, or all vectors of one length as channels by name, also in structs
    (``trial.volts``); times by name; the rate by a number called ``sample_rate_hz``,
    ``sample_rate``, ``sampling_rate``, ``fs`` or ``rate``; names of channels by characters or
    cells called ``channel_name``, ``channels`` or ``labels``. Compressed variables of version 5
    are unpacked to a temporary file first, as long as they claim no more than 64 MiB or 100 times
    the file's size.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if a library is absent, the file is damaged, or does not show which samples
            are meant; the line names those that could be.
    """
    with ExitStack() as stack:
        with refusing(path):
            opened = _opened(path, _variables(path, stack), how)
        yield opened


def _variables(path: str | os.PathLike[str], stack: ExitStack) -> _Variables:
    file = stack.enter_context(Path(path).open("rb"))  # noqa: SIM115  # by the stack
    head = file.read(HEADER_BYTES)
    if is_mat5(head):
        return _Variables(*look_through(*unpacked(file, stack)))
    if not head.startswith((b"MATLAB 7.3", b"\x89HDF")):
        raise Refused(f"{os.fspath(path)} must be a MAT file of version 5 or 7.3")
    return _Variables(*look_through_73(path, stack))


def _opened(path: str | os.PathLike[str], found: _Variables, how: Reading) -> Opened:
    if "header" in found.words and is_ours(found.words["header"][0]):
        samples = _our_samples(found)
        archived = archived_from(_our_header(found, path), samples.read(0, 0))
        rate = archived.recording.sample_rate_hz
        return Opened(samples, archived, archived.hand.names, None, rate)

    def labels(name: str) -> Iterator[tuple[str, ...]]:
        near = name.rpartition(".")[0]
        called = [at for at in found.words if at.rpartition(".")[2].lower() in LABEL_NAMES]
        called.sort(key=lambda at: at.rpartition(".")[0] != near)
        yield from (found.words[at] for at in called)

    return choose(path, Contents(found.arrays, found.refused, labels), how)


def _our_header(found: _Variables, path: str | os.PathLike[str]) -> str:
    if "header" not in found.words:
        raise Refused(f"{os.fspath(path)} is no recording of ours: it has no header")
    return "".join(found.words["header"])


def _our_samples(found: _Variables) -> MatrixSamples:
    (samples,) = (array for array in found.arrays if array.name == "samples")
    return MatrixSamples(samples, time_axis=1)

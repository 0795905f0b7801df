"""Samples out of our files by other tools alone: the lines that anybody would write first."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Samples = NDArray[Any]


def by_npz(path: Path) -> Samples:
    """NumPy's archive; ``[C, T]`` as from the others."""
    with np.load(path) as content:
        return np.asarray(content["samples"])


def by_text(path: Path) -> Samples:
    """NumPy's reader of text, behind the line of facts and the line of names."""
    return np.loadtxt(path, delimiter=",", skiprows=2, dtype=np.float32)[:, 1:].T


def by_h5py(path: Path) -> Samples:
    """The dataset at once."""
    import h5py  # type: ignore[import-untyped]

    with h5py.File(path) as file:
        return np.asarray(file["samples"][()])


def by_scipy(path: Path) -> Samples:
    """SciPy's reader of MAT files, which reads every variable."""
    from scipy.io import loadmat

    return np.asarray(loadmat(path)["samples"])


def by_pyarrow(path: Path) -> Samples:
    """The table at once."""
    from pyarrow import parquet  # type: ignore[import-untyped]

    columns = parquet.read_table(path, use_threads=False).columns[1:]
    return np.stack([column.to_numpy() for column in columns])


def by_mcap(path: Path) -> Samples:
    """Every message of the reader, decoded by rosbags."""
    from mcap.reader import make_reader

    decode = _decoder()
    with path.open("rb") as file:
        messages = make_reader(file).iter_messages()
        return _joined(
            [decode(message.data, schema.name) for schema, _, message in messages if schema]
        )


def by_rosbags(path: Path) -> Samples:
    """Every message of the bag, decoded."""
    from rosbags.rosbag2 import Reader

    decode = _decoder()
    with Reader(path) as bag:
        return _joined([decode(raw, link.msgtype) for link, _, raw in bag.messages()])


NAIVE: Mapping[str, tuple[str, Callable[[Path], Samples]]] = {
    "npz": ("numpy.load", by_npz),
    "text": ("numpy.loadtxt", by_text),
    "hdf5": ("h5py, at once", by_h5py),
    "mat": ("scipy.io.loadmat", by_scipy),
    "mcap": ("mcap and rosbags", by_mcap),
    "rosbag2": ("rosbags", by_rosbags),
    "parquet": ("pyarrow.parquet.read_table", by_pyarrow),
}
"""By the format: what it is called, and how it reads all samples ``[C, T]``."""


def _decoder() -> Callable[[bytes, str], Any]:
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)

    def decode(raw: bytes, name: str) -> Any:
        return store.deserialize_cdr(raw, name if "/msg/" in name else name.replace("/", "/msg/"))

    return decode


def _joined(messages: list[Any]) -> Samples:
    """Blocks of instants one after the other, turned to ``[C, T]``."""
    shapes = [[axis.size for axis in message.layout.dim] for message in messages]
    blocks = [message.data.reshape(shape) for message, shape in zip(messages, shapes, strict=True)]
    joined: Samples = np.concatenate(blocks).T
    return joined

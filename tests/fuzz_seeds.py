"""Whole files of every format, ours and other people's, small: what fuzzing begins from."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from tactslip_torch import HandLayout, Recording
from tactslip_torch.data.formats import FORMATS

Writer = Callable[[Path], None]
SAMPLES = np.random.default_rng(3).standard_normal((40, 3))
TIMES = np.arange(40) / 100


def recording(dtype=torch.float32):
    samples = torch.from_numpy(SAMPLES.T.copy()).to(dtype)
    return Recording(samples, 100.0, "M1", (20.0,), (0.1,), ((0.1, 0.2),), provenance={"a": [1]})


def hand():
    return HandLayout.from_rows(
        {"name": f"SG{i}", "kind": "SG", "finger": "index", "segment": "distal"} for i in range(3)
    )


def table(delimiter, header=""):
    rows = np.column_stack([TIMES, SAMPLES]).tolist()
    return header + "".join(delimiter.join(map(repr, row)) + "\n" for row in rows)


def write_hdf5(path, **how):
    import h5py

    with h5py.File(path, "w", **how) as file:
        group = file.create_group("run")
        stored = group.create_dataset(
            "volts", data=SAMPLES, chunks=(16, 3), compression="gzip", shuffle=True
        )
        stored.attrs["fs"] = 100.0
        group["time"] = TIMES
        group["names"] = ["a", "b", "c"]


def write_mat5(path):
    import scipy.io

    trial = {"volts": SAMPLES, "time": TIMES, "fs": 100.0, "labels": np.array(["a"], dtype=object)}
    scipy.io.savemat(path, {"trial": trial}, do_compression=True)


def write_mat73(path):
    write_hdf5(path, userblock_size=512)
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")


def write_parquet(path):
    import pyarrow as pa
    import pyarrow.parquet as pq

    columns = {"time": TIMES, "a": SAMPLES[:, 0], "b": SAMPLES[:, 1].astype(np.float32)}
    pq.write_table(pa.table(columns), path, compression="zstd", row_group_size=16)


def write_mcap(path):
    from mcap.writer import CompressionType, Writer

    with path.open("wb") as file:
        output = Writer(file, compression=CompressionType.ZSTD, chunk_size=1000)
        output.start()
        schema = output.register_schema("Force", "jsonschema", b'{"type": "object"}')
        channel = output.register_channel("/force", "json", schema)
        for number, row in enumerate(SAMPLES.tolist()):
            message = json.dumps({"x": row[0], "y": row[1:]}).encode()
            output.add_message(channel, number * 10_000_000, message, number * 10_000_000)
        output.finish()


LVM = (
    "LabVIEW Measurement\t\nSeparator\tTab\nX_Columns\tOne\n***End_of_Header***\t\n\t\n"
    "Channels\t3\nDelta_X\t0.01\t0.01\t0.01\n***End_of_Header***\nX_Value\ta\tb\tc\tComment\n"
)

THEIRS: dict[str, dict[str, Writer]] = {
    "npz": {
        "a.npy": lambda path: np.save(path, SAMPLES),
        "b.npz": lambda path: np.savez_compressed(path, samples=SAMPLES.T),
        "c.npy": lambda path: np.save(path, np.asfortranarray(SAMPLES.astype(">i2"))),
    },
    "text": {
        "a.csv": lambda path: path.write_text(table(",", 'time_s,"a, b",c,d\n')),
        "b.txt": lambda path: path.write_text(table("\t").replace(".", ",")),
        "c.dat": lambda path: path.write_text(table("  ", "# t a b c\n")),
        "d.lvm": lambda path: path.write_text(LVM + table("\t")),
        "e.tsv": lambda path: path.write_text(table("\t", "t\ta\tb\tc\n"), encoding="utf-16"),
    },
    "hdf5": {"a.h5": write_hdf5},
    "mat": {"a.mat": write_mat5, "b.mat": write_mat73},
    "parquet": {"a.parquet": write_parquet},
    "mcap": {"a.mcap": write_mcap},
}


def write_seeds(folder: Path) -> dict[str, list[Path]]:
    """Files of every format that is known, ours first."""
    found: dict[str, list[Path]] = {}
    for name, form in FORMATS.items():
        place = folder / name
        place.mkdir()
        ending = "" if form.is_folder else f".{form.endings[0]}"
        for dtype in (torch.float32, torch.float64):
            form.save(place / f"ours{dtype.itemsize}{ending}", recording(dtype), hand(), {"k": 1})
        for file, write in THEIRS.get(name, {}).items():
            write(place / file)
        found[name] = sorted(place.iterdir(), key=lambda path: not path.name.startswith("ours"))
    return found

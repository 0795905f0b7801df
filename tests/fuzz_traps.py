"""Files made to do harm, by format."""

from __future__ import annotations

from fuzz_archives import NPZ
from fuzz_arrays import HDF5, MAT
from fuzz_harm import Trap
from fuzz_tables import MCAP, PARQUET, ROSBAG2, TEXT

TRAPS: dict[str, dict[str, Trap]] = {
    "npz": NPZ,
    "text": TEXT,
    "hdf5": HDF5,
    "mat": MAT,
    "parquet": PARQUET,
    "mcap": MCAP,
    "rosbag2": ROSBAG2,
}

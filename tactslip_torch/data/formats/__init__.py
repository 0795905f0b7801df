"""Recordings in files of every format: NumPy, text, HDF5, MAT, Parquet, MCAP and rosbag2."""

from tactslip_torch.data.formats._door import (
    FORMATS,
    Format,
    endings,
    find_format,
    format_of,
    named_format,
    open_file,
)
from tactslip_torch.data.formats._reading import (
    Archived,
    Opened,
    Reading,
    Samples,
    Times,
    is_number,
    pieces,
)

__all__ = [
    "FORMATS",
    "Archived",
    "Format",
    "Opened",
    "Reading",
    "Samples",
    "Times",
    "endings",
    "find_format",
    "format_of",
    "is_number",
    "named_format",
    "open_file",
    "pieces",
]

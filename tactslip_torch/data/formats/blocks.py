"""A recording of ours as messages: blocks of samples, and beside them one text with the rest."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import torch
from numpy.typing import NDArray
from torch import Tensor

from tactslip_torch.data.formats.cdr import MOST_CHANNELS
from tactslip_torch.data.formats.header import (
    DTYPES,
    MOST_HEADER,
    Archived,
    archived_from,
    facts_of,
)
from tactslip_torch.data.formats.message_samples import samples_of
from tactslip_torch.data.formats.messages import Bag, named
from tactslip_torch.data.formats.reading import Opened, Reading, Samples
from tactslip_torch.data.recording import Recording

TOPIC = "/tactile"
_BLOCK_S = 0.1
_CDR = b"\0\1\0\0"  # begins a message: small end first; places count from behind it
_MOST_NANOSECONDS = 2**63 - 1
_HEADER, _CHECKSUM = "tactslip_torch", "tactslip_torch_header_sum"
_KINDS = {torch.float32: "Float32MultiArray", torch.float64: "Float64MultiArray"}
_DEFINITION = """\
std_msgs/MultiArrayLayout layout
{number}[] data
{line}
MSG: std_msgs/MultiArrayLayout
std_msgs/MultiArrayDimension[] dim
uint32 data_offset
{line}
MSG: std_msgs/MultiArrayDimension
string label
uint32 size
uint32 stride
"""


class NoSamples(NamedTuple):
    """The samples of a recording that has none."""

    num_channels: int
    dtype: torch.dtype
    num_samples: int = 0

    def read(self, first: int, stop: int) -> Tensor:
        """None, ``[C, 0]``."""
        return torch.empty(self.num_channels, 0, dtype=self.dtype)


def kind_of(samples: Tensor) -> str:
    """The type of the messages."""
    return f"std_msgs/msg/{_KINDS[samples.dtype]}"


def definition_of(samples: Tensor) -> str:
    """What defines that type, as ROS writes it beside messages."""
    number = str(samples.dtype).removeprefix("torch.")
    return _DEFINITION.format(number=number, line="=" * 80)


def blocks(recording: Recording) -> Iterator[tuple[int, bytes]]:
    """The samples as messages of up to 0.1 s: nanoseconds since the first sample, and bytes.

    Raises:
        ValueError: if it has too many channels, or is longer than nanoseconds can be counted.
    """
    if len(recording.samples) > MOST_CHANNELS:
        raise ValueError(
            f"{len(recording.samples)} channels, messages have at most {MOST_CHANNELS}"
        )
    rate, num_samples = recording.sample_rate_hz, recording.samples.shape[-1]
    if num_samples / rate * 1e9 > _MOST_NANOSECONDS:
        raise ValueError(f"a recording of {num_samples / rate:g} s is too long for messages")
    by_time = recording.samples.detach().cpu().T.contiguous().numpy()
    step = max(int(rate * _BLOCK_S), 1)
    for first in range(0, num_samples, step):
        yield round(first / rate * 1e9), array_message(by_time[first : first + step])


def array_message(block: NDArray[Any]) -> bytes:
    """Samples ``[n, C]`` as a ``Float32MultiArray`` or ``Float64MultiArray``, bit for bit."""
    num_samples, num_channels = block.shape
    little = block.astype(block.dtype.newbyteorder("<"), order="C", copy=False)
    fields = struct.pack("<I", 2)
    fields += _dimension(b"samples", num_samples, block.size)
    fields += _dimension(b"channels", num_channels, num_channels)
    fields += struct.pack("<II", 0, block.size)
    fields += bytes(-len(fields) % little.dtype.itemsize)
    return _CDR + fields + little.tobytes()


def _dimension(label: bytes, size: int, stride: int) -> bytes:
    text = struct.pack("<I", len(label) + 1) + label + b"\0"
    return text + bytes(-len(text) % 4) + struct.pack("<II", size, stride)  # whole words


def metadata_of(header: str) -> dict[str, str]:
    """The header as a file's metadata, with a checksum.

    Raises:
        ValueError: if it is longer than is read.
    """
    if len(header) > MOST_HEADER:
        raise ValueError(
            f"provenance, key and the rest are {len(header)} characters, at most {MOST_HEADER} "
            "are read; keep less in them"
        )
    return {_HEADER: header, _CHECKSUM: sum_text(zlib.crc32(header.encode()))}


def sum_text(checksum: int) -> str:
    """A CRC-32 as words, which no YAML takes for a number."""
    return f"crc32 {checksum:08x}"


def header_in(metadata: Mapping[str, str]) -> str | None:
    """The header in a file's metadata; ``None`` if the file is another's.

    Raises:
        ValueError: if it fails its checksum.
    """
    header = metadata.get(_HEADER)
    if header is not None and metadata.get(_CHECKSUM) != metadata_of(header)[_CHECKSUM]:
        raise ValueError("damaged: the header of the recording fails its checksum")
    return header


def ours(path: str, bag: Bag, header: str) -> Opened:
    """A bag of ours, every block looked at once.

    Raises:
        ValueError: if it is damaged.
    """
    with named(path):
        rest = archived_from(header, _none(header))
    num_channels, num_samples = facts_of(header)["shape"]
    dtype = rest.recording.samples.dtype
    samples: Samples = NoSamples(num_channels, dtype)
    if num_samples:
        samples = samples_of(path, bag, Reading(samples=TOPIC, time=None)).samples
    found = (samples.num_channels, samples.num_samples, samples.dtype)
    if found != (num_channels, num_samples, dtype):
        raise ValueError(
            f"{path}: damaged: {found[0]} channels and {found[1]} samples in {found[2]}, where its "
            f"header says {num_channels}, {num_samples} and {dtype}"
        )
    return Opened(samples, rest, rest.hand.names, None, rest.recording.sample_rate_hz)


def whole(path: str, bag: Bag, header: str) -> Archived:
    """All of a bag of ours, its samples in memory.

    Raises:
        ValueError: if it is damaged.
    """
    samples = ours(path, bag, header).samples
    return archived_from(header, samples.read(0, samples.num_samples))


def key_in(path: str, header: str) -> dict[str, Any]:
    """The key in a header.

    Raises:
        ValueError: if it is none of ours.
    """
    with named(path):
        return archived_from(header, _none(header)).key


def _none(header: str) -> Tensor:
    """No samples, as many channels of them as a header says, ``[C, 0]``."""
    facts = facts_of(header)
    try:
        num_channels, num_samples = facts["shape"]
        is_count = all(type(n) is int and 0 <= n < 2**62 for n in (num_channels, num_samples))
        if is_count and 0 < num_channels <= MOST_CHANNELS:
            return torch.empty(num_channels, 0, dtype=DTYPES[facts["dtype"]])
    except (KeyError, TypeError, ValueError):
        pass
    raise ValueError("damaged: a header without shape and dtype")

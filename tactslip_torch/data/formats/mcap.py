"""Recordings as MCAP files, which ROS tools, Foxglove and the ``mcap`` library open.

Ours have one topic, ``/tactile``, of ``std_msgs/msg/Float32MultiArray`` or ``Float64MultiArray`` in
CDR: a block of up to 0.1 s a message, ``[samples, channels]``, logged at the time of its first
sample on the clock of the recording. A metadata record holds the rest. Nothing is packed.

Those of others are read as well, packed or not, indexed or not, if whole: ``std_msgs`` arrays, any
numbers of ROS 2 in CDR, and JSON, on one topic.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tactslip_torch.data.formats.blocks import (
    TOPIC,
    blocks,
    definition_of,
    header_in,
    key_in,
    kind_of,
    metadata_of,
    ours,
    whole,
)
from tactslip_torch.data.formats.header import Archived, damaged, header_of
from tactslip_torch.data.formats.mcap_bag import McapBag
from tactslip_torch.data.formats.message_samples import samples_of
from tactslip_torch.data.formats.messages import named
from tactslip_torch.data.formats.reading import AS_IT_SAYS, Opened, Reading, needs
from tactslip_torch.data.recording import Recording
from tactslip_torch.files import whole_file
from tactslip_torch.hand import HandLayout

_METADATA = "tactslip_torch recording"


def save(
    path: str | os.PathLike[str], recording: Recording, hand: HandLayout, key: Mapping[str, Any]
) -> None:
    """Write a recording to one file, whole or not at all; equal input, equal bytes.

    Raises:
        ValueError: if samples are neither float32 nor float64, the hand has another number of
            channels, provenance or key is not JSON-able, or ``mcap`` is not installed.
    """
    writer = needs("mcap.writer", "writing .mcap")
    header, samples = header_of(recording, hand, key), recording.samples
    with whole_file(path) as temporary, temporary.open("wb") as file:
        output = writer.Writer(file, compression=writer.CompressionType.NONE)
        output.start(profile="ros2", library="tactslip_torch")
        output.add_metadata(_METADATA, metadata_of(header))
        schema = output.register_schema(
            kind_of(samples), "ros2msg", definition_of(samples).encode()
        )
        channel = output.register_channel(TOPIC, "cdr", schema)
        for number, (time, message) in enumerate(blocks(recording)):
            output.add_message(channel, time, message, time, number)
        output.finish()


def load(path: str | os.PathLike[str]) -> Archived:
    """What ``save`` wrote, bit for bit.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is damaged or no file of ours.
    """
    with _opened(path) as (bag, header):
        if header is None:
            raise damaged(path)
        return whole(os.fspath(path), bag, header)


def key(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The key of a file that ``save`` wrote; its samples are not read.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no file of ours, or damaged where the key stands.
    """
    with _opened(path) as (_, header):
        if header is None:
            raise damaged(path)
        return key_in(os.fspath(path), header)


@contextmanager
def open(path: str | os.PathLike[str], how: Reading = AS_IT_SAYS) -> Iterator[Opened]:
    """A file of ours or of others, every message looked at once, to be read by stretches.

    Of another's, ``reading.samples`` names the topic; else it is the only one that holds samples.
    Times are as ``message_samples`` says. A file without its end is refused, not read up to there:
    what is missing is for ``mcap recover`` to say.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is damaged or not whole, or no topic or more than one holds samples.
    """
    with _opened(path) as (bag, header):
        is_ours = header is not None and how.samples in (None, TOPIC)
        name = os.fspath(path)
        yield ours(name, bag, header) if is_ours and header else samples_of(name, bag, how)


@contextmanager
def _opened(path: str | os.PathLike[str]) -> Iterator[tuple[McapBag, str | None]]:
    """An open file, and the header in it if it is one of ours."""
    if not Path(path).is_file():
        raise FileNotFoundError(f"no file at {os.fspath(path)}")
    with Path(path).open("rb") as file:
        with named(os.fspath(path)):
            bag = McapBag(file, _METADATA)
            header = header_in(bag.metadata)
        yield bag, header

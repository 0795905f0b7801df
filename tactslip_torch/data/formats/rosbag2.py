"""Recordings as rosbag2 folders, which ROS 2 plays and ``rosbags`` reads without it.

Ours hold the messages that ``mcap`` describes in a ``.db3`` file, written by ``rosbags``; the rest
stands in ``metadata.yaml``, quoted as in URLs. Folders of others are read with ``.db3`` or
``.mcap`` files, one or split into many.
"""

from __future__ import annotations

import os
import secrets
import shutil
import tempfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

from tactslip_torch.data.formats.bag_metadata import METADATA, read_metadata
from tactslip_torch.data.formats.blocks import (
    TOPIC,
    blocks,
    definition_of,
    header_in,
    key_in,
    kind_of,
    metadata_of,
    ours,
    sum_text,
    whole,
)
from tactslip_torch.data.formats.header import Archived, damaged, header_of
from tactslip_torch.data.formats.mcap_bag import McapBag
from tactslip_torch.data.formats.message_samples import samples_of
from tactslip_torch.data.formats.messages import Bag, Joined, Packed, named
from tactslip_torch.data.formats.reading import AS_IT_SAYS, Opened, Reading, needs
from tactslip_torch.data.formats.sqlite_bag import SqliteBag
from tactslip_torch.data.recording import Recording
from tactslip_torch.hand import HandLayout

_NAME = "recording"  # of the database in the folder
_SUM = "tactslip_torch_message_sum"
_SAFE = "{}[]:,"  # all else is written as in URLs: YAML writers wrap quoted text, and may err there
_FILES = (".db3", ".mcap", ".yaml")


def save(
    path: str | os.PathLike[str], recording: Recording, hand: HandLayout, key: Mapping[str, Any]
) -> None:
    """Write a recording to one folder, whole or not at all; equal input, equal bytes.

    Raises:
        ValueError: if samples are neither float32 nor float64, the hand has another number of
            channels, provenance or key is not JSON-able, ``rosbags`` is not installed, or there is
            something at ``path`` that is no bag.
    """
    bags = needs("rosbags.rosbag2", "writing folders of rosbag2")
    typesys = needs("rosbags.typesys", "writing folders of rosbag2")
    header = header_of(recording, hand, key)
    kind = kind_of(recording.samples)
    with _whole_folder(Path(path)) as folder, tempfile.TemporaryDirectory() as elsewhere:
        plain = Path(elsewhere) / _NAME  # the library takes "#" and "?" in a path for parts of URLs
        with bags.Writer(plain, version=8) as writer:
            channel = writer.add_connection(
                TOPIC,
                kind,
                msgdef=definition_of(recording.samples),
                rihs01=typesys.get_typestore(typesys.Stores.ROS2_JAZZY).hash_rihs01(kind),
            )
            total = 0
            for time, message in blocks(recording):
                writer.write(channel, time, message)
                total = zlib.crc32(message, total)
            for name, text in (metadata_of(header) | {_SUM: sum_text(total)}).items():
                writer.set_custom_data(name, quote(text, safe=_SAFE))
        shutil.copytree(plain, folder)


def load(path: str | os.PathLike[str]) -> Archived:
    """What ``save`` wrote, bit for bit.

    Raises:
        FileNotFoundError: if there is no such folder.
        ValueError: if it is damaged or none of ours.
    """
    with _opened(path) as (bag, facts, header):
        if header is None:
            raise damaged(path)
        name = os.fspath(path)
        with named(name):
            _check_sum(bag, facts)
        return whole(name, bag, header)


def key(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The key of a folder that ``save`` wrote; its samples are not read.

    Raises:
        FileNotFoundError: if there is no such folder.
        ValueError: if it is none of ours, or damaged where the key stands.
    """
    with _opened(path) as (_, _, header):
        if header is None:
            raise damaged(path)
        return key_in(os.fspath(path), header)


@contextmanager
def open(path: str | os.PathLike[str], how: Reading = AS_IT_SAYS) -> Iterator[Opened]:
    """A folder of ours or of others, every message looked at once, to be read by stretches.

    As ``mcap.open``; what is split over files is one recording.

    Raises:
        FileNotFoundError: if there is no such folder.
        ValueError: if it is damaged, or no topic or more than one holds samples.
    """
    with _opened(path) as (bag, facts, header):
        name = os.fspath(path)
        is_ours = header is not None and how.samples in (None, TOPIC)
        if is_ours:
            with named(name):
                _check_sum(bag, facts)
        yield ours(name, bag, header) if is_ours and header else samples_of(name, bag, how)


@contextmanager
def _opened(
    path: str | os.PathLike[str],
) -> Iterator[tuple[Bag, dict[str, str], str | None]]:
    """The messages of a folder, what its writer added, and the header if it is one of ours."""
    if not Path(path).is_dir():
        raise FileNotFoundError(f"no folder at {os.fspath(path)}")
    with ExitStack() as stack:
        with named(os.fspath(path)):
            metadata = read_metadata(Path(path))
            facts = {name: unquote(text) for name, text in metadata.custom.items()}
            header = header_in(facts)
            bag: Bag = Joined([_bag(file, metadata.storage, stack) for file in metadata.files])
        yield Packed(bag) if metadata.is_packed else bag, facts, header


def _bag(file: Path, storage: str, stack: ExitStack) -> Bag:
    if storage == "mcap":
        return McapBag(stack.enter_context(file.open("rb")))
    bag = SqliteBag(file)
    stack.callback(bag.close)
    return bag


def _check_sum(bag: Bag, facts: Mapping[str, str]) -> None:
    """Hold the messages against the sum that was written beside them; SQLite keeps none."""
    total = 0
    for number in range(bag.num_pages):
        for message in bag.page(number, TOPIC).messages:
            total = zlib.crc32(message, total)
    if facts.get(_SUM) != sum_text(total):
        raise ValueError("damaged: the messages fail their checksum")


@contextmanager
def _whole_folder(path: Path) -> Iterator[Path]:
    """A folder to write, put in the place of ``path`` when all went well.

    Raises:
        ValueError: if something other than a bag is there.
    """
    if path.exists() and not _is_bag(path):
        raise ValueError(f"{path} is there and no folder of rosbag2; give another name")
    path.parent.mkdir(parents=True, exist_ok=True)
    around = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    around.mkdir()
    try:
        yield around / path.name
        if path.exists():
            path.rename(around / f"{path.name}.before")
        (around / path.name).rename(path)
    finally:
        shutil.rmtree(around)


def _is_bag(path: Path) -> bool:
    """Whether a folder holds the files of a bag and nothing else."""
    if not path.is_dir() or path.is_symlink():
        return False
    inside = list(path.iterdir())
    return not inside or (
        (path / METADATA).is_file() and all(file.suffix in _FILES for file in inside)
    )

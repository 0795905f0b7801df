"""What ``metadata.yaml`` says of a rosbag2 folder, each part held against what it may be.

The text may come from anybody: it is limited in size and depth, only plain values are made of it,
and the files it names must lie in its folder.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from tactslip_torch.data.formats.header import MOST_HEADER
from tactslip_torch.data.formats.reading import needs

METADATA = "metadata.yaml"
_MOST_BYTES = 3 * MOST_HEADER + 2**20
_MOST_EVENTS = 200_000  # values and brackets
_MOST_DEPTH = 32
_STORAGES = ("sqlite3", "mcap")


class BagMetadata(NamedTuple):
    """What a folder says of itself.

    Args:
        storage: ``sqlite3`` or ``mcap``.
        files: with the messages, in their order.
        is_packed: whether each message is packed by itself.
        custom: texts that its writer added.
    """

    storage: str
    files: tuple[Path, ...]
    is_packed: bool
    custom: Mapping[str, str]


def read_metadata(folder: Path) -> BagMetadata:
    """The metadata of a folder.

    Raises:
        FileNotFoundError: if it has none.
        ValueError: if they are damaged, name files that are not there or not in the folder, or
            ask for a storage or packing that is not read.
    """
    path = folder / METADATA
    if not path.is_file():
        raise FileNotFoundError(f"no {METADATA} in {folder}, so it is no folder of rosbag2")
    size = _inside(folder, METADATA).stat().st_size
    if size > _MOST_BYTES:
        raise ValueError(f"{METADATA} of {size} bytes, at most {_MOST_BYTES} are read")
    content = _plain(path.read_bytes())
    facts = content.get("rosbag2_bagfile_information") if isinstance(content, dict) else None
    if not isinstance(facts, dict):
        raise ValueError(f"{METADATA} without rosbag2_bagfile_information")
    storage, files = facts.get("storage_identifier"), facts.get("relative_file_paths")
    if storage not in _STORAGES:
        raise ValueError(f"storage {storage!r}; {' and '.join(_STORAGES)} are read")
    if not isinstance(files, list) or not all(isinstance(name, str) for name in files):
        raise ValueError(f"{METADATA} without relative_file_paths")
    return BagMetadata(
        storage,
        tuple(_inside(folder, name) for name in files),
        _is_packed(facts),
        _texts(facts.get("custom_data")),
    )


def _texts(custom: object) -> dict[str, str]:
    pairs = custom.items() if isinstance(custom, dict) else ()
    return {name: text for name, text in pairs if isinstance(name, str) and isinstance(text, str)}


def _is_packed(facts: Mapping[str, Any]) -> bool:
    mode = str(facts.get("compression_mode") or "none").lower()
    packing = facts.get("compression_format")
    if mode == "none":
        return False
    if mode == "message" and packing == "zstd":
        return True
    raise ValueError(
        f"packed by {mode} with {packing!r}; write it unpacked first: ros2 bag convert"
    )


def _inside(folder: Path, name: str) -> Path:
    """A file of the folder; old ones put the folder's name before it.

    Raises:
        ValueError: if it is elsewhere, or not there.
    """
    path = folder / name
    if not path.exists() and Path(name).parent == Path(folder.name):
        path = folder / Path(name).name
    is_plain = not Path(name).is_absolute() and ".." not in Path(name).parts
    if not is_plain or not path.resolve().is_relative_to(folder.resolve()):
        raise ValueError(f"{METADATA} names {name!r}, which is not in the folder")
    if not path.is_file():
        raise ValueError(f"{METADATA} names {name!r}, which is not there")
    return path


def _plain(text: bytes) -> object:
    """YAML as plain values; merge keys are refused, as they multiply."""
    yaml = needs("yaml", f"reading {METADATA}")
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    try:
        depth = 0
        for number, event in enumerate(yaml.parse(text, Loader=loader)):
            depth += isinstance(event, (yaml.MappingStartEvent, yaml.SequenceStartEvent))
            depth -= isinstance(event, (yaml.MappingEndEvent, yaml.SequenceEndEvent))
            is_merge = isinstance(event, yaml.ScalarEvent) and event.value == "<<"
            if depth > _MOST_DEPTH or number > _MOST_EVENTS or is_merge:
                raise ValueError(f"{METADATA} is too deep or too long to be one of rosbag2")
        content: object = yaml.load(text, Loader=loader)  # a safe loader
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{METADATA} is no YAML: {error}") from None
    return content

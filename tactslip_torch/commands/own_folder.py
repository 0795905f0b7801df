"""A folder of recordings as the first argument of a command, and its ``hand.yaml``.

``hand.yaml`` has sections of the configuration of ``train``. Hydra merges it, as it does an
experiment of ``+exp``: keys of the command line come behind it.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import yaml  # type: ignore[import-untyped,unused-ignore]
from hydra.core.config_store import ConfigStore

from tactslip_torch.commands.packaged import packaged_folder

HAND_FILE = "hand.yaml"
"""How the recordings of its folder are read and labelled; written by ``tactslip setup``."""
_MANIFEST = "manifest.csv"
OF_HAND = ("data", "labels", "features", "split")
"""Its sections."""
_SECTIONS = {
    "train": OF_HAND,
    "pareto": OF_HAND,
    "evaluate": ("data", "labels"),
    "calibrate": ("data", "labels"),
    "data": ("data", "labels", "features"),
}
"""Of each command that takes a folder, the sections of ``hand.yaml`` that it has."""
_PLACES = {"detect": "input", "stream": "source"}
"""The key of commands that take a file or folder and need no labels."""
FOLDER_KEYS = {name: ["data.root"] for name in _SECTIONS}
FOLDER_KEYS |= {"data": ["root", "action"], "detect": ["input"]}
"""The keys that a folder as first argument sets, by command."""
_GROUP = "own"


def with_folder(command: str, arguments: Sequence[str]) -> list[str]:
    """The arguments of a command, a folder or file as the first of them made overrides.

    Args:
        command: its name.
        arguments: as they were typed.

    Raises:
        ValueError: in one line, if the folder is none or does not say how it is read.
    """
    first, *rest = arguments or [""]
    if not first or first[:1] in "-+~" or "=" in first:
        return list(arguments)
    if command not in _SECTIONS and command not in _PLACES:
        return list(arguments)
    folder = Path(first)
    if not folder.exists():
        top = packaged_folder("conf", "train.yaml") / f"{command}.yaml"
        if re.search(rf"(?m)^(?:  - )?{re.escape(first.partition('.')[0])}:", top.read_text()):
            return list(arguments)  # a key without its value, which is told so
        raise ValueError(f"no folder at {first}; give a folder of recordings, or KEY=VALUE")
    more = [word for before, word in pairwise(arguments) if not before.startswith("-")]
    more = [word for word in more if "=" not in word and Path(word).exists()]
    if more:
        raise ValueError(
            f"{command} takes one folder or file, and {more[0]} is a second; give the folder"
        )
    if command in _PLACES:
        return [f"{_PLACES[command]}={_quoted(first)}", *rest]
    if not folder.is_dir():
        raise ValueError(f"{first} is a file; give the folder that it is in")
    settings = _settings(command, folder, rest)
    kept = {name: settings[name] for name in _SECTIONS[command] if settings.get(name)}
    node: dict[str, Any] = {"defaults": _options(command, kept), **kept}
    node.setdefault("data", {})["root"] = str(folder)
    if command in ("train", "pareto"):
        node["name"] = re.sub(r"[^\w.-]+", "_", folder.resolve().name) or "own"
    if command == "train":
        node["train_on_all"] = True
    if command == "data":
        node["root"] = str(folder)
        if not any(word.startswith("action=") for word in rest):
            rest = ["action=check", *rest]
    ConfigStore.instance().store(_GROUP, node, _GROUP, package="_global_")
    return [f"+{_GROUP}={_GROUP}", *rest]


def _options(command: str, settings: Mapping[str, Any]) -> list[Any]:
    """The options of groups that recordings of one's own take."""
    files = "named" if "pattern" in settings.get("data", {}) else "files"
    chosen: list[Any] = [{"override /data": files}]
    if command in ("train", "pareto"):
        chosen.append({"override /split": "groups"})
    return [*chosen, "_self_"]


def _settings(command: str, folder: Path, rest: Sequence[str]) -> dict[str, Any]:
    """What ``hand.yaml`` says, else the detector that is given, else nothing but a manifest.

    Raises:
        ValueError: if it is no such file, or nothing says how the folder is read.
    """
    path = folder / HAND_FILE
    if path.is_file():
        return _read(path)
    model = next((word.removeprefix("model=") for word in rest if word.startswith("model=")), None)
    if model is not None and Path(model).is_file():
        from tactslip_torch.model.detector import SlipDetector  # torch, which help does without

        info = SlipDetector.load(model).info
        if "data" in info:
            data = {**info["data"], "reading": info.get("reading", {})}
            if "pattern" not in data and not (folder / _MANIFEST).is_file():
                data["pattern"] = _pattern(folder)
            return {"data": data, "labels": info.get("labels", {})}
    if (folder / _MANIFEST).is_file():
        return {}
    raise ValueError(
        f"{folder} has neither {HAND_FILE} nor {_MANIFEST}, so it is not known how it is read; "
        f"tactslip setup {shlex.quote(str(folder))} looks at it and writes {HAND_FILE}"
    )


def _pattern(folder: Path) -> str:
    """How the names of a folder's recordings are read, where nothing says it."""
    from tactslip_torch.data.file_names import name_pattern  # of no need for --help
    from tactslip_torch.data.folder import recording_files

    paths = recording_files(folder, in_folders=True)
    return name_pattern([path.relative_to(folder).as_posix() for path in paths]).pattern


def _read(path: Path) -> dict[str, Any]:
    """The sections of ``hand.yaml``.

    Raises:
        ValueError: in one line, if it is none.
    """
    try:
        found = yaml.safe_load(path.read_text(encoding="utf-8")) or {}
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is no YAML: {' '.join(str(error).split())}") from None
    if not isinstance(found, dict) or not set(found) <= set(OF_HAND):
        has = ", ".join(map(str, found)) if isinstance(found, dict) else repr(found)[:40]
        raise ValueError(f"{path} must have the sections {', '.join(OF_HAND)}, got {has}")
    for name, section in found.items():
        if section is not None and not isinstance(section, dict):
            raise ValueError(f"{path}: {name} must be KEY: VALUE lines, got {section!r}")
        if hidden := [key for key in section or {} if str(key).startswith("_")]:
            raise ValueError(f"{path}: {name} has no key {hidden[0]}; remove it")
    return {name: section for name, section in found.items() if section}


def _quoted(text: str) -> str:
    """A text that Hydra reads as it is."""
    escaped = text.replace("\\", "\\\\").replace("'", "\\'")
    return f"'{escaped}'"

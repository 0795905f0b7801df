"""Files that are written whole or not at all, and tables of tensors that notice damage."""

from __future__ import annotations

import json
import os
import secrets
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from tactslip_torch.ledger import content_digest


@contextmanager
def whole_file(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary name beside ``path`` to write to; renamed to ``path`` when all went well.

    A failure leaves what was at ``path`` before, and no temporary file.

    Example:
        >>> with whole_file(getfixture("tmp_path") / "a.txt") as temporary:
        ...     _ = temporary.write_text("all of it")
        >>> (getfixture("tmp_path") / "a.txt").read_text()
        'all of it'
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    unique = secrets.token_hex(4)  # process ids repeat on other hosts and in containers
    temporary = path.with_name(f".{path.stem}.{unique}.tmp{path.suffix}")
    try:
        yield temporary
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def save_table(
    path: str | os.PathLike[str], form: str, facts: Mapping[str, Any], tensors: Mapping[str, Tensor]
) -> None:
    """Write tensors and JSON-able facts to one file, whole or not at all.

    The same facts and tensors give the same bytes. Of a view, no more is written than it shows.

    Args:
        path: of the file.
        form: names format and version; ``load_table`` wants the same.
        facts: kept as JSON text.
        tensors: by name.
    """
    text = json.dumps(facts, sort_keys=True)
    content = {
        "format": form,
        "facts": text,
        "tensors": {name: _alone(tensors[name]) for name in sorted(tensors)},
        "digest": _digest(text, tensors),
    }
    with whole_file(path) as temporary, temporary.open("wb") as file:
        torch.save(content, file)  # handed a path, it would write its name into the file


def load_table(path: str | os.PathLike[str], form: str) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Facts and tensors of a file that ``save_table`` wrote; nothing in it is executed.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it has another format, or is damaged.
    """
    name = os.fspath(path)
    content = _read(path)
    if content["format"] != form:
        raise ValueError(f"{name} must be of format {form!r}, got {content['format']!r}")
    try:
        facts, tensors = content["facts"], content["tensors"]
        is_whole = content["digest"] == _digest(facts, tensors)
    except (AttributeError, KeyError, TypeError, ValueError, RuntimeError):
        is_whole = False
    if not is_whole:
        raise ValueError(f"{name} is damaged; make it again")
    return json.loads(facts), tensors


def table_form(path: str | os.PathLike[str]) -> str:
    """The format that ``save_table`` named in a file.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is damaged or no such file.
    """
    return str(_read(path)["format"])


def _read(path: str | os.PathLike[str]) -> dict[str, Any]:
    """What ``save_table`` wrote, unchecked but for its format being text."""
    name = os.fspath(path)
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise FileNotFoundError(f"no file at {name}") from None
    except Exception as error:  # torch.load raises many kinds for a file that is not its own
        raise ValueError(f"{name} is damaged or no file of ours; make it again") from error
    if not isinstance(content, dict) or not isinstance(content.get("format"), str):
        raise ValueError(f"{name} is damaged or no file of ours; make it again")
    return content


def _alone(tensor: Tensor) -> Tensor:
    """The values without a larger storage around them, which ``torch.save`` would write too."""
    tensor = tensor.detach().cpu().contiguous()
    is_all = tensor.untyped_storage().nbytes() == tensor.numel() * tensor.element_size()
    return tensor if is_all else tensor.clone()


def _digest(text: str, tensors: Mapping[str, Tensor]) -> str:
    names = sorted(tensors)
    head = torch.frombuffer(bytearray((text + "\n".join(names)).encode()), dtype=torch.uint8)
    return content_digest(head, *(tensors[name] for name in names))

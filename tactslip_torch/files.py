"""Files that are written whole or not at all, and tables of tensors that notice damage."""

from __future__ import annotations

import json
import os
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
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp{path.suffix}")
    try:
        yield temporary
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def save_table(
    path: str | os.PathLike[str], form: str, facts: Mapping[str, Any], tensors: Mapping[str, Tensor]
) -> None:
    """Write tensors and JSON-able facts to one file, whole or not at all.

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
        "tensors": dict(tensors),
        "digest": _digest(text, tensors),
    }
    with whole_file(path) as temporary:
        torch.save(content, temporary)


def load_table(path: str | os.PathLike[str], form: str) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Facts and tensors of a file that ``save_table`` wrote; nothing in it is executed.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it has another format, or is damaged.
    """
    name = os.fspath(path)
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise FileNotFoundError(f"no file at {name}") from None
    except Exception as error:  # torch.load raises many kinds for a file that is not its own
        raise ValueError(f"{name} is damaged or no file of ours; make it again") from error
    if not isinstance(content, dict) or content.get("format") != form:
        found = content.get("format") if isinstance(content, dict) else type(content).__name__
        raise ValueError(f"{name} must be of format {form!r}, got {found!r}")
    try:
        facts, tensors = content["facts"], content["tensors"]
        if content["digest"] != _digest(facts, tensors):
            raise ValueError("the digest does not fit")
        return json.loads(facts), tensors
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{name} is damaged ({error}); make it again") from error


def _digest(text: str, tensors: Mapping[str, Tensor]) -> str:
    names = sorted(tensors)
    return content_digest(
        torch.tensor(list((text + "\n".join(names)).encode()), dtype=torch.uint8),
        *(tensors[name] for name in names),
    )

"""Where the configuration lives, and errors a person can read."""

from __future__ import annotations

import os
import re
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

from hydra.errors import InstantiationException
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

import tactslip_torch
from tactslip_torch.runtime import is_first_process, process_number

CONF_HINT = "train.yaml"
EXIT_BAD_INPUT = 2
BAD_INPUT = (
    ValueError,
    KeyError,
    TypeError,
    OSError,
    InstantiationException,
    OmegaConfBaseException,
)
"""What bad input raises, here or in the libraries that read it."""


def conf_dir() -> Path:
    """The ``conf`` folder: inside the package (wheel) or beside it (checkout, editable install).

    Raises:
        FileNotFoundError: if there is none.
    """
    here = Path(tactslip_torch.__file__).resolve().parent
    for folder in (here / "conf", here.parent / "conf"):
        if (folder / CONF_HINT).is_file():
            return folder
    raise FileNotFoundError(f"no conf folder with {CONF_HINT} in or beside {here}; reinstall")


def unknown_choice(arguments: Sequence[str]) -> str | None:
    """One line about the first argument that names an option its config group does not have.

    Example:
        >>> unknown_choice(["+exp=unseen4", "seed=3"]) is None
        True
        >>> unknown_choice(["labels=quarter_second"])
        'unknown labels quarter_second; known: half_second, whole_slide'
    """
    folders = [conf_dir(), *_further_folders(arguments)]
    for argument in arguments:
        key, found, value = argument.lstrip("+").partition("=")
        groups = [folder / key for folder in folders]
        if argument.startswith("-") or not found or not key or not groups[0].is_dir():
            continue
        known = sorted(path.stem for group in groups for path in group.glob("*.yaml"))
        for name in value.split(","):
            if name and name not in known:
                return f"unknown {key} {name}; known: {', '.join(known)}"
        if key == "exp" and not argument.startswith("+"):
            return f"write +exp={value}: experiments are added to the configuration"
    return None


def _further_folders(arguments: Sequence[str]) -> list[Path]:
    """Folders of configuration of the user's own, ``--config-dir``."""
    given = [value for name, value in pairwise(arguments) if name in ("--config-dir", "-cd")]
    given += [a.partition("=")[2] for a in arguments if a.startswith("--config-dir=")]
    return [Path(value) for value in given]


def folder_problem(arguments: Sequence[str]) -> str | None:
    """One line about a results folder that cannot be made; Hydra alone would show a trace.

    Example:
        >>> folder_problem(["hydra.run.dir=/dev/null/recordings"])
        'cannot write to hydra.run.dir=/dev/null/recordings: Not a directory at /dev/null'
    """
    given = {key.lstrip("+"): value for key, _, value in (a.partition("=") for a in arguments)}
    name = "hydra.sweep.dir" if {"-m", "--multirun"} & set(arguments) else "hydra.run.dir"
    folder = Path(given.get(name, "outputs").strip("'\"")).absolute()
    nearest = next(place for place in (folder, *folder.parents) if place.exists())
    try:
        with tempfile.TemporaryDirectory(dir=nearest):
            return None
    except OSError as error:
        return f"cannot write to {name}={folder}: {error.strerror} at {nearest}"


def run_entry_point(main: Callable[[], Any]) -> None:
    """Run a Hydra entry point; a choice that does not exist is one line and exit status 2.

    Of the processes that torchrun starts, the first alone gets a folder for its results.
    """
    problem = unknown_choice(sys.argv[1:])
    if problem:
        fail(problem)
    if "TORCHELASTIC_RUN_ID" in os.environ and not is_first_process():
        sys.argv += ["hydra.run.dir=.", "hydra.output_subdir=null", "hydra/job_logging=stdout"]
    main()


@contextmanager
def errors_in_one_line() -> Iterator[None]:
    """Turn what bad input raises into one line and exit status 2; other errors keep their trace.

    Raises:
        SystemExit: instead of the error.
    """
    try:
        yield
    except BAD_INPUT as error:
        if os.environ.get("TACTSLIP_TRACEBACK"):
            raise
        fail(one_line(error))


def fail(message: str) -> None:
    """Print one line, with the number of the process if there are several, exit with status 2.

    Raises:
        SystemExit: always.
    """
    who = "" if is_first_process() else f" in process {process_number()}"
    print(f"error{who}: {' '.join(message.split())}", file=sys.stderr, flush=True)
    raise SystemExit(EXIT_BAD_INPUT)


def one_line(error: BaseException) -> str:
    """What went wrong, without Hydra's wrapping, behind the section of the configuration."""
    section = ""
    while isinstance(error, InstantiationException) and error.__cause__ is not None:
        place = re.search(r"full_key: (\S+)", str(error))
        section = f"{place[1]}: " if place else ""
        error = error.__cause__
    if isinstance(error, MissingMandatoryValue):
        return f"no value for {error.full_key}; give {error.full_key}=..."
    text = str(error.args[0] if isinstance(error, KeyError) and error.args else error).strip()
    if "Original Traceback" in text:  # from a worker: the last line is what was raised there
        text = text.splitlines()[-1].partition(": ")[2]
    return section + (text or type(error).__name__)

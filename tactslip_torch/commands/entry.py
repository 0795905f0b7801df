"""What every command does: find its configuration, run, write results, report bad input."""

from __future__ import annotations

import os
import re
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import InstantiationException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from tactslip_torch.runtime import PACKAGE, is_first_process, process_number, write_json

CONF_HINT = "train.yaml"
EXIT_BAD_INPUT = 2
BAD_INPUT = (
    ValueError,
    LookupError,
    OverflowError,
    EOFError,
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
    for folder in (PACKAGE / "conf", PACKAGE.parent / "conf"):
        if (folder / CONF_HINT).is_file():
            return folder
    raise FileNotFoundError(f"no conf folder with {CONF_HINT} in or beside {PACKAGE}; reinstall")


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


def folder_problem(arguments: Sequence[str], default: str = "outputs") -> str | None:
    """One line about a results folder that cannot be made; Hydra alone would show a trace.

    Args:
        arguments: of the command line.
        default: where results go if no argument says so; ``"."`` is not looked at.

    Example:
        >>> folder_problem(["hydra.run.dir=/dev/null/recordings"])
        'cannot write to hydra.run.dir=/dev/null/recordings: Not a directory at /dev/null'
    """
    given = {key.lstrip("+"): value for key, _, value in (a.partition("=") for a in arguments)}
    name = "hydra.sweep.dir" if {"-m", "--multirun"} & set(arguments) else "hydra.run.dir"
    if (wanted := given.get(name, default)) == ".":
        return None
    folder = Path(wanted.strip("'\"")).absolute()
    nearest = next(place for place in (folder, *folder.parents) if place.exists())
    try:
        with tempfile.TemporaryDirectory(dir=nearest):
            return None
    except OSError as error:
        return f"cannot write to {name}={folder}: {error.strerror} at {nearest}"


def entry_point(
    name: str, run: Callable[[DictConfig, Path], Any], config_name: str | None = None
) -> Callable[[], None]:
    """The command ``name`` as a function of the command line alone.

    It refuses a choice or a folder that does not exist, composes the configuration, and calls
    ``run`` with it and the folder for results. What bad input raises is printed in one line, and
    the exit status is 2. Of the processes that torchrun starts, only the first gets a folder.

    Args:
        name: of the module in ``commands``.
        run: does the work.
        config_name: of the file in ``conf``, if that is another.
    """
    config_name = config_name or name

    def composed(config: DictConfig) -> None:
        with errors_in_one_line():
            run(config, Path(HydraConfig.get().runtime.output_dir))

    def main() -> None:
        arguments = sys.argv[1:]
        own: Any = OmegaConf.to_container(OmegaConf.load(conf_dir() / f"{config_name}.yaml"))
        default = own["hydra"]["run"]["dir"].split("/")[0]
        if problem := unknown_choice(arguments) or folder_problem(arguments, default):
            fail(problem)
        if "TORCHELASTIC_RUN_ID" in os.environ and not is_first_process():
            sys.argv += ["hydra.run.dir=.", "hydra.output_subdir=null", "hydra/job_logging=stdout"]
        hydra.main(version_base="1.3", config_path=str(conf_dir()), config_name=config_name)(
            composed
        )()

    composed.__module__ = f"{__package__}.{name}"  # Hydra names job and log file by it
    return main


def leave_results(
    folder: Path,
    name: str,
    content: Mapping[str, Any],
    figure: Callable[[Mapping[str, Any], Path], None],
    *texts: str,
) -> None:
    """Write ``NAME.json`` and ``NAME.png``, print tables, and say where the files are."""
    write_json(folder / f"{name}.json", content)
    figure(content, folder / f"{name}.png")
    print("\n" + "\n\n".join([*texts, f"results in {folder}"]))


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

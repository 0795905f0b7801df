"""A command with a configuration: run by Hydra, with a folder for results, errors in one line."""

from __future__ import annotations

import logging
import shlex
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from statistics import mean, pstdev
from typing import Any, TextIO

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from tactslip_torch.commands.configuration import CommandLine, checked, conf_dir, with_lists
from tactslip_torch.commands.stopping import Stopped, errors_in_one_line
from tactslip_torch.runtime import is_first_process, whole_file

log = logging.getLogger(__name__)

_NOTHING_SAVED = "no result is written (features made so far stay in the cache); start it again"


def entry_point(
    command: str,
    run: Callable[[DictConfig, Path], Any],
    saved: Callable[[DictConfig, Path, str], str] = lambda config, folder, again: _NOTHING_SAVED,
) -> Callable[[CommandLine | None], None]:
    """A command as a function of the command line, by default that of the process.

    What bad input raises is printed in one line, with exit status 2; where a signal stops it, what
    is saved and how to go on, with exit status 130 (SIGINT) or 143 (SIGTERM).

    Args:
        command: name of the file in ``conf``, and of the module in ``commands``.
        run: does the work, given the configuration and the folder for results.
        saved: what a stopped run leaves, and how to go on; given the configuration, the folder and
            the command line.
    """

    def main(given: CommandLine | None = None) -> None:
        with errors_in_one_line():
            line = given or checked(command, sys.argv[1:])
            _check_folder(line)
            typed, runs = list(sys.argv), list[dict[str, Any]]()

            def in_folder(config: DictConfig) -> None:
                sys.argv[:] = typed  # by which Lightning starts further processes
                folder = Path(HydraConfig.get().runtime.output_dir)
                with _kept_in_log(), errors_in_one_line():
                    with_lists(command, config, HydraConfig.get())
                    if (folder / "config.yaml").exists() and command != "generate":
                        log.warning(
                            "%s holds an earlier run; files of the same names are replaced", folder
                        )
                    try:
                        found = run(config, folder)
                    except Stopped as stop:
                        again = shlex.join(["tactslip", command, *line.typed])
                        raise stop.saying(saved(config, folder, again)) from None
                if HydraConfig.get().mode == RunMode.MULTIRUN and _are_scores(found):
                    of_simulation = "simulation" in str(OmegaConf.select(config, "data._target_"))
                    words = list(HydraConfig.get().overrides.task)
                    runs.append(
                        {"words": words, "scores": found, "simulated": of_simulation}
                        | {"place": folder.parent}
                    )

            sys.argv[1:] = [f"hydra.job.name={command}", *line.arguments]
            hydra.main(str(conf_dir()), command, version_base="1.3")(in_folder)()
            if runs and is_first_process():
                compare_runs(runs)

    return main


def compare_runs(runs: list[dict[str, Any]]) -> None:
    """Print the scores of a sweep's runs with their mean and deviation, and write ``runs.csv``.

    Args:
        runs: of each its ``words``, of which those that differ are shown, ``scores`` by name, from
            0 to 1, the folder ``place``, and whether it is ``simulated``.
    """
    from tactslip_torch.report import style  # draws, which few commands do

    common = set.intersection(*(set(run["words"]) for run in runs))
    given = [" ".join(word for word in run["words"] if word not in common) for run in runs]
    every = [run["scores"] for run in runs]
    names = list(dict.fromkeys(name for scores in every for name in scores))
    rows: list[dict[str, Any]] = [
        {"run": words or "all", **{f"{n} %": style.percent(scores.get(n)) for n in names}}
        for words, scores in zip(given, every, strict=True)
    ]
    for what, reduced in (("mean", mean), ("standard deviation", pstdev)):
        own = {name: [scores[name] for scores in every if name in scores] for name in names}
        rows.append({"run": what, **{f"{n} %": style.percent(reduced(v)) for n, v in own.items()}})
    path = runs[0]["place"] / "runs.csv"
    with style.csv_writer(path, ["run", *names]) as write:
        write([row["run"], *map(of.get, names)] for row, of in zip(rows, every, strict=False))
    simulated = any(run["simulated"] for run in runs)
    print(f"\n{style.marked(simulated, style.table(rows))}\n\nthe same in {path}")


def _are_scores(returned: Any) -> bool:
    """Whether a run returned numbers by name, which those of a sweep are compared by."""
    is_mapping = isinstance(returned, Mapping) and bool(returned)
    return is_mapping and all(type(value) is float for value in returned.values())


def save_config(config: DictConfig, folder: Path) -> None:
    """Write the resolved configuration."""
    with whole_file(folder / "config.yaml") as temporary:
        temporary.write_text(OmegaConf.to_yaml(config, resolve=True))


@contextmanager
def _kept_in_log() -> Iterator[None]:
    """What is printed, but progress bars, stands in the log file of the run as well."""
    handlers = HydraConfig.get().job_logging.get("handlers") or {}
    if "file" not in handlers:
        yield
        return
    with Path(handlers["file"]["filename"]).open("a", encoding="utf-8") as file:
        out, err = _Copied(sys.stdout, file), _Copied(sys.stderr, file)
        with redirect_stdout(out), redirect_stderr(err):
            yield


class _Copied:
    """A stream whose whole lines are written to a file too."""

    def __init__(self, stream: TextIO, file: TextIO) -> None:
        self._stream, self._file, self._is_bar = stream, file, False

    def write(self, text: str) -> int:
        was_bar, self._is_bar = self._is_bar, "\r" in text
        if not self._is_bar and not (was_bar and text == "\n"):
            self._file.write(text)
            self._file.flush()
        return self._stream.write(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def _check_folder(line: CommandLine) -> None:
    """Refuse a results folder that cannot be made; Hydra alone would show a trace.

    Raises:
        ValueError: that says why.
    """
    of = "sweep" if line.options.multirun else "run"
    where: Any = OmegaConf.to_container(line.config.hydra[of])
    wanted = str(where["dir"]).partition("${")[0]  # what it holds of the configuration is new
    folder = Path(wanted).absolute()
    nearest = next(place for place in (folder, *folder.parents) if place.exists())
    try:
        if wanted != ".":
            with tempfile.TemporaryDirectory(dir=nearest):
                pass
    except OSError as error:
        why = f"cannot write to hydra.{of}.dir={folder}: {error.strerror} at {nearest}"
        raise ValueError(why) from error

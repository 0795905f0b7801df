"""What every command does: find its configuration, run, write results, report bad input."""

from __future__ import annotations

import logging
import shlex
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from tactslip_torch.commands.configuration import (
    Checked,
    check_folder,
    checked,
    conf_dir,
    with_lists,
)
from tactslip_torch.commands.stopping import Stopped, errors_in_one_line
from tactslip_torch.runtime import is_first_process, whole_file, write_json

log = logging.getLogger(__name__)

NOTHING_SAVED = "no result is written (features made so far stay in the cache); start it again"


def entry_point(
    name: str,
    run: Callable[[DictConfig, Path], Any],
    saved: Callable[[DictConfig, Path, str], str] = lambda config, folder, again: NOTHING_SAVED,
) -> Callable[[Checked | None], None]:
    """The command ``name`` as a function of the command line, by default that of the process.

    It refuses what is no configuration (``mistakes``) or no folder, composes the configuration,
    and calls ``run`` with it and the folder for results. What bad input raises is printed in one
    line, and the exit status is 2; where a signal stops it, what is saved and how to go on, and the
    exit status is 130 (SIGINT) or 143 (SIGTERM).

    Args:
        name: of the file in ``conf``, and of the module in ``commands``.
        run: does the work.
        saved: what is there of a run that is stopped, and how to go on; given the configuration,
            the folder and the command line.
    """
    command = name.replace("_", "-")

    def main(given: Checked | None = None) -> None:
        with errors_in_one_line():
            arguments, options, composed = given or checked(command, sys.argv[1:])
            is_sweep, words_typed = options.multirun, list(sys.argv)
            if composed:
                is_sweep |= composed.whole.hydra.mode == RunMode.MULTIRUN
                check_folder(composed, is_sweep=is_sweep)
            runs: list[_Run] = []

            def in_folder(config: DictConfig) -> None:
                sys.argv[:] = words_typed  # by which Lightning starts further processes
                with _kept_in_log(), errors_in_one_line():
                    if composed is not None:
                        with_lists(config, composed)
                    folder = Path(HydraConfig.get().runtime.output_dir)
                    if (folder / "config.yaml").exists() and name != "generate":
                        log.warning(
                            "%s holds an earlier run; files of the same names are replaced", folder
                        )
                    try:
                        returned = run(config, folder)
                    except Stopped as stop:
                        again = shlex.join(["tactslip", command, *arguments])
                        raise stop.saying(saved(config, folder, again)) from None
                    if HydraConfig.get().mode == RunMode.MULTIRUN and _are_scores(returned):
                        source = str(OmegaConf.select(config, "data._target_"))
                        words = list(HydraConfig.get().overrides.task)
                        runs.append(_Run(words, returned, folder.parent, "simulation" in source))

            in_folder.__module__ = f"{__package__}.{name}"  # Hydra names job and log file by it
            if composed and not (is_sweep or options.cfg or options.resolve):
                composed.run(in_folder)
            else:
                sys.argv[1:] = arguments
                of_hydra = hydra.main(str(conf_dir()), name, version_base="1.3")
                of_hydra(in_folder)()
            if runs and is_first_process():
                _compare(runs)

    return main


class _Run(NamedTuple):
    """A run of a sweep: what was set, its scores, where they are, and whether simulated."""

    given: list[str]
    scores: Mapping[str, float]
    place: Path
    simulated: bool


def _compare(runs: Sequence[_Run]) -> None:
    """A table and a figure of the runs of a sweep, by what differs between them."""
    from tactslip_torch.report.sweep import sweep_table, write_sweep  # draws, which few commands do

    common = set(runs[0].given).intersection(*(run.given for run in runs))
    told = [(" ".join(o for o in r.given if o not in common) or "all", r.scores) for r in runs]
    place, simulated = runs[0].place, any(run.simulated for run in runs)
    write_sweep(told, place, simulated=simulated)
    print(f"\n{sweep_table(told, simulated=simulated)}\n\nruns.csv and runs.png in {place}")


def _are_scores(returned: Any) -> bool:
    """Whether a run returned numbers by name, which those of a sweep are compared by."""
    is_mapping = isinstance(returned, Mapping) and bool(returned)
    return is_mapping and all(type(value) is float for value in returned.values())


def save_config(config: DictConfig, folder: Path) -> None:
    """Write the resolved configuration."""
    with whole_file(folder / "config.yaml") as temporary:
        temporary.write_text(OmegaConf.to_yaml(config, resolve=True))


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

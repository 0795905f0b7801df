"""What a user types: help, and mistakes, each answered in one line.

``python tests/test_command_line.py`` runs the mistakes and writes ``docs/troubleshooting.md``.
"""

import contextlib
import io
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from tactslip_torch import __version__
from tactslip_torch.__main__ import COMMANDS, OF_THEIR_OWN, main
from tactslip_torch.commands.configuration import _keys_of, checked, conf_dir, help_text, with_lists
from tactslip_torch.commands.hosts import copy_host

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "troubleshooting.md"
MARKERS = "<!-- mistakes: written by tests/test_command_line.py -->", "<!-- end of mistakes -->"
CONFIGURED = [name for name in COMMANDS if name not in OF_THEIR_OWN]

MISTAKES = {
    # what is typed: what the answer names
    "trian +exp=quick": "train?",
    "train sedd=1": "seed?",
    "train +sedd=1": "seed?",
    "train num_features=60": "recipe.num_features?",
    "train learning_rate=0.1": "learning_rate --help",
    "train onset.budget.held=1": "onset=alarms",
    "train data.root=recordings": "data=files",
    "train seed 1": "seed=VALUE",
    "train seed==1": "seed=VALUE",
    "train --seed=1": "seed=1",
    "train +seed=1": "seed=VALUE",
    "train ~sedd": "seed?",
    "train +split=seen6": "split=seen6",
    "train +exp=quick +exp=hard": "+exp=[quick,hard]",
    "train exp=quick": "+exp=NAME",
    "train split=seen6,unseen4": "-m",
    "train -m split=seen6,seen7": "seen7 unseen4",
    "train +exp=quik": "quik quick,",
    "train recipe=papr": "papr paper,",
    "train data=mine --config-dir recordings": "mine authors_raw",
    "train --config-dir nowhere": "nowhere",
    "train --config-dir own +exp=odd": "recipe view views?",  # in its file
    "train scene.friction_noise_mv=4": "+scene.friction_noise_mv=VALUE",
    "train +scene.frction_noise_mv=4": "friction_noise_mv?",
    "train +trainer.limit_train_batchs=2": "trainer limit_train_batches?",
    "train data.materials=M1,M6": "'data.materials=[M1,M6]' -m",
    "train data.materials=[M1,M6": "data.materials=VALUE quotes",
    "train features.frames={SG: 51, PVDF: 11}": "features.frames=VALUE quotes",
    "train seed=first": "seed whole 'first'",
    "train split.seen=M7": "M7 M1",
    "train hydra.run.dir=notes.txt/run": "hydra.run.dir notes.txt",
    "train data=files": "data.root=",
    "train data=files data.root=nowhere": "nowhere",
    "train data=files data.root=recordings": "recordings manifest",
    "evaluate": "model=",
    "evaluate model=missing.pt": "missing.pt",
    "evaluate model=notes.txt": "notes.txt",
    "evaluate recipe=paper model=detector.pt": "recipe",
    "detect model=missing.pt input=recordings": "missing.pt",
    "detect model=missing.pt imput=recordings": "input?",
    "detect model=missing.pt input=recordings mcap=a.mcap": "mcap true false",
    "stream model=detector.pt": "source=",
    "stream model=detector.pt source=nowhere.csv": "nowhere.csv serial: listen: stdin",
    "stream model=detector.pt source=serial:/dev/ttyNONE": "/dev/ttyNONE",
    "stream model=detector.pt source=tcp:robot": "[HOST:]PORT 'robot'",
    "stream model=detector.pt source=stdin --serve": "serve=",
    "stream model=detector.pt source=stdin frame.format=csv": "frame.format text binary 'csv'",
    "stream model=detector.pt source=serial:/dev/ttyACM0 frame.format=binary": "frame.header",
    "stream model=detector.pt source=ros2:/tactile": "rclpy setup.bash",
    "stream model=detector.pt source=stdin serve=true token=abc": "token 8 3",
    "data root=recordings": "action=",
    "data action=chek root=recordings": "chek check",
    "generate materials=gold": "gold M1",
    "generate format=docx": "docx npz",
}


def answer(line: str) -> tuple[int, str]:
    """Exit status, and what stands on standard error, of a line typed behind ``tactslip``."""
    printed, before = io.StringIO(), list(sys.argv)
    sys.argv = ["tactslip", *(line.split() if "{" in line else shlex.split(line))]
    try:
        with contextlib.redirect_stderr(printed), contextlib.redirect_stdout(io.StringIO()):
            main()
    except SystemExit as end:
        return int(end.code or 0), printed.getvalue()
    finally:
        sys.argv = before
    return 0, printed.getvalue()


@contextlib.contextmanager
def in_a_folder():
    """A working folder with what the mistakes are made on."""
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        place = Path(folder)
        for name in ("recordings", "own/data", "own/exp"):
            (place / name).mkdir(parents=True)
        (place / "recordings" / "cup1.csv").write_text("t,SG1\n0,1\n")
        (place / "own" / "data" / "mine.yaml").write_text("_target_: mine.Recordings\n")
        (place / "own" / "exp" / "odd.yaml").write_text("# @package _global_\nrecipe: {view: 3}\n")
        (place / "notes.txt").write_text("no detector")
        shutil.copy(ROOT / "tactslip_torch/pretrained/paper24-sim.pt", place / "detector.pt")
        yield place


@pytest.fixture(scope="module", autouse=True)
def working_folder():
    with in_a_folder():
        yield


SOME_SLOW = [
    line if place % 3 == 0 else pytest.param(line, marks=pytest.mark.slow)
    for place, line in enumerate(MISTAKES)
]


@pytest.mark.parametrize("line", SOME_SLOW)
def test_a_mistake_is_answered_in_one_line(line):
    status, printed = answer(line)
    assert (status, printed.count("\n")) == (2, 1), printed
    assert printed.startswith("error: ")
    assert [word for word in MISTAKES[line].split() if word not in printed] == [], printed


TEXTS = [
    ("train split.seen=M1", "split.seen", ["M1"]),
    ("train data=files data.root=x data.materials=cup", "data.materials", ["cup"]),
    ("train recipe.views=pooled", "recipe.views", ["pooled"]),
]


@pytest.mark.parametrize(("line", "key", "value"), TEXTS)
def test_a_text_is_a_list_of_one_where_a_list_is_wanted(line, key, value):
    command, *rest = shlex.split(line)
    config = checked(command, rest).config
    with_lists(command, config, config.hydra)
    assert OmegaConf.select(config, key) == value


TAKEN = [
    "train +scene.friction_noise_mv=4 +features.frames.film=11 +trainer.limit_train_batches=2",
    "train extra_scenes=confound +extra_scenes.taps.machine_mv=3 extra_scenes.taps.cycles=1",
    "train '+extra_scenes.mine={cycles: 3, taps_per_s: 1.0}' '~features.frames.PVDF'",
    "train onset=alarms 'onset.budget={held: 2}' +onset.streams.extra_scenes.held.machine_mv=9",
    "train data=mine --config-dir own",
    "train -m +exp=quick,unseen4 'seed=range(0,3)' 'data.materials=[M1],[M2]'",
    "data action=label_template root=a=b 'pattern={material}_{trial}'",
]
EXAMPLES = [
    line[2:]
    for command in CONFIGURED
    for line in (conf_dir() / f"{command}.yaml").read_text().splitlines()
    if line.startswith("# tactslip ")
]


@pytest.mark.parametrize(
    "line", [*TAKEN, *(pytest.param(line, marks=pytest.mark.slow) for line in EXAMPLES)]
)
def test_what_can_be_set_and_every_example_of_the_help_pass(line):
    Path("FOLDER").mkdir(exist_ok=True)
    for name in ("FOLDER/manifest.csv", "FILE"):
        Path(name).touch()
    command, *rest = shlex.split(line.removeprefix("tactslip "))
    assert checked(command, rest).config


# Help --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", CONFIGURED)
def test_every_key_is_described(command):
    line = checked(command, [])
    keys = _keys_of(command, line.config)
    assert [key.name for key in keys if not key.description] == []
    text = help_text(COMMANDS[command], line)
    assert [key.name for key in keys if f"  {key.name}=" not in text] == []
    assert f"tactslip {command}" in text.partition("examples:")[2]


@pytest.mark.parametrize("line", ["-m tactslip_torch train --help", "-m tactslip_torch.train -h"])
def test_help_comes_without_torch(line):
    code = (
        "import runpy, sys; sys.argv = sys.argv[1:]; "
        "runpy.run_module(sys.argv[0], run_name='__main__', alter_sys=True); "
        "assert 'torch' not in sys.modules"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, *line.split()[1:]], capture_output=True, text=True, cwd=ROOT
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert "tactslip train +exp=quick" in done.stdout


@pytest.mark.parametrize("name", ["c", "native", "node", "python", "web"])
def test_the_links_of_a_copied_page_lead_into_the_copy(name, tmp_path):
    copy_host(name, tmp_path)
    for page in tmp_path.glob("*/*.md"):
        links = re.findall(r"\]\(([^)#:]+)\)", page.read_text(encoding="utf-8"))
        assert [link for link in links if not (page.parent / link).exists()] == []


def test_the_version_is_that_of_the_package(capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["tactslip", "--version"])
    main()
    assert capsys.readouterr().out.startswith(f"tactslip_torch {__version__} (torch ")


def test_the_page_has_every_mistake():
    text = PAGE.read_text(encoding="utf-8")
    assert [line for line in MISTAKES if f"`tactslip {line}`" not in text] == []


def test_help_for_who_reads_no_further_ends_without_a_word():
    for command in ("--help", "stream --help"):
        line = f"{sys.executable} -m tactslip_torch {command} | true"
        ended = subprocess.run(["bash", "-o", "pipefail", "-c", line], capture_output=True)
        assert (ended.returncode, ended.stderr) == (0, b"")


def write_page() -> None:
    """Run every mistake, and write the table between the markers of the page."""
    rows = ["", "| typed | answer |", "|---|---|"]
    with in_a_folder() as place:
        for line in MISTAKES:
            printed = answer(line)[1].strip().replace(f"{place.resolve()}/", "")
            rows.append(f"| `tactslip {line}` | `{printed}` |".replace("=|", "=\\|"))
    text = PAGE.read_text(encoding="utf-8")
    start, end = (text.index(marker) for marker in MARKERS)
    PAGE.write_text(text[: start + len(MARKERS[0])] + "\n".join(rows) + "\n\n" + text[end:])


if __name__ == "__main__":
    write_page()

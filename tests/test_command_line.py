"""What a user types: help, and mistakes, each answered in one line.

``python tests/test_command_line.py`` runs the mistakes and writes ``docs/troubleshooting.md``.
"""

import contextlib
import io
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from tactslip_torch.__main__ import COMMANDS, OF_THEIR_OWN, main
from tactslip_torch.commands import configuration

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "troubleshooting.md"
MARKERS = "<!-- mistakes: written by tests/test_command_line.py -->", "<!-- end of mistakes -->"
CONFIGURED = [name for name in COMMANDS if name not in OF_THEIR_OWN]

MISTAKES = {
    # what is typed: words of the answer
    "trian +exp=quick": "trian 'did you mean train?'",
    "train sedd=1": "sedd 'did you mean seed?'",
    "train +sedd=1": "sedd 'did you mean seed?'",
    "train Seed=1": "Seed 'did you mean seed?'",
    "train num_features=60": "num_features 'did you mean recipe.num_features?'",
    "train recipe.num_featurs=60": "'did you mean recipe.num_features?'",
    "train learning_rate=0.1": "learning_rate 'tactslip train --help'",
    "train +scene.frction_noise_mv=4": "'did you mean scene.friction_noise_mv?'",
    "train +trainer.limit_train_batchs=2": "trainer.limit_train_batchs",
    "train onset.budget.held=1": "onset=alarms",
    "train data.root=recordings": "data=files",
    "train seed 1": "'write seed=1'",
    "train seed = 1": "'write seed=1'",
    "train seed: 1": "'write seed=1'",
    "train seed==1": "'write seed=1'",
    "train --seed 1": "'write seed=1'",
    "train --seed=1": "'write seed=1'",
    "train +seed=1": "'write seed=1'",
    "train ~sedd": "'did you mean seed?'",
    "train +split=seen6": "'write split=seen6'",
    "train +exp=quick +exp=hard": "'+exp=[quick,hard]'",
    "train split=seen6,unseen4": "-m 'choose one'",
    "train scene.friction_noise_mv=4": "'write +scene.friction_noise_mv=VALUE'",
    "train trainer.limit_train_batches=2": "'write +trainer.limit_train_batches=VALUE'",
    "train --config-dir nowhere": "nowhere folder",
    "train quick": "+exp=quick",
    "train exp=quick": "+exp=quick",
    "train +exp quick": "+exp=quick",
    "train +exp=quik": "'known: quick,'",
    "train recipe=robst": "'known: general,'",
    "train -m split=seen6,seen7": "'unknown split seen7; known: seen6,'",
    "train data=mine --config-dir recordings": "'unknown data mine; known: authors_raw,'",
    "train data=webcam": "simulated",
    "train data.materials=[M1, M6]": "\"'data.materials=[M1, M6]'\"",
    "train data.materials=[M1,M6": "\"'data.materials=[M1,M6]'\"",
    "train data.materials=M1,M6": "\"'data.materials=[M1,M6]'\" -m",
    "train features.frames={SG: 51, PVDF: 11}": "\"'features.frames={SG: 51, PVDF: 11}'\"",
    'train "name=\'my run"': "\"name='my run'\"",
    "train 'features.frames={SG: 51, PVDF: 11}}'": "'} too many'",
    "train 'seed=range(0,3)'": "-m",
    "train seed=first": "seed first whole",
    "train split.seen=M7": "M7 M1",
    "train --config-dir own +exp=odd": "recipe.us 'did you mean recipe.use?'",  # in its file
    "train hydra.run.dir=notes.txt/run": "hydra.run.dir notes.txt directory",
    "train data=files": "data.root=",
    "train data=files data.root=nowhere": "nowhere",
    "train data=files data.root=recordings": "recordings manifest",
    "evaluate": "model=",
    "evaluate detector.pt": "'write model=detector.pt'",
    "evaluate model=missing.pt": "missing.pt",
    "evaluate model=notes.txt": "notes.txt",
    "evaluate recipe=paper model=detector.pt": "'evaluate has no key recipe'",
    "detect model=missing.pt input=recordings": "missing.pt",
    "detect model=missing.pt imput=recordings": "'did you mean input?'",
    "detect model=missing.pt input=recordings mcap=a.mcap": "'mcap must be true or false'",
    "stream": "model=",
    "stream model=detector.pt": "source=",
    "stream model=detector.pt source=nowhere.csv": "nowhere.csv serial: listen: stdin",
    "stream model=detector.pt source=serial:/dev/ttyNONE": "/dev/ttyNONE 'there are:'",
    "stream model=detector.pt source=tcp:robot": "[HOST:]PORT 'robot'",
    "stream model=detector.pt source=stdin --serve": "'write serve='",
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
    said, before = io.StringIO(), list(sys.argv)
    sys.argv = ["tactslip", *shlex.split(line)]
    try:
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
            main()
    except SystemExit as end:
        return int(end.code or 0), said.getvalue()
    finally:
        sys.argv = before
    return 0, said.getvalue()


def checked_line(line: str) -> configuration.Checked:
    """The keys and values of a line, if something takes them all."""
    command, *rest = shlex.split(line)
    return configuration.checked(command, rest)


@contextlib.contextmanager
def in_a_folder():
    """A working folder with what the mistakes are made on."""
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        place = Path(folder)
        (place / "recordings").mkdir()
        (place / "recordings" / "cup1.csv").write_text("t,SG1\n0,1\n")
        (place / "own" / "data").mkdir(parents=True)
        (place / "own" / "data" / "mine.yaml").write_text("_target_: mine.Recordings\n")
        (place / "own" / "exp").mkdir()
        (place / "own" / "exp" / "odd.yaml").write_text("# @package _global_\nrecipe: {us: 3}\n")
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
"""Every third mistake, of each kind some, is made in the fast tier: each composes several times."""


@pytest.mark.parametrize("line", SOME_SLOW)
def test_a_mistake_is_answered_in_one_line(line):
    status, said = answer(line)
    assert (status, said.count("\n")) == (2, 1), said
    assert said.startswith("error: ")
    missing = [word for word in shlex.split(MISTAKES[line]) if word not in said]
    assert not missing, said


TEXTS = [
    ("train split.seen=M1", "split.seen", ["M1"]),
    ("train data=files data.root=x data.materials=cup", "data.materials", ["cup"]),
    ("train recipe.use=pooled", "recipe.use", "pooled"),  # a text, or a list to choose from
    ("train features.pooling=sorted", "features.pooling", "sorted"),
]


@pytest.mark.parametrize(("line", "key", "value"), TEXTS)
def test_a_text_is_a_list_of_one_where_a_list_is_wanted(line, key, value):
    composed = checked_line(line).composed
    configuration.with_lists(composed.config, composed)
    assert OmegaConf.select(composed.config, key) == value


TAKEN = [
    "train +scene.friction_noise_mv=4 +features.frames.film=11 +trainer.limit_train_batches=2",
    "train extra_scenes=confound +extra_scenes.taps.machine_mv=3 extra_scenes.taps.cycles=1",
    "train '+extra_scenes.mine={cycles: 3, taps_per_s: 1.0}'",
    "train 'recipe.scene_weights={arm_motion: 1}' '~features.frames.PVDF'",
    "train onset=alarms 'onset.budget={held: 2}' +onset.streams.extra_scenes.held.machine_mv=9",
    "train data=files data.root=x 'data.streams={a: {kind: SG}}'",
    "train data=mine --config-dir own",
    "train -m +exp=quick,unseen4 'seed=range(0,3)' 'data.materials=[M1],[M2]'",
    "data action=label_template root=a=b 'pattern={material}_{trial}'",
    "crossval -m recipe@recipes.paper=general,paper",
]


@pytest.mark.parametrize("line", TAKEN)
def test_keys_that_something_takes_pass(line):
    checked_line(line)


# Help --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", CONFIGURED)
def test_every_key_and_group_is_described(command):
    composed = configuration.Composed(command)
    assert composed.head
    assert len(composed.examples) == 3
    assert [group.name for group in composed.groups if not group.description] == []
    assert [key.name for key in composed.keys if not key.description] == []
    text = configuration.help_text(command, COMMANDS[command], composed)
    assert all(f"  {key.name}=" in text for key in composed.keys)


@pytest.mark.slow
@pytest.mark.parametrize("command", CONFIGURED)
def test_examples_pass(command):
    for example in configuration.Composed(command).examples:
        assert example.split()[:2] == ["tactslip", command]
        checked_line(example.removeprefix("tactslip "))


@pytest.mark.parametrize("line", ["-m tactslip_torch train --help", "-m tactslip_torch.train -h"])
def test_help_comes_without_torch(line):
    code = (
        "import runpy, sys; sys.argv = sys.argv[1:]; "
        "runpy.run_module(sys.argv[0], run_name='__main__', alter_sys=True); "
        "assert 'torch' not in sys.modules"
    )
    told = subprocess.run(
        [sys.executable, "-c", code, *line.split()[1:]], capture_output=True, text=True, cwd=ROOT
    )
    assert (told.returncode, told.stderr) == (0, "")
    assert "tactslip train +exp=quick" in told.stdout


def test_the_page_has_every_mistake():
    text = PAGE.read_text(encoding="utf-8")
    assert [line for line in MISTAKES if f"`tactslip {line}`" not in text] == []


def write_page() -> None:
    """Run every mistake, and write the table between the markers of the page."""
    rows = ["", "| typed | answer |", "|---|---|"]
    with in_a_folder() as place:
        for line in MISTAKES:
            _, said = answer(line)
            said = said.strip().replace(f"{place.resolve()}/", "").replace("|", "\\|")
            rows.append(f"| `tactslip {line}` | `{said}` |")
    text = PAGE.read_text(encoding="utf-8")
    start, end = (text.index(marker) for marker in MARKERS)
    PAGE.write_text(text[: start + len(MARKERS[0])] + "\n".join(rows) + "\n\n" + text[end:])


if __name__ == "__main__":
    write_page()

import sys

import pytest
import torch
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import OmegaConf
from omegaconf.errors import MissingMandatoryValue
from torch.utils.data import DataLoader

from tactslip_torch.commands import entry
from tactslip_torch.commands.entry import (
    conf_dir,
    entry_point,
    errors_in_one_line,
    fail,
    one_line,
    unknown_choice,
)

# Where the configuration lives -----------------------------------------------------------------


def test_conf_is_found_in_a_checkout(request):
    assert conf_dir() == request.config.rootpath / "conf"
    for name in ("train", "evaluate", "export"):
        assert (conf_dir() / f"{name}.yaml").is_file()


def test_conf_inside_the_package_comes_first(monkeypatch, tmp_path):
    package = tmp_path / "site-packages" / "tactslip_torch"
    for folder in (package / "conf", package.parent / "conf"):
        folder.mkdir(parents=True)
        (folder / "train.yaml").write_text("")
    monkeypatch.setattr(entry, "PACKAGE", package)
    assert conf_dir() == package / "conf"
    (package / "conf" / "train.yaml").unlink()
    assert conf_dir() == package.parent / "conf"


def test_no_conf_is_an_error_that_says_where(monkeypatch, tmp_path):
    monkeypatch.setattr(entry, "PACKAGE", tmp_path)
    with pytest.raises(FileNotFoundError, match=r"no conf folder with train\.yaml.*reinstall"):
        conf_dir()


# Choices that do not exist ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["+exp=nope"], "unknown exp nope; known: biotacsp_dos, confound, deploy, hard, leav"),
        (["seed=3", "split=seen7"], "unknown split seen7; known: confound, leave_one_material_out"),
        (["labels=whole"], "unknown labels whole; known: half_second, whole_slide"),
        (["data=real"], "unknown data real; known: authors_raw, biotacsp_dos, files"),
        (["-m", "split=seen6,seen7"], "unknown split seen7"),
        (["exp=unseen4"], "write +exp=unseen4"),
        (["data=mine", "--config-dir", "nowhere"], "unknown data mine; known: authors_raw"),
    ],
)
def test_a_choice_that_does_not_exist_is_one_line(arguments, message):
    line = unknown_choice(arguments)
    assert line is not None
    assert line.startswith(message)
    assert "\n" not in line


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["+exp=unseen4"],
        ["+exp=unseen4,seen6", "-m"],
        ["split=seen6", "labels=half_second"],
        ["split.train_fraction=0.5", "data.cycles=2"],
        ["--cfg", "job", "--help"],
        ["model=out/a=b.pt"],
        ["--config-dir=nowhere"],
        ["data=mine", "--config-dir", "{folder}"],
        ["--config-dir={folder}", "data=mine,files"],
        ["-cd", "{folder}", "+own=thing"],
    ],
)
def test_choices_that_exist_pass(arguments, tmp_path):
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "mine.yaml").touch()
    given = [argument.format(folder=tmp_path) for argument in arguments]
    assert unknown_choice(given) is None


def test_every_option_there_is_passes():
    groups = [folder for folder in conf_dir().iterdir() if folder.is_dir()]
    assert {"data", "split", "labels", "exp"} <= {folder.name for folder in groups}
    for group in groups:
        for path in group.glob("*.yaml"):
            plus = "+" if group.name == "exp" else ""
            assert unknown_choice([f"{plus}{group.name}={path.stem}"]) is None


@pytest.mark.parametrize("argument", ["split=seen7", "hydra.run.dir=/dev/null/run"])
def test_an_entry_point_stops_before_hydra_starts(monkeypatch, capsys, argument):
    monkeypatch.setattr(sys, "argv", ["train", argument])
    with pytest.raises(SystemExit) as stop:
        entry_point("train", lambda config, folder: pytest.fail("was called"))()
    assert stop.value.code == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("error: ")
    assert argument.split("=")[1] in err.replace(" ", "").replace("unknownsplit", "")
    assert err.count("\n") == 1


def test_an_entry_point_composes_its_configuration(monkeypatch, tmp_path):
    folder = tmp_path / "run"
    monkeypatch.setattr(sys, "argv", ["train", "split=seen6", f"hydra.run.dir={folder}"])
    given = []
    entry_point("train", lambda config, folder: given.append((config.split._target_, folder)))()
    assert given == [("tactslip_torch.data.splits.seen6", folder)]


# One line --------------------------------------------------------------------------------------


class Picky:
    def __init__(self, cycles: int) -> None:
        if cycles < 1:
            raise ValueError(f"cycles must be at least 1, got {cycles}")


def instantiation_error(**section):
    with pytest.raises(InstantiationException) as caught:
        instantiate({"_target_": "test_config.Picky", **section})
    return caught.value


def test_hydras_wrapping_is_taken_off():
    assert one_line(instantiation_error(cycles=0)) == "cycles must be at least 1, got 0"


def test_a_misspelt_key_is_named():
    line = one_line(instantiation_error(cycels=3))
    assert "cycels" in line
    assert "\n" not in line


def test_a_target_that_does_not_exist_is_named():
    with pytest.raises(InstantiationException) as caught:
        instantiate({"_target_": "tactslip_torch.data.splits.nope"})
    assert "nope" in one_line(caught.value)


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (ValueError("wrong rate"), "wrong rate"),
        (KeyError("no channel 'SG99' in this hand"), "no channel 'SG99' in this hand"),
        (FileNotFoundError("no detector at a.pt"), "no detector at a.pt"),
        (OSError(28, "No space left on device"), "[Errno 28] No space left on device"),
        (ValueError(), "ValueError"),
        (KeyError(), "KeyError"),
    ],
)
def test_errors_speak_for_themselves(error, line):
    assert one_line(error) == line


class Failing(torch.utils.data.Dataset):
    def __init__(self, error):
        self.error = error

    def __len__(self):
        return 1

    def __getitem__(self, index):
        raise self.error


@pytest.mark.parametrize(
    "error",
    [
        ValueError("M1/3: channel SG2, sample 2500 (1.2500 s) is nan; repair: or leave out"),
        KeyError("no channel 'SG99' in this hand"),
        OSError("disk: gone"),
    ],
    ids=["value", "key", "os"],
)
def test_an_error_of_a_worker_reads_as_it_was_raised(error):
    worker = iter(DataLoader(Failing(error), batch_size=None, num_workers=1))
    with pytest.raises(type(error)) as caught:
        next(worker)
    assert list(worker) == []  # and the worker ends
    assert "Original Traceback" in str(caught.value)
    assert one_line(caught.value).strip("'\"") == error.args[0]


def test_failing_prints_one_line_and_stops(capsys):
    with pytest.raises(SystemExit) as stop:
        fail("two\n  lines\tof text")
    assert stop.value.code == 2
    assert capsys.readouterr().err == "error: two lines of text\n"


@pytest.mark.parametrize(
    "error",
    [ValueError("bad"), KeyError("bad"), TypeError("bad"), FileNotFoundError("bad")],
    ids=lambda error: type(error).__name__,
)
def test_bad_input_becomes_one_line(monkeypatch, capsys, error):
    monkeypatch.delenv("TACTSLIP_TRACEBACK", raising=False)
    with pytest.raises(SystemExit) as stop, errors_in_one_line():
        raise error
    assert stop.value.code == 2
    assert capsys.readouterr().err == "error: bad\n"


def test_a_bug_keeps_its_trace():
    with pytest.raises(ZeroDivisionError), errors_in_one_line():
        _ = 1 / 0


def test_a_trace_can_be_asked_for(monkeypatch):
    monkeypatch.setenv("TACTSLIP_TRACEBACK", "1")
    with pytest.raises(ValueError, match="bad"), errors_in_one_line():
        raise ValueError("bad")


def test_a_wrong_type_is_named_with_its_section():
    target = "tactslip_torch.simulation.source.SimulatedRecordings"
    choices = OmegaConf.create({"data": {"_target_": target, "cycles": "abc"}})
    with pytest.raises(InstantiationException) as caught:
        instantiate(choices.data)
    assert one_line(caught.value).startswith("data: ")


def test_a_value_that_is_missing_is_asked_for():
    with pytest.raises(MissingMandatoryValue) as caught:
        OmegaConf.create({"model": "???"}).model  # noqa: B018  # the look itself raises
    assert one_line(caught.value) == "no value for model; give model=..."

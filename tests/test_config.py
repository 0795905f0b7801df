import pytest
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import OmegaConf
from omegaconf.errors import MissingMandatoryValue
from torch.utils.data import DataLoader, Dataset

from tactslip_torch import commands
from tactslip_torch.commands.configuration import conf_dir
from tactslip_torch.commands.stopping import errors_in_one_line, one_line


def test_conf_inside_the_package_comes_first_and_none_is_an_error(monkeypatch, tmp_path, request):
    assert conf_dir() == request.config.rootpath / "conf"
    package = tmp_path / "site-packages" / "tactslip_torch"
    monkeypatch.setattr(commands, "_PACKAGE", package)
    with pytest.raises(FileNotFoundError, match="reinstall"):
        conf_dir()
    for folder in (package.parent / "conf", package / "conf"):
        folder.mkdir(parents=True)
        (folder / "train.yaml").touch()
        assert conf_dir() == folder


# One line --------------------------------------------------------------------------------------


class Picky:
    def __init__(self, cycles: int) -> None:
        if cycles < 1:
            raise ValueError(f"cycles must be at least 1, got {cycles}")


WRAPPED = [
    ({"_target_": "test_config.Picky", "cycles": 0}, "data: cycles must be at least 1, got 0"),
    ({"_target_": "test_config.Picky", "cycels": 3}, "data: no key cycels; did you mean cycles?"),
    ({"_target_": "tactslip_torch.data.splits.nope"}, "nope"),
]


@pytest.mark.parametrize(("section", "line"), WRAPPED)
def test_hydras_wrapping_is_taken_off_and_the_section_named(section, line):
    with pytest.raises(InstantiationException) as caught:
        instantiate(OmegaConf.create({"data": section}).data)
    assert line in one_line(caught.value)


ERRORS = [
    (KeyError("no channel 'SG99' in this hand"), "no channel 'SG99' in this hand"),
    (OSError(28, "No space left on device"), "[Errno 28] No space left on device"),
    (ValueError(), "ValueError"),
]


@pytest.mark.parametrize(("error", "line"), ERRORS)
def test_errors_speak_for_themselves(error, line):
    assert one_line(error) == line


class Failing(Dataset):
    def __init__(self, error):
        self.error = error

    def __len__(self):
        return 1

    def __getitem__(self, index):
        raise self.error


@pytest.mark.parametrize("kind", [ValueError, KeyError, OSError])
def test_an_error_of_a_worker_reads_as_it_was_raised(kind):
    text = "M1/3: channel 'SG2', sample 2500 (1.2500 s) is nan; repair: or leave out"
    worker = iter(DataLoader(Failing(kind(text)), batch_size=None, num_workers=1))
    with pytest.raises(kind) as caught:
        next(worker)
    assert list(worker) == []  # and the worker ends
    assert one_line(caught.value).strip("\"'") == text


@pytest.mark.parametrize("error", [ValueError, KeyError, TypeError, FileNotFoundError])
def test_bad_input_becomes_one_line_and_a_trace_can_be_asked_for(monkeypatch, capsys, error):
    monkeypatch.delenv("TACTSLIP_TRACEBACK", raising=False)
    with pytest.raises(SystemExit) as stop, errors_in_one_line():
        raise error("two\n  lines\tof text")
    assert stop.value.code == 2
    assert capsys.readouterr().err == "error: two lines of text\n"
    monkeypatch.setenv("TACTSLIP_TRACEBACK", "1")
    with pytest.raises(error), errors_in_one_line():
        raise error("bad")


def test_a_bug_keeps_its_trace():
    with pytest.raises(ZeroDivisionError), errors_in_one_line():
        _ = 1 / 0


def test_a_value_that_is_missing_is_asked_for():
    with pytest.raises(MissingMandatoryValue) as caught:
        OmegaConf.create({"model": "???"}).model  # noqa: B018  # the look itself raises
    assert "give model=" in one_line(caught.value)

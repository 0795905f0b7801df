"""A wheel carries its configuration and runs where there is no checkout."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import yaml
from test_native import quick_compiler

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
FILES = ("hatch_build.py", "pyproject.toml", "README.md", "LICENSE")
FOLDERS = ("conf", "export", "tactslip_torch")


@pytest.fixture(scope="module")
def unpacked(tmp_path_factory):
    compiler = quick_compiler(tmp_path_factory.mktemp("compiler"))
    return unpack(tmp_path_factory, {"CXX": compiler})


def unpack(tmp_path_factory, variables):
    """What pip would install, in an empty folder; the checkout stays clean."""
    copy = tmp_path_factory.mktemp("copy")
    for name in FILES:
        shutil.copy(ROOT / name, copy / name)
    for name in FOLDERS:
        ignore = shutil.ignore_patterns("__pycache__", "library.*", "node_modules")
        shutil.copytree(ROOT / name, copy / name, ignore=ignore)
    built = tmp_path_factory.mktemp("built")
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(built)]
    options = {"cwd": copy, "env": os.environ | variables}
    done = subprocess.run(command, capture_output=True, text=True, check=False, **options)
    assert done.returncode == 0, done.stdout + done.stderr
    (wheel,) = built.glob("*.whl")
    folder = tmp_path_factory.mktemp("site")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder)
    return folder


def run(unpacked, folder, *arguments):
    options = {"cwd": folder, "env": os.environ | {"PYTHONPATH": str(unpacked)}}
    command = [sys.executable, *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, **options)


def test_the_wheel_holds_the_package_and_its_configuration(unpacked):
    package = unpacked / "tactslip_torch"
    (info,) = {path.name for path in unpacked.iterdir()} - {package.name}
    assert info.endswith(".dist-info")
    assert (unpacked / info / "licenses" / "LICENSE").is_file()
    held = {p.relative_to(package / "conf") for p in (package / "conf").rglob("*.yaml")}
    assert held == {p.relative_to(ROOT / "conf") for p in (ROOT / "conf").rglob("*.yaml")}
    for name in ("export/c/README.md", "pretrained/paper24-sim.pt", "pretrained/paper24-sim.npz"):
        assert (package / name).is_file()
    code = {p.relative_to(package) for p in package.rglob("*.py")}
    code = {path for path in code if path.parts[0] != "export"}
    ours = ROOT / "tactslip_torch"
    assert code == {p.relative_to(ours) for p in ours.rglob("*.py")}


def test_the_wheel_holds_the_engine_of_its_platform(unpacked, tmp_path):
    (tag,) = tags(unpacked)
    assert tag.startswith("py3-none-")
    assert tag != "py3-none-any"
    assert len(list((unpacked / "tactslip_torch" / "native").glob("library.*"))) == 1
    code = (
        "from tactslip_torch import native as n; print(n.reason_unavailable() or n._library_path())"
    )
    done = run(unpacked, tmp_path, "-c", code)
    assert Path(done.stdout.strip()).parent == unpacked / "tactslip_torch" / "native"


def test_the_switch_makes_a_pure_wheel(tmp_path_factory):
    pure = unpack(tmp_path_factory, {"TACTSLIP_NATIVE": "0"})
    assert tags(pure) == ["py3-none-any"]
    assert not list((pure / "tactslip_torch" / "native").glob("library.*"))


def tags(unpacked):
    (path,) = unpacked.glob("*.dist-info/WHEEL")
    lines = path.read_text().splitlines()
    return [line.removeprefix("Tag: ") for line in lines if line.startswith("Tag: ")]


def test_the_wheel_comes_before_the_checkout(unpacked, tmp_path):
    """The editable install is on the path as well: without this the next tests prove nothing."""
    code = "from tactslip_torch.commands import configuration as c; print(c.__file__, c.conf_dir())"
    done = run(unpacked, tmp_path, "-c", code)
    assert done.returncode == 0, done.stderr
    module, conf = done.stdout.split()
    assert Path(module) == unpacked / "tactslip_torch" / "commands" / "configuration.py"
    assert Path(conf) == unpacked / "tactslip_torch" / "conf"


def test_train_composes_its_experiment_from_the_wheel(unpacked, tmp_path):
    done = run(unpacked, tmp_path, "-m", "tactslip_torch.train", "--cfg", "job", "+exp=unseen4")
    assert done.returncode == 0, done.stderr
    config = yaml.safe_load(done.stdout)
    assert config["name"] == "unseen4"
    assert config["split"]["_target_"] == "tactslip_torch.data.splits.unseen4"
    assert config["split"]["unseen"] == ["iron", "cloth", "copper", "wood"]
    assert not list(tmp_path.iterdir())  # showing a configuration leaves nothing behind


def test_an_unknown_experiment_is_one_line_from_the_wheel(unpacked, tmp_path):
    done = run(unpacked, tmp_path, "-m", "tactslip_torch.train", "+exp=nope")
    assert done.returncode == 2
    assert done.stderr.startswith("error: unknown exp nope; known: ")
    assert done.stderr.count("\n") == 1

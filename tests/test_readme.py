"""What README.md shows is there and runs."""

import json
import re
from pathlib import Path

import pytest
from hydra._internal.utils import get_args_parser
from test_detector import random_detector

from tactslip_torch import AlarmSettings
from tactslip_torch.model.calibration import Platt
from tactslip_torch.onset.rules import KOfN

ROOT = Path(__file__).parents[1]
PAGES = {path.name: path.read_text() for path in (ROOT / "README.md", *ROOT.glob("docs/*.md"))}
TEXT = PAGES["README.md"]
ALL = "\n".join(PAGES.values())


def test_the_programs_run(tmp_path, monkeypatch, capsys):
    programs = [
        re.findall(r"```python\n(.*?)```", PAGES[name], re.DOTALL)
        for name in ("README.md", "kernel_machine.md", "speed.md")
    ]
    (first, live), (second, through), (third,) = programs
    monkeypatch.chdir(tmp_path)
    random_detector().save("detector.pt")
    exec(compile(first, "README.md", "exec"), {})
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].endswith("torch.Size([8, 2582])")
    assert re.fullmatch(r"tensor\(\[-?\d+\.\d+\]\) tensor\(\[True\]\)", lines[1])
    detector = random_detector()
    settings = AlarmSettings(20, Platt(2.0, 0.0), KOfN(1, 1), -1e9, 1.0)  # an alarm at once
    detector.info["alarm"] = settings.to_dict()
    detector.save("onset.pt")
    exec(compile(live, "README.md", "exec"), {})
    decided, alarm = capsys.readouterr().out.strip().rsplit("\n", 1)
    # 200 samples: a bin and its look-ahead, and 4 more hops; bins alone have no onset score
    assert decided.count("-1.0000e+30") == 4
    assert re.fullmatch(r"0\.0\d+ status True", alarm)
    exec(compile(second, "README.md", "exec"), {})
    (line,) = capsys.readouterr().out.splitlines()
    scores, counts = re.fullmatch(r"tensor\((.*), dtype=.*\) tensor\((.*)\)", line).groups()
    assert len(json.loads(scores)) == 3
    assert sum(json.loads(counts)) == 8 * 200
    exec(compile(through, "README.md", "exec"), {})
    assert capsys.readouterr().out.splitlines() == ["torch.Size([24, 400])", "torch.Size([5])"]
    exec(compile(third, "README.md", "exec"), {})
    assert capsys.readouterr().out.splitlines() == ["torch.Size([64, 174])"] * 3


@pytest.mark.parametrize("name", PAGES)
def test_every_link_and_picture_leads_somewhere(name):
    folder = ROOT if name == "README.md" else ROOT / "docs"
    targets = re.findall(r"\]\((?!https?:)([^)#]+)\)", PAGES[name])
    for target in targets:
        assert (folder / target).exists(), target


def test_every_page_is_in_the_table_of_pages():
    assert {name for name in PAGES if f"docs/{name}" not in TEXT} == {"README.md"}


@pytest.mark.parametrize("kind", ["exp", "labels"])
def test_every_choice_it_names_exists(kind):
    for name in re.findall(rf"\b{kind}=(\w+)", ALL):
        assert (ROOT / "conf" / kind / f"{name}.yaml").exists(), name


def test_every_part_of_the_package_is_in_the_table():
    package = ROOT / "tactslip_torch"
    parts = {path.name + "/" for path in package.iterdir() if (path / "__init__.py").exists()}
    parts |= {path.name for path in package.glob("*.py")} - {"__init__.py"}
    section = TEXT.split("## Where things are")[1].split("\n## ")[0]
    assert {part for part in parts if f"`{part}`" not in section} == set()


def test_hydra_reads_the_sweep_it_shows():
    """Overrides on both sides of -m are refused."""
    (arguments,) = re.findall(r"`\.\.\. ([^`]*-m [^`]+)`", PAGES["commands.md"])
    read = get_args_parser().parse_args(arguments.split())
    assert read.multirun
    assert read.overrides == ["+exp=unseen4", "seed=0,1,2"]

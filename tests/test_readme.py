"""What README.md, the pages and the notebooks show is there and runs."""

import ast
import importlib.util
import io
import json
import os
import re
import shlex
import subprocess
import sys
import tokenize
import tomllib
from pathlib import Path

import numpy as np
import pytest
from hydra._internal.utils import get_args_parser
from test_detector import random_detector

import tactslip_torch
from tactslip_torch import AlarmSettings
from tactslip_torch.__main__ import main
from tactslip_torch.commands.configuration import _options_of
from tactslip_torch.model.calibration import Platt
from tactslip_torch.onset.rules import KOfN

ROOT = Path(__file__).parents[1]
PAGES = {
    path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8")
    for path in (*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *ROOT.glob("export/**/README.md"))
    if "node_modules" not in path.parts
}
RUN = [name for name in PAGES if name.startswith("docs/") or name == "README.md"]
ALL = "\n".join(text for name, text in PAGES.items() if not name.endswith("troubleshooting.md"))
# pages whose commands follow one another
IN_ORDER = ("docs/quickstart.md", "docs/your_hand.md", "docs/deploy.md")
BANNED = re.compile(
    r"\b(houses?|rooms?|rungs?|knobs?|ledgers?|rivals?|judg\w+|verdicts?|heard|fools?|never met"
    r"|promis\w+|stand-ins?|behind the fit|(?:reference|design|findings|physics|style)\.md)\b",
    re.IGNORECASE,
)


@pytest.mark.parametrize(
    "name", [name for name in RUN if name not in IN_ORDER and "```python" in PAGES[name]]
)
def test_the_programs_run(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    detector = random_detector()
    detector.save("detector.pt")
    settings = AlarmSettings(20, Platt(2.0, 0.0), KOfN(1, 1), -1e9, 1.0)
    detector.info["alarm"] = settings.to_dict()
    detector.save("onset.pt")
    for program in re.findall(r"```python\n(.*?)```", PAGES[name], re.DOTALL):
        exec(compile(program, name, "exec"), {})


OURS = re.compile(r"(?:tactslip|python -m tactslip_torch[. ])(.*)")


def run_in_shell(part, monkeypatch):
    """Lines of a shell; what begins with our command is run here, for a process takes seconds."""
    lines = part.replace("\\\n", " ").strip().splitlines()
    ours = [OURS.fullmatch(line) for line in lines]
    if not all(ours):
        subprocess.run(["bash", "-e", "-c", part], check=True)
        return
    for line in ours:
        monkeypatch.setattr(sys, "argv", ["tactslip", *shlex.split(line[1])])
        main()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", IN_ORDER)
def test_every_command_and_program_runs_in_an_empty_folder(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", str(Path(sys.executable).parent), os.pathsep)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    for language, part in re.findall(r"```(python|bash)\n(.*?)```", PAGES[name], re.DOTALL):
        if language == "python":
            exec(compile(part, name, "exec"), {})
        elif "pip install" not in part:  # .ci/run installs
            run_in_shell(part, monkeypatch)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("path", sorted(ROOT.glob("examples/*.ipynb")), ids=lambda path: path.stem)
def test_a_notebook_runs(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    variables = {}
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), path.name, "exec"), variables)


def anchors(text):
    """Anchors of headings, as the site makes them."""
    text = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    heads = re.findall(r"^#+ (.*)", text.lower(), re.M)
    return {re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", head).strip()) for head in heads}


@pytest.mark.parametrize("name", PAGES)
def test_every_link_leads_somewhere(name):
    for target, anchor in re.findall(r"\]\((?!\w+:)([^)#\s]*)#?([^)\s]*)\)", PAGES[name]):
        path = (ROOT / name).parent / target if target else ROOT / name
        assert path.exists(), target
        if anchor:
            assert anchor in anchors(path.read_text(encoding="utf-8")), f"{target}#{anchor}"


@pytest.mark.parametrize("kind", ["exp", "labels", "scene", "recipe", "onset", "split"])
def test_every_choice_it_names_exists(kind):
    pages = ALL.replace(PAGES["CHANGELOG.md"], "").replace(PAGES["docs/migrating.md"], "")
    pages = re.sub(r"<!-- (\w+) -->.*?<!-- /\1 -->", "", pages, flags=re.S)  # results, of their day
    for name in re.findall(rf"[\s`]\+?{kind}=(\w+)", pages):
        assert name in (*_options_of(kind), "NAME")


def test_every_public_name_is_in_the_reference():
    shown = re.findall(r"^::: tactslip_torch\.(\w+)$", PAGES["docs/api.md"], re.M)
    assert sorted(shown) == sorted(tactslip_torch.__all__)


def test_every_dependency_and_its_licence_is_named():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    needed = sum((extras[of] for of in ("formats", "live")), project["dependencies"])
    licences = PAGES["README.md"].split("## Citation")[1]
    names = [re.match(r"[\w-]+", one)[0] for one in needed]
    assert [name for name in names if not re.search(rf"\b{name}\b", licences)] == []
    bounded = [one for one in needed if "<" in one]
    assert [one for one in bounded if not one.startswith("torch>")] == []


def test_lines_of_code_are_counted():
    rows = re.findall(r"\| (\d+) \| \[(\w+\.py)\]", PAGES["docs/quickstart.md"])
    assert [int(lines) for lines, _ in rows] == [code_lines(EXAMPLES / name) for _, name in rows]
    assert len(rows) == 3


def test_readme_is_short():
    assert len(PAGES["README.md"].encode()) <= 8_000


def strings(path):
    """Strings of a module, docstrings among them."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    constants = (node.value for node in ast.walk(tree) if isinstance(node, ast.Constant))
    return "\n".join(value for value in constants if isinstance(value, str))


def test_words_are_plain():
    old = ("CHANGELOG.md", "docs/migrating.md")  # these name what is gone
    texts = {name: text for name, text in PAGES.items() if name not in old}
    for pattern in ("conf/**/*.yaml", "examples/*.ipynb"):
        texts |= {str(path): path.read_text(encoding="utf-8") for path in ROOT.glob(pattern)}
    texts |= {str(path): strings(path) for path in ROOT.glob("tactslip_torch/**/*.py")}
    found = {name: hits for name, text in texts.items() if (hits := BANNED.findall(text))}
    assert found == {}


def test_hydra_reads_the_sweep_it_shows():
    """Overrides on both sides of -m are refused."""
    (arguments,) = re.findall(r"`\.\.\. ([^`]*-m [^`]+)`", PAGES["docs/commands.md"])
    read = get_args_parser().parse_args(arguments.split())
    assert read.multirun
    assert read.overrides == ["+exp=unseen4", "seed=0,1,2"]


EXAMPLES = ROOT / "examples"


def code_lines(path: Path) -> int:
    """Lines that hold code: no comment, blank line or docstring."""
    text = path.read_text(encoding="utf-8")
    passed = (tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT)
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in passed and token.string:
            lines.update(range(token.start[0], token.end[0] + 1))
    docstring = ast.parse(text).body[0]
    return len(lines - set(range(docstring.lineno, (docstring.end_lineno or 0) + 1)))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two seconds of noise of three channels a file; slip is louder, each material by its own."""
    rng, made = np.random.default_rng(0), tmp_path_factory.mktemp("recordings")
    for number, material in enumerate(("foam", "glass", "steel")):
        for label, size in (("stick", 1.0), ("slip", 2.0 + 0.3 * number)):
            samples = size * rng.standard_normal((4000, 3))
            path = made / f"{material}_{label}_1.csv"
            np.savetxt(path, samples, "%.6f", delimiter=",", header="C1,C2,C3", comments="")
    return made


@pytest.mark.slow
@pytest.mark.parametrize("name", ["newcomer", "newcomer_tsfel", "newcomer_aeon"])
def test_a_newcomer_gets_from_files_to_a_model(folder: Path, name: str) -> None:
    if (library := name.removeprefix("newcomer_")) != name:
        pytest.importorskip(library)
    environment = os.environ | {"PYTHONPATH": str(EXAMPLES.parent)}
    command = [sys.executable, str(EXAMPLES / f"{name}.py"), str(folder)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    score, found = done.stdout.splitlines()[-2:]
    assert float(score.split()[-1]) > 0.9
    assert "of 240 windows are slip" in found
    assert 100 < int(found.split()[1]) < 140


def test_it_takes_few_lines_of_public_names() -> None:
    path = EXAMPLES / "newcomer.py"
    assert code_lines(path) <= 25
    imported = re.findall(
        r"^from (tactslip\S*) import (.*)", path.read_text(encoding="utf-8"), re.M
    )
    assert imported
    for module, names in imported:
        assert module == "tactslip_torch"
        assert set(names.split(", ")) <= set(tactslip_torch.__all__)


def test_a_citation_is_of_this_version() -> None:
    version = tactslip_torch.__version__.partition(".dev")[0]
    cited = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\nversion: {version}\n" in cited
    assert f"version = {{{version}}}" in PAGES["README.md"]


def test_links_of_the_index_lead_into_the_repository() -> None:
    """Pictures to their bytes, pages to what shows them; other links are left alone."""
    pytest.importorskip("hatchling")
    spec = importlib.util.spec_from_file_location("hatch_build", ROOT / "hatch_build.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    text = "![a](docs/a.png) [b](docs/b.md#c) [d](#e) [f](https://g.h)"
    at = "https://host/us"
    assert module.absolute(text, at) == (
        f"![a]({at}/raw/HEAD/docs/a.png) [b]({at}/blob/HEAD/docs/b.md#c) [d](#e) [f](https://g.h)"
    )
    assert module.absolute(text, "") == text

"""Sections of pages say whether they are of the present sources."""

import json
import re
from pathlib import Path

import pytest

from benchmarks import sources
from tactslip_torch import __version__

ROOT = sources.ROOT
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
SECTIONS = [
    pytest.param(path, *found, id=f"{path.name}-{found[0]}")
    for path in PAGES
    for found in sources.sections(path.read_text(encoding="utf-8"))
]
FILES = {
    "benchmarks/a.py": "from tactslip_torch import double\nSOURCES = ('conf/*.yaml',)\n",
    "tactslip_torch/__init__.py": "if TYPE_CHECKING:\n    from tactslip_torch.b import double\n",
    "tactslip_torch/b.py": 'def double(x):\n    """Twice."""\n    return 2 * x\n',
    "tactslip_torch/unused.py": "x = 1\n",
    "conf/a.yaml": "source:\n  _target_: tactslip_torch.named.Named\n",
    "tactslip_torch/named/__init__.py": "class Named: ...\n",
    "tactslip_torch/named/numbers.json": "[1]\n",
}


@pytest.fixture
def digest_of(tmp_path, monkeypatch):
    """The digest of ``a`` in a repository of these files with some replaced."""
    made = iter(range(100))

    def digest(replaced: dict[str, str]) -> str:
        root = tmp_path / str(next(made))
        for name, text in (FILES | replaced).items():
            path = root / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        monkeypatch.setattr(sources, "ROOT", root)
        return sources.digest("a")

    return digest


def _replaced(name: str, old: str, new: str) -> dict[str, str]:
    assert old in FILES[name]
    return {name: FILES[name].replace(old, new)}


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("tactslip_torch/b.py", "2 * x", "3 * x"),
        ("conf/a.yaml", "source", "other"),
        ("tactslip_torch/named/__init__.py", "...", "x = 1"),
        ("tactslip_torch/named/numbers.json", "1", "2"),
    ],
)
def test_a_change_of_what_a_benchmark_rests_on_changes_its_digest(
    digest_of, name: str, old: str, new: str
) -> None:
    assert digest_of(_replaced(name, old, new)) != digest_of({})


def test_comments_docstrings_version_and_other_modules_do_not_change_a_digest(digest_of) -> None:
    changed = _replaced("tactslip_torch/b.py", '"""Twice."""', '"""Two times."""  # so')
    changed["tactslip_torch/b.py"] += '__version__ = "9.9"\n'
    changed["tactslip_torch/unused.py"] = "x = 2\n"
    changed |= _replaced("conf/a.yaml", "source:", "# so\n\nsource:   # as it is")
    assert digest_of(changed) == digest_of({})


COMMANDS = {
    "tactslip_torch/commands/configuration.py": "",
    "tactslip_torch/commands/train.py": "from tactslip_torch.commands import configuration\n",
    "benchmarks/a.py": "from tactslip_torch.commands import train\nGIVEN = ['+exp=one']\n",
    "conf/scenes.yaml": "scene: {}\n",
    "conf/detect.yaml": "seed: 1\n",
    "conf/train.yaml": "defaults:\n  - onset: none   # no alarm\n",
    "conf/onset/none.yaml": "{}\n",
    "conf/onset/alarms.yaml": "hop_ms: 5\n",
    "conf/onset/other.yaml": "hop_ms: 6\n",
    "conf/exp/one.yaml": "defaults:\n  - override /onset: alarms\n",
    "conf/exp/two.yaml": "seed: 2\n",
}


@pytest.mark.parametrize(
    ("name", "counts"),
    [
        ("conf/train.yaml", True),
        ("conf/scenes.yaml", True),
        ("conf/detect.yaml", False),
        ("conf/onset/none.yaml", True),
        ("conf/exp/one.yaml", True),
        ("conf/onset/alarms.yaml", True),
        ("conf/onset/other.yaml", False),
        ("conf/exp/two.yaml", False),
    ],
)
def test_commands_and_options_of_a_benchmark_change_its_digest_and_others_do_not(
    digest_of, name: str, counts: bool
) -> None:
    changed = COMMANDS | {name: COMMANDS[name] + "more: 1\n"}
    assert (digest_of(changed) != digest_of(COMMANDS)) == counts


def test_a_name_that_is_put_in_chooses_every_option(digest_of) -> None:
    words = COMMANDS["benchmarks/a.py"].replace("'+exp=one'", "f'+exp={name}'")
    files = COMMANDS | {"benchmarks/a.py": words}
    assert digest_of(files | {"conf/exp/two.yaml": "seed: 3\n"}) != digest_of(files)


@pytest.mark.parametrize(("page", "name", "code"), SECTIONS)
def test_a_section_shows_kept_numbers_and_says_if_the_code_has_changed(
    page: Path, name: str, code: str
) -> None:
    kept = json.loads((sources.RESULTS / f"{name}.json").read_text(encoding="utf-8"))
    assert kept["code"] == code, f"python -m benchmarks.{name} --render"
    text = sources.marked(page.read_text(encoding="utf-8"))
    below = text.split(f"code {code}", 1)[1].lstrip(".):`\n")
    assert below.startswith(sources.STALE) == (not sources.is_current(name))
    if code != sources.digest(name):  # one that takes numbers of others is stale as they are
        assert not sources.is_current(name)


@pytest.mark.skipif(".dev" in __version__, reason="of a release alone")
@pytest.mark.parametrize("name", sorted({of.values[1] for of in SECTIONS}))
def test_a_release_has_no_section_of_earlier_code(name: str) -> None:
    assert sources.is_current(name), f"measure again: python -m benchmarks.{name}"


TRAINING = [
    path.stem
    for path in (ROOT / "benchmarks").glob("*.py")
    if re.search(r"\b(trained|composed|main_job_detector)\(", path.read_text(encoding="utf-8"))
]


@pytest.mark.parametrize("name", TRAINING)
def test_what_trains_rests_on_the_command_and_its_configuration(name: str) -> None:
    found = {path.relative_to(ROOT).as_posix() for path in sources.sources(name)}
    assert {"tactslip_torch/commands/train.py", "conf/train.yaml"} <= found

"""Hook of mkdocs: what pages use from outside ``docs/`` becomes part of the site.

``README.md`` is the first page. Files that pages link to (figures of benchmarks, a host's README)
are added under their path in the repository, and links follow them. A notebook becomes a page of
its cells and kept outputs; nothing is executed. A section whose benchmark has changed since it was
measured says so.
"""

from __future__ import annotations

import json
import posixpath
import re
import sys
import tomllib
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File

ROOT = Path(__file__).parents[1]
sys.path.append(str(ROOT))

from benchmarks import sources  # noqa: E402

LINK = re.compile(r"(?<=\]\()(?!\w+:|#)([^)#\s]+)")
"""The target of a link in Markdown, without its anchor."""


def on_files(files: Any, config: Any) -> Any:
    """Add what the pages link to, and what is linked to from there."""
    paths = [f"docs/{file.src_uri}" for file in files.documentation_pages()]
    paths += [
        *(f"{name}.md" for name in OUTSIDE),
        *(f"examples/{path.name}" for path in ROOT.glob("examples/*.ipynb")),
    ]
    for path in paths:  # which grows
        is_page = path.endswith((".md", ".ipynb"))
        if not path.startswith("docs/"):
            content = {"content": _markdown(path)} if is_page else {"abs_src_path": ROOT / path}
            files.append(File.generated(config, _uri(path), **content))
        if is_page:
            linked = dict.fromkeys(_target(path, link) for link in LINK.findall(_markdown(path)))
            paths += [new for new in linked if (ROOT / new).is_file() and new not in paths]
    return files


OUTSIDE = ("README", "CHANGELOG", "CONTRIBUTING", "SECURITY", "CODE_OF_CONDUCT")
"""Pages beside the folder of pages."""


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Links become those of the site, and sections of earlier code say so."""
    uri = page.file.src_uri
    path = f"docs/{uri}" if page.file.src_dir else uri
    folder = posixpath.dirname(uri)

    def moved(found: re.Match[str]) -> str:
        new = _uri(_target(path, found[0]))
        is_there = files.get_file_from_path(new) is not None
        return posixpath.relpath(new, folder or ".") if is_there else found[0]

    if uri == "configuration.md":
        begin, end = "<!-- configuration -->", "<!-- /configuration -->"
        markdown = f"{markdown.split(begin)[0]}{_configuration()}{markdown.split(end)[1]}"
    return LINK.sub(moved, sources.marked(markdown))


def on_config(config: Any) -> Any:
    """The repository's address, where it has one."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    config.repo_url = project["tool"]["tactslip_torch"]["repository"] or None
    return config


KEY = re.compile(r"^( *)(?:- )?([\w@/]+): *(.*?)(?:(?:^| +)# (.*))?$")
"""Indent, name, value and comment of a line of our YAML files."""


def _configuration() -> str:
    """Tables of the keys of all commands, then of the choices of each group."""
    parts, conf = list[str](), ROOT / "conf"
    tables = {"Commands": [path for path in sorted(conf.glob("*.yaml")) if path.stem != "scenes"]}
    for folder in sorted(path for path in conf.iterdir() if path.is_dir()):
        plus = "+" if folder.name == "exp" else ""
        title = f"{folder.name.capitalize()}: `{plus}{folder.name}=NAME`"
        tables[title] = sorted(folder.glob("*.yaml"))
    for title, paths in tables.items():
        parts.append(f"## {title}")
        for path in paths:
            about, rows = _keys(path)
            parts.append(f"### `{path.relative_to(conf).with_suffix('').as_posix()}`\n\n{about}")
            if rows:
                parts.append("\n".join(["| key | default | meaning |", "|---|---|---|", *rows]))
    return "\n\n".join(parts)


def _keys(path: Path) -> tuple[str, list[str]]:
    """What the comment at the top of a file says, and a row of a table for each of its keys."""
    about, rows, above = [], [], list[tuple[int, str]]()
    for line in path.read_text(encoding="utf-8").splitlines():
        if line.startswith("# ") and not rows:
            text = line[2:]
            about.append(f"`{text}`" if text.startswith("tactslip") else text)
        found = KEY.match(line)
        if not found or line.lstrip().startswith("#"):
            continue
        indent, name, value, comment = len(found[1]), *found.groups()[1:]
        above = [(place, key) for place, key in above if place < indent] + [(indent, name)]
        key = ".".join(key for _, key in above).removeprefix("defaults.")
        if key.startswith("hydra") or name in ("_target_", "_partial_") or not (value or comment):
            continue
        shown = f"`{value}`" if value else ""
        cells = [f"`{key}`", shown.replace("|", "\\|"), (comment or "").replace("|", "\\|")]
        rows.append(f"| {' | '.join(cells)} |")
    return "  \n".join(about), rows


def _target(path: str, link: str) -> str:
    """What a link in a file leads to, from the repository's root."""
    return posixpath.normpath(posixpath.join(posixpath.dirname(path), link))


def _uri(path: str) -> str:
    """Where a file of the repository stands in the site."""
    return path.removeprefix("docs/").replace(".ipynb", ".md")


def _markdown(path: str) -> str:
    """A page's Markdown; of a notebook its cells, with outputs of text and figures."""
    text = (ROOT / path).read_text(encoding="utf-8")
    if not path.endswith(".ipynb"):
        return text
    parts = [f"*The notebook `{path}`.*"]
    for cell in json.loads(text)["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
            continue
        parts.append(f"```python\n{source}\n```")
        for output in cell["outputs"]:
            data = output.get("data", {"text/plain": output.get("text", "")})
            if "image/png" in data:
                parts.append(f"![Output](data:image/png;base64,{data['image/png'].strip()})")
            elif told := "".join(data["text/plain"]).rstrip():
                follows = parts[-1].startswith("```text")
                above = parts.pop().removesuffix("```") if follows else "```text\n"
                parts.append(f"{above}{told}\n```")
    title, _, rest = parts[1].partition("\n")
    return "\n\n".join([title, parts[0], rest.strip(), *parts[2:]])

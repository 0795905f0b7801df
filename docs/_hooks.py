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
    paths += [*OUTSIDE, *(f"examples/{path.name}" for path in ROOT.glob("examples/*.ipynb"))]
    for path in paths:  # which grows
        is_page = path.endswith((".md", ".ipynb"))
        if not path.startswith("docs/"):
            content = {"content": _markdown(path)} if is_page else {"abs_src_path": ROOT / path}
            files.append(File.generated(config, _uri(path), **content))
        if is_page:
            linked = dict.fromkeys(_target(path, link) for link in LINK.findall(_markdown(path)))
            paths += [new for new in linked if (ROOT / new).is_file() and new not in paths]
    return files


OUTSIDE = ("README.md", "CHANGELOG.md")  # pages of the navigation


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Links become those of the site, and sections of earlier code say so."""
    uri = page.file.src_uri
    path = f"docs/{uri}" if page.file.src_dir else uri
    folder = posixpath.dirname(uri)

    def moved(found: re.Match[str]) -> str:
        new = _uri(_target(path, found[0]))
        is_there = files.get_file_from_path(new) is not None
        return posixpath.relpath(new, folder or ".") if is_there else found[0]

    return LINK.sub(moved, sources.marked(markdown))


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
                parts.append(f"```text\n{told}\n```")
    parts.insert(1, parts.pop(0))  # below the title
    return "\n\n".join(parts)

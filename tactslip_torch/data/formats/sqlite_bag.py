"""A ``.db3`` file of rosbag2 as pages of messages: SQLite, opened to read and nothing else.

A database can hold views and computed columns, which run when they are read; tables that should be
plain ones and are not are refused.
"""

from __future__ import annotations

import sqlite3
from pathlib import Path
from typing import Any

import numpy as np

from tactslip_torch.data.formats.messages import Page, Topic
from tactslip_torch.data.formats.packing import MOST_BYTES

_PAGE = 2**20  # bytes of messages
_MOST_TOPICS = 10_000
_NEEDED = {
    "topics": ("id", "name", "type", "serialization_format"),
    "messages": ("id", "topic_id", "timestamp", "data"),
}
_DEFINITIONS = ("topic_type", "encoding", "encoded_message_definition")


class SqliteBag:
    """Messages of one file.

    Raises:
        ValueError: if it is no database of rosbag2, damaged, or was not closed.
    """

    def __init__(self, path: Path) -> None:
        log = path.with_name(path.name + "-wal")
        if log.exists() and log.stat().st_size:
            raise ValueError(
                f"{path.name} was not closed, {log.name} holds messages; open it once with the "
                "sqlite3 program, which puts them where they belong"
            )
        self._connection = sqlite3.connect(
            f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True
        )
        try:
            self._connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MOST_BYTES)
            self._connection.text_factory = _text
            self._all("PRAGMA trusted_schema = OFF")
            self._check_tables()
            self._topic_ids, self._found = self._read_topics()
            self._pages = self._list_pages()
        except BaseException:
            self.close()
            raise
        self.num_pages = len(self._pages)

    def close(self) -> None:
        """Close the file."""
        self._connection.close()

    def topics(self) -> dict[str, Topic]:
        """As ``Bag.topics``."""
        return self._found

    def page(self, number: int, topic: str) -> Page:
        """As ``Bag.page``."""
        first, last = self._pages[number]
        rows = [
            row
            for topic_id in self._topic_ids.get(topic, ())
            for row in self._all(
                "SELECT id, timestamp, data FROM messages "
                "WHERE id BETWEEN ? AND ? AND topic_id = ? ORDER BY id",
                first,
                last,
                topic_id,
            )
        ]
        rows.sort(key=lambda row: row[0])
        times = [row[1] for row in rows]
        messages = [row[2] for row in rows]
        if not all(type(time) is int for time in times):
            raise ValueError("damaged: a message without a time")
        if not all(type(message) is bytes for message in messages):
            raise ValueError("damaged: a message that is not bytes")
        return Page(np.array(times, np.int64), messages)

    def _all(self, question: str, *values: Any) -> list[tuple[Any, ...]]:
        try:
            return self._connection.execute(question, values).fetchall()
        except sqlite3.Error as error:
            raise ValueError(f"damaged, or no database of rosbag2: {error}") from None

    def _columns(self, table: str) -> set[str]:
        """Stored columns of a plain table; none if it is no such."""
        question = "SELECT rootpage FROM sqlite_master WHERE type = 'table' AND name = ?"
        if [bool(root) for (root,) in self._all(question, table)] != [True]:
            return set()
        question = "SELECT name FROM pragma_table_xinfo(?) WHERE hidden = 0"
        return {name for (name,) in self._all(question, table)}

    def _check_tables(self) -> None:
        for table, columns in _NEEDED.items():
            if missing := set(columns) - self._columns(table):
                raise ValueError(
                    f"no database of rosbag2: no table {table} with {', '.join(sorted(missing))}"
                )

    def _read_topics(self) -> tuple[dict[str, list[int]], dict[str, Topic]]:
        """Numbers of the topics, and what is known of those with messages."""
        ids: dict[str, list[int]] = {}
        found: dict[str, Topic] = {}
        definitions: dict[str, tuple[str, str]] = {}
        if self._columns("message_definitions").issuperset(_DEFINITIONS):
            rows = self._all(f"SELECT {', '.join(_DEFINITIONS)} FROM message_definitions")
            definitions = {str(kind): (str(code), str(text)) for kind, code, text in rows}
        firsts = dict(self._all("SELECT topic_id, min(id) FROM messages GROUP BY topic_id"))
        question = "SELECT id, name, type, serialization_format FROM topics ORDER BY id LIMIT ?"
        for number, name, kind, encoding in self._all(question, _MOST_TOPICS):
            ids.setdefault(str(name), []).append(number)
            first = self._all("SELECT data FROM messages WHERE id = ?", firsts.get(number))
            if first and type(first[0][0]) is bytes:
                code, text = definitions.get(str(kind), ("", ""))
                topic = Topic(str(name), str(kind), str(encoding), code, text, first[0][0])
                found.setdefault(topic.name, topic)
        return ids, found

    def _list_pages(self) -> list[tuple[int, int]]:
        """First and last row of each page."""
        pages: list[tuple[int, int]] = []
        size = 0
        try:
            rows = self._connection.execute("SELECT id, length(data) FROM messages ORDER BY id")
            for number, length in rows:
                if not pages or size + (length or 0) > _PAGE:
                    pages.append((number, number))
                    size = 0
                pages[-1] = (pages[-1][0], number)
                size += length or 0
        except sqlite3.Error as error:
            raise ValueError(f"damaged, or no database of rosbag2: {error}") from None
        return pages


def _text(content: bytes) -> str:
    return content.decode(errors="replace")

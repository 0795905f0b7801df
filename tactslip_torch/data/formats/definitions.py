"""What the definition of a ROS 2 message says, as fields that ``cdr`` can walk.

Definitions are texts beside the messages; where a bag has none, those that ROS brings are taken.
``rosbags`` parses them; the Python code it could make of them is not asked for, since a definition
comes from a file that anybody may have written. For the same reason IDL is not parsed: a short one
can keep the parser of ``rosbags`` busy for ever.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tactslip_torch.data.formats.cdr import Field, Group, Many, Number, Text
from tactslip_torch.data.formats.reading import needs

ARRAYS = {
    f"std_msgs/msg/{name}MultiArray": dtype
    for name, dtype in (
        ("Float32", "f4"), ("Float64", "f8"), ("Int8", "i1"), ("Int16", "i2"), ("Int32", "i4"),
        ("Int64", "i8"), ("UInt8", "u1"), ("UInt16", "u2"), ("UInt32", "u4"), ("UInt64", "u8"),
        ("Byte", "u1"),
    )
}  # fmt: skip
"""Arrays of ``std_msgs``, ours among them: known without a text, and so without ``rosbags``."""
MOST_TEXT = 128 * 1024
"""Bytes of a definition; the longest of ROS have some ten thousand."""
_DTYPES = {
    "bool": "u1", "byte": "u1", "char": "u1", "float32": "f4", "float64": "f8", "int8": "i1",
    "int16": "i2", "int32": "i4", "int64": "i8", "uint8": "u1", "uint16": "u2", "uint32": "u4",
    "uint64": "u8",
}  # fmt: skip
_MOST_DEPTH = 32


def definition(name: str, encoding: str, text: str) -> Group:
    """The fields of a message.

    Args:
        name: of its type, such as ``std_msgs/msg/Header``.
        encoding: of the text; ``ros2msg`` is read.
        text: what defines it; if it is empty or not read, what ROS brings must do.

    Raises:
        ValueError: if it cannot be understood, or ``rosbags`` is needed and absent.
    """
    full = name if "/msg/" in name else name.replace("/", "/msg/", 1)
    if full in ARRAYS:
        return Group(full, (("data", Many(Number(ARRAYS[full]), None)),))
    typesys = needs("rosbags.typesys", f"reading messages of type {name}")
    if len(text) > MOST_TEXT:
        raise ValueError(f"a definition of {len(text)} characters, at most {MOST_TEXT} are read")
    try:
        if text and encoding == "ros2msg":
            types = typesys.get_types_from_msg(text, full)
        else:
            types = typesys.get_typestore(typesys.Stores.LATEST).fielddefs
    except (typesys.TypesysError, AssertionError, KeyError, ValueError, RecursionError):
        raise ValueError(f"the definition of {full} is no {encoding}") from None
    if full not in types:
        raise ValueError(f"no definition of {full} as ros2msg, and ROS brings none")
    return _group(full, types, {}, 0)


def _group(name: str, types: Mapping[str, Any], known: dict[str, Group], depth: int) -> Group:
    """A type and all in it; each is made once."""
    if name not in known:
        if name not in types:
            raise ValueError(f"no definition of {name}")
        if depth > _MOST_DEPTH:
            raise ValueError(f"{name} holds itself, or types nest deeper than {_MOST_DEPTH}")
        fields = types[name][1]
        known[name] = Group(
            name, tuple((inner, _field(kind, types, known, depth + 1)) for inner, kind in fields)
        )
    return known[name]


def _field(
    kind: tuple[Any, Any], types: Mapping[str, Any], known: dict[str, Group], depth: int
) -> Field:
    """A field as ``rosbags`` describes it: what it is, and of what or how many."""
    what, of = kind
    if what.name == "BASE":
        if of[0] == "string":
            return Text()
        if of[0] not in _DTYPES:
            raise ValueError(f"fields of type {of[0]} are not read")
        return Number(_DTYPES[of[0]])
    if what.name == "NAME":
        return _group(of, types, known, depth)
    element, count = of
    return Many(_field(element, types, known, depth), count if what.name == "ARRAY" else None)

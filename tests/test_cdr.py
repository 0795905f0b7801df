"""Numbers in CDR messages, against what rosbags serialises."""

import builtins

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from message_bags import JOINTS, STORE, WRENCH, array, joints, noise, wrench
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tactslip_torch.data.formats.cdr import MOST_CHANNELS, Group, Many, Number, Text, form_of
from tactslip_torch.data.formats.decoding import CdrDecoder
from tactslip_torch.data.formats.definitions import ARRAYS, definition

SCALARS = {
    "bool": st.booleans(),
    "int8": st.integers(-(2**7), 2**7 - 1),
    "uint8": st.integers(0, 2**8 - 1),
    "int16": st.integers(-(2**15), 2**15 - 1),
    "uint16": st.integers(0, 2**16 - 1),
    "int32": st.integers(-(2**31), 2**31 - 1),
    "uint32": st.integers(0, 2**32 - 1),
    "int64": st.integers(-(2**53), 2**53),
    "float32": st.floats(width=32, allow_nan=False),
    "float64": st.floats(allow_nan=False),
    "string": st.text(st.characters(exclude_characters="\0", codec="utf-8"), max_size=5),
}


def defined(kind):
    text, _ = STORE.generate_msgdef(kind, ros_version=2)
    return definition(kind, "ros2msg", text)


@st.composite
def layouts(draw):
    """Fields of a message: type, how many (None: one), and values."""
    fields = []
    for _ in range(draw(st.integers(1, 6))):
        kind = draw(st.sampled_from(sorted(SCALARS)))
        shape = draw(st.sampled_from(["one", "array", "sequence"]))
        count = 1 if shape == "one" else draw(st.integers(shape == "array", 4))
        values = draw(st.lists(SCALARS[kind], min_size=count, max_size=count))
        fields.append((kind, shape, values))
    return fields


@pytest.mark.parametrize("is_little", [True, False])
@settings(max_examples=60, deadline=None)
@given(fields=layouts())
def test_any_message_of_plain_fields_is_read_as_rosbags_wrote_it(is_little, fields):
    suffix = {"one": "", "sequence": "[]"}
    text = "".join(
        f"{kind}{suffix.get(shape, f'[{len(values)}]')} f{n}\n"
        for n, (kind, shape, values) in enumerate(fields)
    )
    store = get_typestore(Stores.EMPTY)
    name = "test_msgs/msg/Any"
    store.register(get_types_from_msg(text, name))
    arguments = []
    for kind, shape, values in fields:
        if shape == "one":
            arguments.append(values[0])
        elif kind == "string":
            arguments.append(values)
        else:
            arguments.append(np.array(values, dtype=kind))
    message = bytes(
        store.serialize_cdr(store.types[name](*arguments), name, little_endian=is_little)
    )
    wanted = [float(v) for kind, _, values in fields if kind != "string" for v in values]
    if not wanted:
        with pytest.raises(ValueError, match="no numbers"):
            form_of(definition(name, "ros2msg", text), message)
        return
    decoder = CdrDecoder(definition(name, "ros2msg", text), message)
    found = decoder.decode([message])
    assert found.values.astype(float).tolist() == [wanted]
    assert len(decoder.names) == len(wanted) == len(set(decoder.names))


def test_numbers_are_named_by_their_path():
    assert CdrDecoder(defined(WRENCH), wrench(range(6), 5)).names == tuple(
        f"wrench.{part}.{axis}" for part in ("force", "torque") for axis in "xyz"
    )
    assert CdrDecoder(defined(JOINTS), joints(range(4), 5)).names == (
        "position[0]", "position[1]", "velocity[0]", "velocity[1]",
    )  # fmt: skip


def test_forms_that_differ_in_their_texts_are_read_together():
    values = noise(40, 6)
    frames = ["", "hand", "a longer frame", "hand"] * 10
    messages = [
        wrench(row, 10**9 * n + n, frame, is_little=n % 3 > 0)
        for n, (row, frame) in enumerate(zip(values, frames, strict=True))
    ]
    found = CdrDecoder(defined(WRENCH), messages[0]).decode(messages)
    np.testing.assert_array_equal(found.values, values)
    assert found.stamps.tolist() == [10**9 * n + n for n in range(40)]


def test_a_message_with_other_channels_is_refused():
    decoder = CdrDecoder(defined(JOINTS), joints(range(4), 5))
    message = STORE.deserialize_cdr(joints(range(4), 5), JOINTS)
    message.velocity = message.velocity[:1]
    with pytest.raises(ValueError, match="3 channels after one with 4"):
        decoder.decode([bytes(STORE.serialize_cdr(message, JOINTS))])


@pytest.mark.parametrize("name", sorted(ARRAYS))
def test_arrays_of_std_msgs_need_no_definition(name):
    dtype = np.dtype(ARRAYS[name])
    values = (noise(6) * 100).astype(dtype)
    message = array(values, kind=name.rpartition("/")[2])
    found = CdrDecoder(definition(name, "", ""), message).decode([message])
    np.testing.assert_array_equal(found.values, values[None].astype(float))
    assert found.values.dtype == (
        np.float32 if dtype.itemsize <= (4 if dtype.kind == "f" else 2) else np.float64
    )


@pytest.mark.parametrize(
    ("labels", "sizes", "wanted"),
    [
        ((), (), lambda v: v.reshape(1, 12)),
        (("rows", "columns"), (3, 4), lambda v: v.reshape(1, 12)),
        (("taxels",), (12,), lambda v: v.reshape(1, 12)),
        (("samples", "channels"), (3, 4), lambda v: v.reshape(3, 4)),
        (("Time", "rows", "columns"), (3, 2, 2), lambda v: v.reshape(3, 4)),
        (("channels", "samples"), (3, 4), lambda v: v.reshape(3, 4).T),
        (("samples",), (12,), lambda v: v.reshape(12, 1)),
    ],
)
def test_the_layout_of_an_array_says_what_an_instant_is(labels, sizes, wanted):
    values = noise(12)
    message = array(values, labels, sizes)
    found = CdrDecoder(definition("std_msgs/msg/Float64MultiArray", "", ""), message)
    np.testing.assert_array_equal(found.decode([message]).values, wanted(values))


@pytest.mark.parametrize(
    ("message", "text"),
    [
        (array(noise(12), ("samples", "channels"), (3, 5)), "12 numbers in a layout of"),
        (array(noise(12), ("a", "time", "b"), (2, 3, 2)), "12 numbers in a layout of"),
        (array(noise(12), skipped=3), "data_offset of 3"),
        (array(noise(0)), "no numbers"),
        (array(noise(MOST_CHANNELS + 1)), f"at most {MOST_CHANNELS}"),
        (array(noise(12)) + bytes(8), "bytes, where"),
        (array(noise(12))[:-1], "too few"),
        (b"", "not the plain CDR"),
        (b"\0\3\0\0" + array(noise(12))[4:], "not the plain CDR"),
    ],
)
def test_arrays_that_cannot_be_samples_are_refused(message, text):
    with pytest.raises(ValueError, match=text):
        form_of(definition("std_msgs/msg/Float64MultiArray", "", ""), message)


def test_a_length_is_held_against_the_message():
    message = bytearray(array(noise(3)))
    message[12:16] = (2**31).to_bytes(4, "little")  # the count of numbers
    with pytest.raises(ValueError, match="too few"):
        form_of(definition("std_msgs/msg/Float64MultiArray", "", ""), bytes(message))
    nothing = Group("a/msg/B", (("many", Many(Group("a/msg/C", ()), 10**12)),))
    with pytest.raises(ValueError, match=r"too few|fields"):
        form_of(nothing, b"\0\1\0\0" + bytes(10**6))
    texts = Group("a/msg/B", (("many", Many(Text(), None)), ("x", Number("f8"))))
    with pytest.raises(ValueError, match="fields"):
        form_of(texts, b"\0\1\0\0" + (10**9).to_bytes(4, "little") + bytes(10**6))


def test_what_ros_brings_does_where_the_text_is_not_read():
    values = noise(6)
    kind = definition(WRENCH, "ros2idl", "module a { const long x = ((1)); };")
    found = CdrDecoder(kind, wrench(values, 5)).decode([wrench(values, 5)])
    np.testing.assert_array_equal(found.values, values[None])


@pytest.mark.parametrize(
    ("encoding", "text", "wanted"),
    [
        ("ros2msg", "test_msgs/A next\nfloat64 x", "holds itself"),
        ("ros2msg", "test_msgs/Nowhere next", "no definition of test_msgs/msg/Nowhere"),
        ("ros2msg", "float64 x y z\n((", "of test_msgs/msg/A is no ros2msg"),
        ("ros2msg", "wstring text", "wstring"),
        ("ros2msg", "float64 x\n" * 50_000, "at most"),
        ("ros2idl", "module a { const long x = ((1)); };", "as ros2msg, and ROS brings none"),
        ("", "", "no definition of test_msgs/msg/A"),
    ],
)
def test_definitions_that_cannot_be_used_are_refused(encoding, text, wanted):
    with pytest.raises(ValueError, match=wanted):
        definition("test_msgs/msg/A", encoding, text)


def test_a_definition_is_never_executed(monkeypatch):
    monkeypatch.setattr(builtins, "exec", lambda *_: pytest.fail("code was executed"))
    monkeypatch.setattr(builtins, "eval", lambda *_: pytest.fail("code was evaluated"))
    text = "float64 x\nstring s \"a'''+__import__('os').abort()+'''\"\n"
    message = b"\0\1\0\0" + np.float64(2.5).tobytes() + b"\2\0\0\0a\0"
    found = CdrDecoder(definition("test_msgs/msg/A", "ros2msg", text), message).decode([message])
    assert found.values.tolist() == [[2.5]]

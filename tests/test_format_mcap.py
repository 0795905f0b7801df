"""MCAP files: ours to the bit and openable by others; others' as they meant them; none trusted."""

import io
import os
import struct
import subprocess
import sys
import tracemalloc
from itertools import pairwise

import lz4.frame
import numpy as np
import pytest
import torch
import zstandard
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from message_bags import (
    START_NS,
    STEP_NS,
    STORE,
    WRENCH,
    How,
    Sent,
    array,
    hand_of,
    json_message,
    noise,
    recording,
    times,
    wrench,
    wrenches,
    write_mcap,
)
from rosbags.highlevel import AnyReader

from tactslip_torch.data.clock import even_clock
from tactslip_torch.data.formats import mcap, mcap_bag, message_samples, reading
from tactslip_torch.data.formats.mcap_records import MAGIC
from tactslip_torch.data.formats.packing import MOST_BYTES
from tactslip_torch.data.formats.reading import Reading, pieces

KEY = {"scene": {"seed": 3}, "list": [1, None]}
FLOATS = "std_msgs/msg/Float64MultiArray"


def same(found, wanted):
    assert found.samples.dtype == wanted.samples.dtype
    assert found.samples.shape == wanted.samples.shape
    assert found.samples.numpy().tobytes() == wanted.samples.numpy().tobytes()
    for name in ("sample_rate_hz", "material", "onsets_s", "annotated_onsets_s", "sliding_s"):
        assert getattr(found, name) == getattr(wanted, name)
    for name in ("non_slip_s", "slip_s", "speeds_mm_s", "units"):
        assert getattr(found, name) == getattr(wanted, name)
    assert dict(found.provenance) == dict(wanted.provenance)


def odd_numbers(dtype):
    """Every pattern of bits that is easily lost: NaNs with a payload, -0.0, the least number."""
    whole, bits = (np.uint32, np.float32) if dtype == torch.float32 else (np.uint64, np.float64)
    top = np.finfo(bits).bits - 1
    patterns = [0, 1 << top, 1, (1 << top) - 1, (1 << top) - 2, 3 << (top - 1)]
    return torch.from_numpy(np.array(patterns, whole).view(bits)).reshape(2, 3)


# ------------------------------------------------------------------------------------- ours
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("num_channels", "num_samples"), [(1, 1), (3, 199), (24, 2001), (2, 0)])
def test_what_goes_in_comes_out(tmp_path, dtype, num_channels, num_samples):
    wanted = recording(torch.from_numpy(noise(num_channels, num_samples)).to(dtype))
    mcap.save(tmp_path / "a.mcap", wanted, hand_of(num_channels), KEY)
    found = mcap.load(tmp_path / "a.mcap")
    same(found.recording, wanted)
    assert found.hand == hand_of(num_channels)
    assert found.key == KEY == mcap.key(tmp_path / "a.mcap")


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("rate_hz", [2.5, 92.3, 2000.0, 1e6 / 3])
def test_odd_numbers_and_rates_come_back_to_the_bit(tmp_path, dtype, rate_hz):
    wanted = recording(odd_numbers(dtype), sample_rate_hz=rate_hz)
    mcap.save(tmp_path / "a.mcap", wanted, hand_of(2), {})
    same(mcap.load(tmp_path / "a.mcap").recording, wanted)


def test_equal_input_gives_equal_bytes(tmp_path):
    for name in ("a.mcap", "b.mcap"):
        mcap.save(tmp_path / name, recording(), hand_of(2), KEY)
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_stretches_are_those_of_the_whole(tmp_path):
    wanted = recording(torch.from_numpy(noise(4, 60_000)))  # several chunks
    mcap.save(tmp_path / "a.mcap", wanted, hand_of(4), KEY)
    with mcap.open(tmp_path / "a.mcap") as opened:
        samples = opened.samples
        assert (samples.num_channels, samples.num_samples) == (4, 60_000)
        assert opened.names == hand_of(4).names
        assert opened.sample_rate_hz == 2000.0
        assert opened.archived.recording.samples.shape == (4, 0)
        torch.testing.assert_close(
            torch.cat(list(pieces(samples, 7777)), 1), wanted.samples, rtol=0, atol=0
        )
        for first, stop in [(0, 1), (199, 201), (59_990, 70_000), (5, 5), (60_000, 60_001)]:
            assert torch.equal(samples.read(first, stop), wanted.samples[:, first:stop])


def test_the_mcap_library_and_rosbags_open_it(tmp_path):
    wanted = recording(torch.from_numpy(noise(5, 1003)).float(), sample_rate_hz=999.0)
    path = tmp_path / "a.mcap"
    mcap.save(path, wanted, hand_of(5), KEY)
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        messages = list(reader.iter_messages())
        assert [m.name for m in reader.iter_metadata()] == ["tactslip_torch recording"]
    blocks, firsts = [], []
    for schema, channel, message in messages:
        assert (schema.name, channel.topic) == ("std_msgs/msg/Float32MultiArray", "/tactile")
        block = STORE.deserialize_cdr(message.data, schema.name)
        rows, columns = block.layout.dim
        assert (rows.label, columns.label, columns.size) == ("samples", "channels", 5)
        assert (rows.stride, columns.stride) == (rows.size * 5, 5)
        firsts.append(message.log_time)
        blocks.append(block.data.reshape(rows.size, columns.size))
    np.testing.assert_array_equal(np.concatenate(blocks).T, wanted.samples.numpy())
    starts = np.cumsum([0, *map(len, blocks)])[:-1]
    np.testing.assert_allclose(firsts, starts / 999.0 * 1e9, rtol=0, atol=0.5)
    with AnyReader([path]) as reader:
        read = [reader.deserialize(raw, c.msgtype).data for c, _, raw in reader.messages()]
    np.testing.assert_array_equal(np.concatenate(read).reshape(-1, 5).T, wanted.samples.numpy())


def test_a_failure_leaves_what_was_there(tmp_path):
    path = tmp_path / "a.mcap"
    mcap.save(path, recording(), hand_of(2), KEY)
    before = path.read_bytes()
    with pytest.raises(ValueError, match="key must be plain JSON"):
        mcap.save(path, recording(), hand_of(2), {"x": object()})
    with pytest.raises(ValueError, match="too long for messages"):
        mcap.save(path, recording(sample_rate_hz=1e-9), hand_of(2), {})
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


# ---------------------------------------------------------------------------------- of others
@pytest.mark.parametrize("packing", ["none", "lz4", "zstd"])
@pytest.mark.parametrize("is_chunked", [True, False])
@pytest.mark.parametrize("is_indexed", [True, False])
def test_stamped_messages_of_ros(tmp_path, packing, is_chunked, is_indexed):
    sent, values = wrenches(500)
    path = write_mcap(tmp_path / "a.mcap", [sent], How(packing, is_chunked, is_indexed))
    with mcap.open(path) as opened:
        np.testing.assert_array_equal(opened.samples.read(0, 500).numpy(), values)
        np.testing.assert_array_equal(opened.samples.read(123, 321).numpy(), values[:, 123:321])
        assert opened.archived is None
        assert opened.names[:2] == ("wrench.force.x", "wrench.force.y")
        wanted = np.arange(500) * STEP_NS / 1e9  # to the bit, though stamps are of 2023
        np.testing.assert_array_equal(opened.times.read(0, 500).numpy(), wanted)
        assert even_clock(opened.times, 500).sample_rate_hz == pytest.approx(2000)


@pytest.mark.parametrize("field", ["timestamp", "header"])
def test_json_messages_with_a_time(tmp_path, field):
    values = noise(50, 3)
    messages = []
    for row, time in zip(values, times(50), strict=True):
        clock = dict(zip(("sec", "nsec"), divmod(time, 10**9), strict=True))
        own = {"header": {"stamp": clock, "frame_id": "hand"}} if field == "header" else {
            "timestamp": clock
        }  # fmt: skip
        content = own | {"v": list(row[:2]), "deep": {"x": row[2], "text": "1.5"}}
        messages.append((7, json_message(content)))
    sent = Sent("/t", "thing", messages, "json", "jsonschema", "{}")
    with mcap.open(write_mcap(tmp_path / "a.mcap", [sent])) as opened:
        assert opened.names == ("v[0]", "v[1]", "deep.x")
        np.testing.assert_array_equal(opened.samples.read(0, 50).numpy(), values.T)
        np.testing.assert_array_equal(
            opened.times.read(0, 50).numpy(), np.arange(50) * STEP_NS / 1e9
        )


@pytest.mark.parametrize(
    ("name", "unit", "scale"), [("t", "s", 1e-9), ("time_us", "s", 1e-3), ("clock", "ns", 1)]
)
def test_a_number_that_is_the_time(tmp_path, name, unit, scale):
    values = noise(50, 2)
    messages = [
        (5, json_message({"a": row[0], name: time * scale if scale < 1 else time, "b": row[1]}))
        for row, time in zip(values, range(0, 50 * STEP_NS, STEP_NS), strict=True)
    ]
    path = write_mcap(tmp_path / "a.mcap", [Sent("/t", "", messages, "json", "")])
    how = Reading(time=name if name == "clock" else "auto", time_unit=unit)
    with mcap.open(path, how) as opened:
        assert opened.names == ("a", "b")
        np.testing.assert_array_equal(opened.samples.read(0, 50).numpy(), values.T)
        np.testing.assert_allclose(
            opened.times.read(0, 50).numpy(), np.arange(50) * STEP_NS / 1e9, rtol=0, atol=1e-12
        )


def test_stamps_of_zero_are_no_stamps(tmp_path):
    values = noise(20, 6)
    messages = [(time, wrench(row, 0)) for time, row in zip(times(20), values, strict=True)]
    path = write_mcap(tmp_path / "a.mcap", [Sent("/ft", WRENCH, messages)])
    with mcap.open(path) as opened:
        assert opened.times.read(0, 20).tolist() == [n * STEP_NS / 1e9 for n in range(20)]


def test_log_times_are_taken_where_asked(tmp_path):
    values = noise(20, 6)
    messages = [(5 * t, wrench(row, t)) for t, row in zip(times(20), values, strict=True)]
    path = write_mcap(tmp_path / "a.mcap", [Sent("/ft", WRENCH, messages)])
    with mcap.open(path, Reading(time="log_time")) as opened:
        assert opened.times.read(0, 20).tolist() == [n * 5 * STEP_NS / 1e9 for n in range(20)]
    with mcap.open(path, Reading(time=None)) as opened:
        assert opened.times is None


def test_channels_are_chosen_by_name_and_number(tmp_path):
    sent, values = wrenches(300)
    path = write_mcap(tmp_path / "a.mcap", [sent])
    with mcap.open(path, Reading(channels=("wrench.torque.z", 0))) as opened:
        assert opened.names == ("wrench.torque.z", "wrench.force.x")
        np.testing.assert_array_equal(opened.samples.read(10, 290).numpy(), values[[5, 0], 10:290])
    with pytest.raises(ValueError, match=r"no column 'nope' that reading\.channels names"):
        mcap.open(path, Reading(channels=("nope",))).__enter__()


def blocks_of(values, lengths, step_ns=STEP_NS):
    """Blocks of samples ``[n, C]`` of these lengths, each logged at its first sample."""
    edges = np.cumsum([0, *lengths])
    return [
        (
            START_NS + int(first) * step_ns,
            array(values[first:stop].reshape(-1), ("samples", "ch"), (stop - first, 3)),
        )
        for first, stop in pairwise(edges)
    ]


def test_blocks_of_any_lengths(tmp_path):
    lengths = np.random.default_rng(2).permutation(np.arange(1, 321))
    values = noise(int(lengths.sum()), 3)
    path = write_mcap(tmp_path / "a.mcap", [Sent("/b", FLOATS, blocks_of(values, lengths))])
    with mcap.open(path) as opened:
        assert opened.names is None
        found = torch.cat(list(pieces(opened.samples, 97)), 1)
        np.testing.assert_array_equal(found.numpy(), values.T)
        at = opened.times.read(0, len(values)).numpy()
        np.testing.assert_allclose(at, np.arange(len(values)) * STEP_NS / 1e9, rtol=0, atol=1e-12)
        np.testing.assert_array_equal(opened.times.read(100, 150).numpy(), at[100:150])


def test_a_lost_block_shows_as_a_gap_of_its_length(tmp_path):
    values = noise(1000, 3)
    messages = blocks_of(values, [20] * 50)
    del messages[17]
    path = write_mcap(tmp_path / "a.mcap", [Sent("/b", FLOATS, messages)])
    with mcap.open(path) as opened:
        clock = even_clock(opened.times, opened.samples.num_samples)
    assert [(gap.start, gap.missing) for gap in clock.gaps] == [(340, 20)]
    assert clock.sample_rate_hz == pytest.approx(2000)


def test_one_block_has_times_only_at_a_stated_rate(tmp_path):
    path = write_mcap(tmp_path / "a.mcap", [Sent("/b", FLOATS, blocks_of(noise(9, 3), [9]))])
    with mcap.open(path) as opened:
        assert opened.times is None
    with mcap.open(path, Reading(sample_rate_hz=100.0)) as opened:
        np.testing.assert_allclose(opened.times.read(0, 9).numpy(), np.arange(9) / 100)


def test_messages_go_by_their_times_wherever_they_are(tmp_path):
    sent, values = wrenches(400)
    order = np.random.default_rng(0).permutation(400)
    sent.messages = [sent.messages[place] for place in order]
    path = write_mcap(tmp_path / "a.mcap", [sent])
    with mcap.open(path) as opened:
        found = torch.cat(list(pieces(opened.samples, 37)), 1)
        np.testing.assert_array_equal(found.numpy(), values)
        assert (opened.times.read(0, 400).diff() > 0).all()


def test_a_message_recorded_twice_is_said(tmp_path):
    sent, values = wrenches(400)
    sent.messages.insert(100, sent.messages[99])
    path = write_mcap(tmp_path / "a.mcap", [sent])
    with mcap.open(path) as opened:
        assert opened.samples.num_samples == 401
        np.testing.assert_array_equal(opened.samples.read(99, 101).numpy(), values[:, [99, 99]])
        with pytest.raises(ValueError, match="remove what is there twice"):
            even_clock(opened.times, 401)


def test_the_topic_is_the_one_named_or_the_only_one(tmp_path):
    left, values = wrenches(30, "/left")
    right, others = wrenches(30, "/right", seed=1)
    log = Sent("/rosout", WRENCH, left.messages)
    text = Sent("/text", "std_msgs/msg/String", [(1, b"\0\1\0\0\2\0\0\0a\0")])
    unread = Sent("/proto", "x.Y", [(1, b"abc")], "protobuf", "protobuf", "")
    path = write_mcap(tmp_path / "a.mcap", [log, text, unread, left, right])
    with pytest.raises(ValueError, match="2 topics may hold samples, /left, /right; say which"):
        mcap.open(path).__enter__()
    for topic, wanted in (("/left", values), ("/right", others)):
        with mcap.open(path, Reading(samples=topic)) as opened:
            np.testing.assert_array_equal(opened.samples.read(0, 30).numpy(), wanted)
    with pytest.raises(ValueError, match="its topics are /left, /proto, /right, /rosout, /text"):
        mcap.open(path, Reading(samples="/no")).__enter__()
    with pytest.raises(ValueError, match="/proto cannot be read as samples: messages in 'protobuf"):
        mcap.open(path, Reading(samples="/proto")).__enter__()
    alone = write_mcap(tmp_path / "b.mcap", [log, text, left])
    with mcap.open(alone) as opened:
        np.testing.assert_array_equal(opened.samples.read(0, 30).numpy(), values)
    none = write_mcap(tmp_path / "c.mcap", [text])
    with pytest.raises(ValueError, match=r"no topic with samples.*no numbers"):
        mcap.open(none).__enter__()


def test_no_more_than_a_few_pages_are_in_memory(tmp_path, monkeypatch):
    sent, values = wrenches(40_000)
    path = write_mcap(tmp_path / "a.mcap", [sent], How(chunk_size=2**16))
    monkeypatch.setattr(message_samples, "_MOST_KEPT", 2**17)
    with mcap.open(path) as opened:
        tracemalloc.start()
        found = [np.array_equal(p.numpy(), values[:, n * 500 : n * 500 + 500])
                 for n, p in enumerate(pieces(opened.samples, 500))]  # fmt: skip
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    assert all(found)
    assert len(found) == 80
    assert peak < values.nbytes / 2


# -------------------------------------------------------------------------------- not trusted
def opening(path, how=Reading()):  # noqa: B008
    """One line of what opening and reading all of it says; ``None`` if it says nothing."""
    try:
        with mcap.open(path, how) as opened:
            for piece in pieces(opened.samples, 10_000):
                assert piece.shape[0] == opened.samples.num_channels
            if opened.times is not None:
                opened.times.read(0, opened.samples.num_samples)
    except ValueError as error:
        return str(error)
    return None


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A file of ours, one of others', packed, and one without checksums, as bytes."""
    folder = tmp_path_factory.mktemp("files")
    mcap.save(folder / "ours.mcap", recording(), hand_of(2), KEY)
    write_mcap(folder / "other.mcap", [wrenches(120)[0]])
    write_mcap(folder / "loose.mcap", [wrenches(20)[0]], How(is_chunked=False, is_indexed=False))
    return {path.stem: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize("name", ["ours", "other", "loose"])
def test_every_cut_is_refused(tmp_path, files, name):
    content, path = files[name], tmp_path / "cut.mcap"
    for size in [*range(0, 200), *range(200, len(content), 131), len(content) - 1]:
        path.write_bytes(content[:size])
        said = opening(path)
        assert said is not None, size
        assert str(path) in said
        assert "\n" not in said
    assert "mcap recover" in said


def test_what_a_crashed_recorder_left_is_refused(tmp_path, files):
    path = tmp_path / "crash.mcap"
    content = files["other"]
    path.write_bytes(content[: content.rindex(b"\x0f" + struct.pack("<QI", 4, 0))])
    assert "ends in the middle" in opening(path)
    path.write_bytes(content[:-30] + MAGIC)
    assert opening(path) is None or "damaged" in opening(path)


@pytest.mark.parametrize("name", ["ours", "other", "loose"])
@settings(max_examples=300, deadline=None, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_no_byte_can_be_changed_to_do_harm(tmp_path, files, name, data):
    content = bytearray(files[name])
    changes = data.draw(
        st.lists(st.tuples(st.integers(0, len(content) - 1), st.integers(0, 255)), max_size=3)
    )
    for place, value in changes:
        content[place] = value
    path = tmp_path / "changed.mcap"
    path.write_bytes(content)
    said = opening(path)
    if said is not None:
        assert str(path) in said
        assert "\n" not in said


@settings(max_examples=200, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.binary(max_size=300))
def test_any_bytes_between_the_magic_do_no_harm(tmp_path, content):
    path = tmp_path / "any.mcap"
    path.write_bytes(MAGIC + content + MAGIC)
    assert opening(path).startswith(str(path))


def test_changed_samples_are_noticed(tmp_path, files):
    content = bytearray(files["ours"])
    place = content.index(recording().samples[:, 700].numpy().tobytes())
    content[place] ^= 1
    path = tmp_path / "a.mcap"
    path.write_bytes(content)
    assert "fails its checksum" in opening(path)
    with pytest.raises(ValueError, match="fails its checksum"):
        mcap.load(path)


def test_a_changed_header_is_noticed(tmp_path, files):
    path = tmp_path / "a.mcap"
    path.write_bytes(
        files["ours"].replace(b'"sample_rate_hz": 2000.0', b'"sample_rate_hz": 2001.0')
    )
    assert "header of the recording fails its checksum" in opening(path)
    with pytest.raises(ValueError, match="checksum"):
        mcap.key(path)


def record(kind, content):
    return struct.pack("<BQ", kind, len(content)) + content


def text(words):
    return struct.pack("<I", len(words)) + words


def chunk(packing, packed, size, checksum=0):
    head = struct.pack("<QQQI", 0, 0, size, checksum)
    return record(6, head + text(packing) + struct.pack("<Q", len(packed)) + packed)


def file_of(*records):
    end = record(15, bytes(4)) + record(2, bytes(20))
    return MAGIC + record(1, text(b"") * 2) + b"".join(records) + end + MAGIC


ZEROS = bytes(2**20)
BOMB = zstandard.compress(bytes(MOST_BYTES // 4))  # claims little, unpacks to much
LZ4_BOMB = lz4.frame.compress(bytes(2**24))


@pytest.mark.parametrize(
    ("content", "wanted"),
    [
        (chunk(b"zstd", BOMB, 100), "100 bytes that unpacks to"),
        (chunk(b"zstd", BOMB, MOST_BYTES + 1), f"unpack to {MOST_BYTES + 1}|at most {MOST_BYTES}"),
        (chunk(b"zstd", BOMB, 2**63), "that unpack to"),
        (chunk(b"lz4", LZ4_BOMB, 100), "bytes in a chunk of 100"),
        (chunk(b"", b"abc", 2**40), "that unpack to"),
        (chunk(b"", b"abc", 4), "3 bytes in a chunk of 4"),
        (chunk(b"zstd", b"abc", 4), "does not unpack"),
        (chunk(b"lz4", b"abc", 4), "0 bytes in a chunk of 4"),
        (chunk(b"lz4", bytes(30), 4), "does not unpack"),
        (chunk(b"bz2", b"abc", 3), "packed by 'bz2'"),
        (chunk(b"", ZEROS, len(ZEROS)), "no topic|damaged"),
        (chunk(b"", record(5, b"abc"), 12), "without a head"),
        (chunk(b"", record(5, bytes(22)), 31), "message of channel 0"),
        (chunk(b"", b"\5" + struct.pack("<Q", 2**62), 9), "larger than its chunk"),
        (chunk(b"", record(4, b"ab"), 11), "shorter than its fields"),
        (chunk(b"", record(4, b"ab"), 11, 1), "fails its checksum"),
        (record(6, b"abc"), "damaged at byte"),
        (b"\5" + struct.pack("<Q", 2**62), "damaged at byte"),
        (record(12, text(b"tactslip_torch recording") + text(text(b"a"))), "shorter than"),
        (b"", "no topic with samples .no messages."),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_files_that_lie_are_one_line_and_little_memory(tmp_path, content, wanted):
    path = tmp_path / "lie.mcap"
    path.write_bytes(file_of(content))
    tracemalloc.start()
    with pytest.raises(ValueError, match=wanted) as caught:
        mcap.open(path).__enter__()
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)
    assert peak < 2**24 + 8 * len(content)


def test_a_file_may_not_unpack_to_very_much_more_than_its_size(tmp_path, monkeypatch):
    monkeypatch.setattr(mcap_bag, "MOST_BYTES", 2**20)
    packed = zstandard.compress(ZEROS)
    path = tmp_path / "many.mcap"
    path.write_bytes(file_of(*[chunk(b"zstd", packed, len(ZEROS))] * 50))
    assert "more than 100 times" in opening(path)


@pytest.mark.parametrize("begin", [b"", MAGIC, MAGIC + record(1, text(b"") * 2)])
def test_ten_gigabytes_of_nothing_take_no_time(tmp_path, begin):
    path = tmp_path / "sparse.mcap"
    with path.open("wb") as file:
        file.write(begin)
        file.truncate(10 * 2**30)
        file.seek(-len(MAGIC), io.SEEK_END)
        file.write(MAGIC)
    assert "MCAP" in opening(path) or "damaged at byte" in opening(path)


def nested(depth):
    return b'{"a":' * depth + b"1" + b"}" * depth


@pytest.mark.parametrize(
    ("messages", "wanted"),
    [
        ([nested(10**5)], "no JSON|deeper"),
        ([nested(20)], "deeper than"),
        ([b'{"a": 1', b'{"a": 1}'], "no JSON"),
        ([b'{"a": 1}', b"\xff\xfe"], "no JSON"),
        ([b'{"a": 1}', b'{"b": 1}'], "without 'a'"),
        ([b'{"a": 1}', b'{"a": [1, 2]}'], "2 channels after one with 1"),
        ([b'{"a": ' + b"9" * 400 + b"}"], "too large"),
        ([b'{"a": ' + b"9" * 10**5 + b"}"], "no JSON"),
        ([b'{"a": "1"}'], "0 numbers"),
        ([b'{"a.b": 1, "a": {"b": 2}}'], "two numbers called a.b"),
        ([b'"text"'], "0 numbers"),
        ([b"[" + b"1," * 5000 + b"1]"], "5001 numbers"),
        ([b'{"t": {"sec": 1e300, "nsec": 5}, "time": 1e999, "a": 1}'] * 2, "time that is no"),
        ([b'{"time": 0, "a": 1}', b'{"time": 1e30, "a": 1}'], "apart; see reading.time_unit"),
        ([b'{"time": true, "a": 1}', b'{"time": true, "a": 1}'], "time that is no"),
    ],
)
def test_json_that_cannot_be_samples_is_one_line(tmp_path, messages, wanted):
    sent = Sent("/t", "", [(n, m) for n, m in enumerate(messages)], "json", "")
    path = write_mcap(tmp_path / "a.mcap", [sent])
    with pytest.raises(ValueError, match=wanted) as caught:
        mcap.open(path).__enter__()
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_null_is_nan(tmp_path):
    messages = [(0, b'{"a": null, "b": 2}'), (1, b'{"b": NaN, "a": -0.0}')]
    path = write_mcap(tmp_path / "a.mcap", [Sent("/t", "", messages, "json", "")])
    with mcap.open(path) as opened:
        np.testing.assert_array_equal(
            opened.samples.read(0, 2).numpy(), [[np.nan, -0.0], [2, np.nan]]
        )


def test_a_file_that_is_cut_while_it_is_read_is_said(tmp_path, monkeypatch):
    monkeypatch.setattr(message_samples, "_MOST_KEPT", 1)
    path = write_mcap(tmp_path / "a.mcap", [wrenches(2000)[0]])
    with mcap.open(path) as opened:
        os.truncate(path, path.stat().st_size // 2)
        with pytest.raises(ValueError, match="was cut while it was read"):
            opened.samples.read(1000, 2000)


def test_nothing_there_and_nothing_of_ours(tmp_path):
    for act in (mcap.load, mcap.key, lambda path: mcap.open(path).__enter__()):
        with pytest.raises(FileNotFoundError, match=r"no file at .*nope\.mcap"):
            act(tmp_path / "nope.mcap")
        with pytest.raises(FileNotFoundError, match="no file at"):
            act(tmp_path)
    other = write_mcap(tmp_path / "other.mcap", [wrenches(10)[0]])
    for act in (mcap.load, mcap.key):
        with pytest.raises(ValueError, match="no recording of ours"):
            act(other)


def test_an_error_of_the_reader_is_its_own(tmp_path):
    mcap.save(tmp_path / "a.mcap", recording(), hand_of(2), KEY)
    with pytest.raises(ZeroDivisionError), mcap.open(tmp_path / "a.mcap"):
        _ = 1 / 0


# ---------------------------------------------------------------------------------- libraries
@pytest.mark.parametrize(
    ("absent", "act", "wanted"),
    [
        ("mcap", lambda path: mcap.save(path, recording(), hand_of(2), {}), "writing .mcap needs"),
        ("rosbags", lambda path: mcap.open(path).__enter__(), "WrenchStamped needs rosbags"),
        ("zstandard", lambda path: mcap.open(path).__enter__(), "packed by zstd needs zstandard"),
    ],
)
def test_an_absent_library_is_one_line_with_its_remedy(tmp_path, monkeypatch, absent, act, wanted):
    path = write_mcap(tmp_path / "a.mcap", [wrenches(10)[0]])
    found = reading.find_spec
    monkeypatch.setattr(reading, "find_spec", lambda n: None if n == absent else found(n))
    with pytest.raises(ValueError, match=wanted) as caught:
        act(path)
    assert 'pip install "tactslip_torch[formats]"' in str(caught.value)
    assert "\n" not in str(caught.value)


def test_libraries_are_imported_when_they_are_needed():
    code = (
        "import sys; from tactslip_torch.data.formats import mcap, rosbag2; "
        "print([n for n in ('mcap', 'rosbags', 'zstandard', 'lz4', 'yaml') if n in sys.modules])"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"

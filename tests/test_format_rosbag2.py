"""Folders of rosbag2: ours to the bit and openable by rosbags; others' as meant; none trusted."""

import os
import shutil
import sqlite3
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from message_bags import (
    JOINTS,
    STEP_NS,
    Sent,
    array,
    hand_of,
    joints,
    noise,
    recording,
    times,
    wrenches,
    write_bag,
)
from rosbags.highlevel import AnyReader

from tactslip_torch.data.formats import bag_metadata, message_samples, reading, rosbag2, sqlite_bag
from tactslip_torch.data.formats.reading import Reading, pieces

KEY = {"scene": {"seed": 3}, "list": [1, None]}


def same(found, wanted):
    assert found.samples.dtype == wanted.samples.dtype
    assert found.samples.shape == wanted.samples.shape
    assert found.samples.numpy().tobytes() == wanted.samples.numpy().tobytes()
    for name in ("sample_rate_hz", "material", "onsets_s", "sliding_s", "slip_s", "units"):
        assert getattr(found, name) == getattr(wanted, name)
    assert dict(found.provenance) == dict(wanted.provenance)


# ------------------------------------------------------------------------------------- ours
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("num_channels", "num_samples"), [(1, 1), (24, 2001), (2, 0)])
def test_what_goes_in_comes_out(tmp_path, dtype, num_channels, num_samples):
    samples = torch.from_numpy(noise(num_channels, num_samples)).to(dtype)
    samples[:, ::7] = torch.nan
    samples[:, ::5] = -0.0
    wanted, path = recording(samples), tmp_path / "bag"
    rosbag2.save(path, wanted, hand_of(num_channels), KEY)
    found = rosbag2.load(path)
    same(found.recording, wanted)
    assert found.hand == hand_of(num_channels)
    assert found.key == KEY == rosbag2.key(path)
    with rosbag2.open(path) as opened:
        assert opened.names == hand_of(num_channels).names
        assert opened.archived.key == KEY
        parts = [samples[:, :0], *pieces(opened.samples, 333)]
        assert torch.cat(parts, 1).numpy().tobytes() == samples.numpy().tobytes()


@settings(max_examples=15, deadline=None, suppress_health_check=list(HealthCheck))
@given(words=st.text(max_size=40))
def test_no_words_are_lost_in_the_metadata(tmp_path, words):
    wanted = recording(provenance={"note": words}, material=words or "x")
    rosbag2.save(tmp_path / "bag", wanted, hand_of(2), {"words": [words]})
    same(rosbag2.load(tmp_path / "bag").recording, wanted)
    assert rosbag2.key(tmp_path / "bag") == {"words": [words]}


def test_words_at_every_place_of_a_line_of_yaml(tmp_path):
    words = ["x" * n + "a\nb: '\\ \"" for n in range(90)]  # YAML writers break lines between them
    rosbag2.save(tmp_path / "bag", recording(), hand_of(2), {"words": words})
    assert rosbag2.key(tmp_path / "bag") == {"words": words}


def test_equal_input_gives_equal_bytes(tmp_path):
    for parent in ("a", "b"):
        rosbag2.save(tmp_path / parent / "bag", recording(), hand_of(2), KEY)
    for name in ("recording.db3", "metadata.yaml"):
        one, other = ((tmp_path / parent / "bag" / name).read_bytes() for parent in ("a", "b"))
        assert one == other


def test_rosbags_opens_it(tmp_path):
    wanted = recording(torch.from_numpy(noise(5, 1003)))
    rosbag2.save(tmp_path / "bag", wanted, hand_of(5), KEY)
    with AnyReader([tmp_path / "bag"]) as reader:
        read = [(t, reader.deserialize(raw, c.msgtype)) for c, t, raw in reader.messages()]
        assert {c.topic for c in reader.connections} == {"/tactile"}
    blocks = [message.data.reshape(-1, 5) for _, message in read]
    np.testing.assert_array_equal(np.concatenate(blocks).T, wanted.samples.numpy())
    assert {b - a for (a, _), (b, _) in pairwise(read)} == {200 * STEP_NS}


def test_a_bag_is_replaced_and_nothing_else_is(tmp_path):
    path = tmp_path / "bag #1?%41 ü.bag2"
    rosbag2.save(path, recording(), hand_of(2), {"n": 1})
    rosbag2.save(path, recording(), hand_of(2), {"n": 2})
    assert rosbag2.key(path) == {"n": 2}
    with pytest.raises(ValueError, match="plain JSON"):
        rosbag2.save(path, recording(), hand_of(2), {"n": object()})
    with pytest.raises(ValueError, match="too long for messages"):
        rosbag2.save(path, recording(sample_rate_hz=1e-9), hand_of(2), {})
    assert rosbag2.key(path) == {"n": 2}
    assert list(tmp_path.iterdir()) == [path]
    for other in (tmp_path / "home", tmp_path / "file", tmp_path / "link"):
        if other.name == "home":
            other.mkdir()
            (other / "thesis.tex").write_text("years of work")
        elif other.name == "file":
            other.write_text("a file")
        else:
            other.symlink_to(path)
        with pytest.raises(ValueError, match=r"is there and no folder of rosbag2; give another"):
            rosbag2.save(other, recording(), hand_of(2), {})
    assert (tmp_path / "home" / "thesis.tex").read_text() == "years of work"


# ---------------------------------------------------------------------------------- of others
@pytest.mark.parametrize(
    ("storage", "mode"),
    [("sqlite3", "none"), ("sqlite3", "message"), ("mcap", "none"), ("mcap", "storage")],
)
def test_stamped_messages_of_ros(tmp_path, storage, mode):
    sent, values = wrenches(500)
    other = Sent("/rosout", JOINTS, [(5, joints(range(4), 5))])
    path = write_bag(tmp_path / "bag", [other, sent], storage, mode)
    with rosbag2.open(path) as opened:
        assert opened.archived is None
        assert opened.names[0] == "wrench.force.x"
        np.testing.assert_array_equal(opened.samples.read(0, 500).numpy(), values)
        np.testing.assert_array_equal(opened.samples.read(7, 70).numpy(), values[:, 7:70])
        wanted = np.arange(500) * STEP_NS / 1e9
        np.testing.assert_array_equal(opened.times.read(0, 500).numpy(), wanted)


def test_messages_go_by_their_times_and_by_page(tmp_path, monkeypatch):
    monkeypatch.setattr(sqlite_bag, "_PAGE", 1000)
    monkeypatch.setattr(message_samples, "_MOST_KEPT", 1)
    sent, values = wrenches(300)
    sent.messages = [sent.messages[n] for n in np.random.default_rng(0).permutation(300)]
    with rosbag2.open(write_bag(tmp_path / "bag", [sent])) as opened:
        found = torch.cat(list(pieces(opened.samples, 41)), 1)
    np.testing.assert_array_equal(found.numpy(), values)


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
def test_what_is_split_over_files_is_one_recording(tmp_path, storage):
    sent, values = wrenches(300)
    ending = {"sqlite3": "db3", "mcap": "mcap"}[storage]
    for number in (0, 1):
        part = Sent(sent.topic, sent.kind, sent.messages[150 * number : 150 * number + 150])
        write_bag(tmp_path / f"part{number}", [part], storage)
    bag = tmp_path / "part0"
    shutil.copy(tmp_path / "part1" / f"part1.{ending}", bag)
    change(bag, relative_file_paths=[f"part1.{ending}", f"part0.{ending}"])
    with rosbag2.open(bag) as opened:
        np.testing.assert_array_equal(opened.samples.read(0, 300).numpy(), values)


def test_an_old_bag_without_definitions_is_read_by_those_of_ros(tmp_path):
    sent, values = wrenches(30)
    path = write_bag(tmp_path / "bag", [sent])
    with sqlite3.connect(path / "bag.db3") as database:
        database.execute("DROP TABLE message_definitions")
    change(path, relative_file_paths=["bag/bag.db3"], version=3)  # the folder's name before it
    with rosbag2.open(path) as opened:
        np.testing.assert_array_equal(opened.samples.read(0, 30).numpy(), values)


def test_a_topic_is_chosen_as_in_mcap(tmp_path):
    left, values = wrenches(30, "/left")
    right, _ = wrenches(30, "/right", seed=1)
    path = write_bag(tmp_path / "bag", [left, right])
    with pytest.raises(ValueError, match="2 topics may hold samples, /left, /right; say which"):
        rosbag2.open(path).__enter__()
    with pytest.raises(ValueError, match="its topics are /left, /right"):
        rosbag2.open(path, Reading(samples="/middle")).__enter__()
    with rosbag2.open(path, Reading(samples="/left", channels=(5,))) as opened:
        np.testing.assert_array_equal(opened.samples.read(0, 30).numpy(), values[5:])


def test_our_topic_among_others_of_a_bag_that_is_not_ours(tmp_path):
    blocks = noise(60, 3)
    messages = [
        (time, array(block.reshape(-1), ("samples", "channels"), (20, 3)))
        for time, block in zip(times(60)[::20], blocks.reshape(3, 20, 3), strict=True)
    ]
    path = write_bag(
        tmp_path / "bag", [Sent("/tactile", "std_msgs/msg/Float64MultiArray", messages)]
    )
    with rosbag2.open(path) as opened:
        assert opened.archived is None
        np.testing.assert_array_equal(opened.samples.read(0, 60).numpy(), blocks.T)
        np.testing.assert_allclose(
            opened.times.read(0, 60).numpy(), np.arange(60) * STEP_NS / 1e9, rtol=0, atol=1e-12
        )


# -------------------------------------------------------------------------------- not trusted
def change(path: Path, **facts) -> None:
    """Say other things of a bag in its metadata."""
    metadata = path / "metadata.yaml"
    content = yaml.safe_load(metadata.read_text())
    content["rosbag2_bagfile_information"] |= facts
    metadata.write_text(yaml.safe_dump(content))


def said(path, how=Reading()):  # noqa: B008
    """One line of what opening and reading all of a bag says; ``None`` if it says nothing."""
    try:
        with rosbag2.open(path, how) as opened:
            for piece in pieces(opened.samples, 10_000):
                assert piece.shape[0] == opened.samples.num_channels
    except (ValueError, FileNotFoundError) as error:
        return str(error)
    return None


@pytest.fixture
def bag(tmp_path):
    return write_bag(tmp_path / "bag", [wrenches(60)[0]])


@pytest.mark.parametrize(
    ("name", "wanted"),
    [
        ("../outside.db3", "not in the folder"),
        ("inner/../../outside.db3", "not in the folder"),
        ("inner/../bag.db3", "not in the folder"),
        ("link.db3", "not in the folder"),
        ("{root}/outside.db3", "not in the folder"),
        ("{root}/bag/bag.db3", "not in the folder"),
        ("other.db3", "not there"),
        ("pipe.db3", "not there"),
        (".", "not there"),
        ("bag.db3\0", "not there|null"),
        (5, "without relative_file_paths"),
    ],
)
def test_files_of_a_bag_are_in_its_folder(tmp_path, bag, name, wanted):
    shutil.copy(bag / "bag.db3", tmp_path / "outside.db3")
    (bag / "inner").mkdir()
    (bag / "link.db3").symlink_to(tmp_path / "outside.db3")
    os.mkfifo(bag / "pipe.db3")
    name = name.format(root=tmp_path) if isinstance(name, str) else name
    change(bag, relative_file_paths=[name])
    with pytest.raises(ValueError, match=wanted) as caught:
        rosbag2.open(bag).__enter__()
    assert str(caught.value).startswith(f"{bag}: ")
    assert "\n" not in str(caught.value)


def test_metadata_that_lie_elsewhere_are_refused(tmp_path, bag):
    shutil.move(bag / "metadata.yaml", tmp_path / "metadata.yaml")
    (bag / "metadata.yaml").symlink_to(tmp_path / "metadata.yaml")
    assert "not in the folder" in said(bag)


DEEP = "a: " + "[" * 100_000
LAUGHS = "a0: &a0 {x: 1}\n" + "".join(
    f"a{n}: &a{n}\n  <<: [{', '.join([f'*a{n - 1}'] * 9)}]\n" for n in range(1, 30)
)


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        (b"", "without rosbag2_bagfile_information"),
        (b"rosbag2_bagfile_information: 5", "without rosbag2_bagfile_information"),
        (b"rosbag2_bagfile_information: {}", "storage None; sqlite3 and mcap are read"),
        (b"rosbag2_bagfile_information: {storage_identifier: [1]}", "storage"),
        (b"rosbag2_bagfile_information: {storage_identifier: mcap}", "relative_file_paths"),
        (b"a: !!python/object/apply:os.abort []", "is no YAML"),
        (b"a: [", "is no YAML"),
        (b"\xff\xfe\xfa", "is no YAML"),
        (b"a: \x07", "is no YAML"),
        (DEEP.encode(), "too deep or too long"),
        (LAUGHS.encode(), "too deep or too long"),
        (b"a: [" + b"1," * 300_000 + b"]", "too deep or too long"),
    ],
    ids=range(12),
)
def test_metadata_that_are_none_are_one_line(bag, text, wanted):
    (bag / "metadata.yaml").write_bytes(text)
    with pytest.raises(ValueError, match=wanted) as caught:
        rosbag2.open(bag).__enter__()
    assert str(caught.value).startswith(f"{bag}: ")
    assert "\n" not in str(caught.value)


def test_huge_metadata_are_not_read(bag):
    os.truncate(bag / "metadata.yaml", 10 * 2**30)
    assert f"at most {bag_metadata._MOST_BYTES} are read" in said(bag)


@pytest.mark.parametrize(
    ("facts", "wanted"),
    [
        ({"storage_identifier": "rocksdb"}, "storage 'rocksdb'; sqlite3 and mcap are read"),
        ({"compression_mode": "FILE", "compression_format": "zstd"}, "ros2 bag convert"),
        ({"compression_mode": "MESSAGE", "compression_format": "lz4"}, "packed by message with"),
        ({"compression_mode": "MESSAGE", "compression_format": "zstd"}, "does not unpack"),
        ({"storage_identifier": "mcap"}, "no MCAP file"),
        ({"relative_file_paths": []}, "no topic with samples .no messages."),
    ],
)
def test_a_bag_that_says_what_is_not_read_is_one_line(bag, facts, wanted):
    change(bag, **facts)
    with pytest.raises(ValueError, match=wanted):
        rosbag2.open(bag).__enter__()


def statements(*lines):
    def run(path):
        with sqlite3.connect(path) as database:
            for line in lines:
                database.execute(line)

    return run


ENDLESS = (
    "CREATE VIEW messages AS WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM n) "
    "SELECT id, 1 AS topic_id, id AS timestamp, zeroblob(9) AS data FROM n"
)


@pytest.mark.parametrize(
    ("act", "wanted"),
    [
        (lambda path: path.write_bytes(b""), "no table topics"),
        (lambda path: path.write_bytes(b"SQLite"), "no database"),
        (lambda path: path.write_bytes(bytes(10**5)), "no database"),
        (lambda path: os.truncate(path, 8192), "damaged"),
        (statements("DROP TABLE messages"), "no table messages"),
        (statements("ALTER TABLE messages RENAME data TO content"), "no table messages with data"),
        (statements("DROP TABLE messages", ENDLESS), "no table messages"),
        (
            statements(
                "DROP TABLE messages",
                "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, "
                "data AS (zeroblob(1000000000)))",
                "INSERT INTO messages(topic_id, timestamp) VALUES (1, 1)",
            ),
            "no table messages with data",
        ),
        (statements("UPDATE messages SET timestamp = 'soon' WHERE id = 7"), "without a time"),
        (statements("UPDATE messages SET data = 'text' WHERE id = 7"), "not bytes"),
        (statements("UPDATE messages SET data = 7 WHERE id = 7"), "not bytes"),
        (statements("UPDATE messages SET data = zeroblob(9) WHERE id = 7"), "too few"),
        (statements("UPDATE messages SET data = x'' WHERE id = 1"), "not the plain CDR"),
        (
            statements(
                "CREATE TABLE other AS SELECT NULL AS id, topic_id, timestamp, data FROM messages",
                "DROP TABLE messages",
                "ALTER TABLE other RENAME TO messages",
            ),
            "no topic with samples .no messages.",
        ),
        (statements("DELETE FROM messages"), "no topic with samples .no messages."),
        (statements("UPDATE topics SET type = 'a/msg/B'"), "no topic with samples"),
        (statements("UPDATE topics SET serialization_format = 'x'"), "messages in 'x'"),
        (
            statements("UPDATE message_definitions SET encoded_message_definition = '(('"),
            "is no ros2msg",
        ),
    ],
    ids=range(18),
)
def test_a_database_that_is_none_is_one_line(bag, act, wanted):
    act(bag / "bag.db3")
    with pytest.raises(ValueError, match=wanted) as caught:
        rosbag2.open(bag).__enter__()
    assert str(caught.value).startswith(f"{bag}: ")
    assert "\n" not in str(caught.value)


def test_a_bag_that_was_not_closed_is_said(bag):
    (bag / "bag.db3-wal").write_bytes(b"what the recorder did not put into its place")
    assert "was not closed" in said(bag)


def test_a_file_may_end_in_gigabytes_of_nothing(bag):
    os.truncate(bag / "bag.db3", 10 * 2**30)
    with rosbag2.open(bag) as opened:
        np.testing.assert_array_equal(opened.samples.read(0, 60).numpy(), wrenches(60)[1])


def test_reading_leaves_a_bag_as_it_was(bag):
    before = {path.name: path.read_bytes() for path in bag.iterdir()}
    assert said(bag) is None
    assert {path.name: path.read_bytes() for path in bag.iterdir()} == before


@pytest.fixture(scope="module")
def contents(tmp_path_factory):
    """A bag of ours and one of others', file by file."""
    folder = tmp_path_factory.mktemp("bags")
    rosbag2.save(folder / "ours", recording(), hand_of(2), KEY)
    write_bag(folder / "other", [wrenches(60)[0]])
    return {
        bag.name: {path.name: path.read_bytes() for path in bag.iterdir()}
        for bag in folder.iterdir()
    }


@pytest.mark.parametrize("name", ["ours", "other"])
@settings(max_examples=200, deadline=None, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_no_byte_can_be_changed_to_do_harm(tmp_path, contents, name, data):
    bag = tmp_path / name
    bag.mkdir(exist_ok=True)
    chosen = data.draw(st.sampled_from(sorted(contents[name])))
    for file, content in contents[name].items():
        changed = bytearray(content)
        if file == chosen:
            places = st.integers(0, len(content) - 1)
            for place, value in data.draw(st.lists(st.tuples(places, st.integers(0, 255)))):
                changed[place] = value
            changed = changed[: data.draw(st.just(len(content)) | places)]
        (bag / file).write_bytes(changed)
    found = said(bag)
    if found is not None:
        assert str(bag) in found
        assert "\n" not in found
    elif name == "ours":
        with rosbag2.open(bag) as opened:
            found = opened.samples.read(0, 2000).numpy().tobytes()
        assert found == recording().samples.numpy().tobytes()


def test_nothing_there_and_nothing_of_ours(tmp_path, bag):
    (tmp_path / "empty").mkdir()
    for act in (rosbag2.load, rosbag2.key, lambda path: rosbag2.open(path).__enter__()):
        with pytest.raises(FileNotFoundError, match=r"no folder at .*nope"):
            act(tmp_path / "nope")
        with pytest.raises(FileNotFoundError, match=r"no metadata\.yaml in .*empty"):
            act(tmp_path / "empty")
    for act in (rosbag2.load, rosbag2.key):
        with pytest.raises(ValueError, match="no recording of ours"):
            act(bag)


@pytest.mark.parametrize(
    "act",
    [
        lambda bag: rosbag2.save(bag.parent / "new", recording(), hand_of(2), {}),
        lambda bag: rosbag2.open(bag).__enter__(),
    ],
    ids=["save", "open"],
)
def test_an_absent_library_is_one_line_with_its_remedy(bag, monkeypatch, act):
    found = reading.find_spec
    monkeypatch.setattr(reading, "find_spec", lambda n: None if n == "rosbags" else found(n))
    with pytest.raises(ValueError, match=r"needs rosbags, which is not installed") as caught:
        act(bag)
    assert 'pip install "tactslip_torch[formats]"' in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not (bag.parent / "new").exists()

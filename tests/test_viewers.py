"""What ``detect`` and ``stream`` leave for viewers: read back by the viewers' own libraries."""

import json
from contextlib import suppress

import numpy as np
import pytest
import torch
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from small_detector import HAND
from test_detect import RATE_HZ, SETTINGS, detected, model, recording, rows_of, save  # noqa: F401

from tactslip_torch.data.formats import FORMATS, Reading, open_file
from tactslip_torch.live import Block
from tactslip_torch.live.mcap_log import McapLog


@pytest.fixture(scope="module")
def run(model, tmp_path_factory):  # noqa: F811
    """A recording with slip, and everything ``detect`` says of it."""
    place = tmp_path_factory.mktemp("viewers")
    save(place / "a.npz", recording())
    options = ("mcap=true", "decisions=true", "figure=none")
    return place, detected(model, place / "a.npz", place / "out", *options)


def messages_of(path):
    """Topic: times in seconds and messages, by rosbags and the definitions in the file alone."""
    found, types = {}, get_typestore(Stores.EMPTY)
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            if schema.name not in types.types:
                types.register(get_types_from_msg(schema.data.decode(), schema.name))
            content = types.deserialize_cdr(message.data, schema.name)
            found.setdefault(channel.topic, []).append((message.log_time / 1e9, content))
    return found


def test_samples_decisions_alarms_and_truth_are_read_back(run):
    place, content = run
    known = FORMATS["npz"].load(place / "a.npz").recording
    again = FORMATS["mcap"].load(place / "out" / "a.mcap")
    assert again.hand == HAND
    assert again.recording.samples.equal(known.samples)
    assert again.recording.sliding_s == known.sliding_s
    found = messages_of(place / "out" / "a.mcap")
    rows = np.array([message.data for _, message in found["/tactile"]])
    np.testing.assert_array_equal(rows.T, known.samples)
    times = np.array([time for time, _ in found["/tactile"]])
    np.testing.assert_allclose(times, np.arange(len(rows)) / RATE_HZ, atol=1e-9)
    decided = rows_of(place / "out" / "a_decisions.csv")
    columns = {"probability": "probability", "valid": "is_valid", "alarm": "is_on"}
    for topic, column in columns.items():
        said = [message.data for _, message in found[f"/slip/{topic}"]]
        wanted = [row[column] for row in decided]
        assert [str(value) for value in said] == wanted
    (entry,) = content["recordings"]
    alarms = [(alarm["alarm_s"], alarm["onset_s"]) for alarm in entry["alarms"]]
    told = [(time, m.time_ref.sec + m.time_ref.nanosec / 1e9) for time, m in found["/slip/onset"]]
    np.testing.assert_allclose(told, alarms, atol=1e-8)
    assert len(found["/slip/events"]) == len(alarms) > 0
    truth = [(time, message.data) for time, message in found["/slip/truth"]]
    assert truth == [(0, False), (2, True), (3, False), (5, True), (5.6, False)]


def test_the_layout_draws_what_is_in_the_file(run):
    place, _ = run
    layout = json.loads((place / "out" / "a.foxglove.json").read_text())

    def leaves(node):
        return [node] if isinstance(node, str) else leaves(node["first"]) + leaves(node["second"])

    panels = layout["configById"]
    assert sorted(leaves(layout["layout"])) == sorted(panels)
    found = messages_of(place / "out" / "a.mcap")
    drawn = []
    for panel in panels.values():
        for path in panel.get("paths", []):
            topic, _, field = path["value"].partition(".data")
            if not topic.startswith("/"):
                assert float(path["value"]) == SETTINGS.threshold  # a number is a line
                continue
            data = found[topic][0][1].data
            drawn.append(path["label"])
            assert np.isscalar(data[int(field.strip("[]"))] if field else data)
    assert set(HAND.names) < set(drawn)


def logged(path, blocks, **options):
    log = McapLog(path, HAND, RATE_HZ, SETTINGS, dtype=torch.float64, **options)
    first = 0
    for dropped, block in blocks:
        log.samples(first := first + dropped, block)
        first += len(block.samples)
    return log


def test_dropped_samples_and_times_of_a_sender_show(tmp_path):
    rows = np.random.default_rng(0).standard_normal((600, 4))
    times = 1e9 + np.arange(600) / RATE_HZ + np.repeat([0.0, 0.25], 300)
    dropped = [(0, Block(rows[:300])), (500, Block(rows[300:]))]
    timed = [(0, Block(rows[:300], times[:300])), (0, Block(rows[300:], times[300:]))]
    for name, blocks in (("dropped", dropped), ("timed", timed)):
        path = tmp_path / f"{name}.mcap"
        logged(path, blocks).close()
        with open_file(path, Reading(samples="/tactile")) as opened:
            assert opened.archived is None  # no even recording of ours
            np.testing.assert_array_equal(opened.samples.read(0, 600).T, rows)
            np.testing.assert_allclose(opened.times(), times - times[0], atol=1e-6)


def test_a_killed_stream_leaves_all_but_the_last_chunk(tmp_path):
    rows = np.random.default_rng(0).standard_normal((8000, 4))
    log = logged(tmp_path / "a.mcap", [(0, Block(rows))])
    (left,) = tmp_path.glob(".a.*.mcap")
    assert not (tmp_path / "a.mcap").exists()
    found = []
    with left.open("rb") as file, suppress(EndOfFile):
        for record in StreamReader(file).records:
            if isinstance(record, Message):
                found.append(np.frombuffer(record.data[-32:]))
    assert 4000 < len(found) < 8000
    np.testing.assert_array_equal(found, rows[: len(found)])
    log.close()
    assert FORMATS["mcap"].load(tmp_path / "a.mcap").recording.samples.shape == (4, 8000)
    assert not list(tmp_path.glob(".a.*"))

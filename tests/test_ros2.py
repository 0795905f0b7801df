"""The bridge to ROS 2 on recorded bags: what is pretended is ``rclpy``, which carries messages."""

import sys
from collections import deque
from importlib.machinery import ModuleSpec
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch
from message_bags import STORE, WRENCH, Sent, array, wrench, write_bag
from rosbags.rosbag2 import Reader
from test_detect import RATE_HZ, SETTINGS, detected, model, rows_of, volts  # noqa: F401

from tactslip_torch import SlipDetector, StreamingDetector
from tactslip_torch.data.formats import Reading
from tactslip_torch.data.formats._messages import Topic
from tactslip_torch.live import Block
from tactslip_torch.live.ros2 import RosTopic, TopicMessages, decision_messages

START_NS = 1_700_000_000_123_456_789
FORCES = ("wrench.force.x", "wrench.force.y", "wrench.force.z", "wrench.torque.x")
ARRAY = "std_msgs/msg/Float64MultiArray"
STATE, ONSET = "geometry_msgs/msg/Vector3Stamped", "sensor_msgs/msg/TimeReference"


def bag(path, kind):
    """Four channels: wrenches with jitter and a gap in their stamps, or blocks of an array."""
    samples = volts(2.4, ((1.2, 1.8),)).double().numpy().T
    at = np.arange(len(samples)) * (1e9 / RATE_HZ)
    if kind == "array":
        blocks = samples.reshape(-1, 20, 4)
        logged = (START_NS + at[::20].astype(np.int64)).tolist()
        content = [array(block.ravel(), ("samples", "channels"), block.shape) for block in blocks]
        sent = Sent("/tactile", ARRAY, list(zip(logged, content, strict=True)))
        return write_bag(path, [sent]), {"samples": "/tactile"}
    jitter = np.random.default_rng(0).uniform(-5e4, 5e4, len(at))
    stamps = (START_NS + (at + jitter).astype(np.int64)).tolist()
    rows = np.pad(samples, ((0, 0), (0, 2)))
    messages = [(at + 10**6, wrench(row, at)) for at, row in zip(stamps, rows, strict=True)]
    del messages[1000:1020]
    sent = Sent("/tactile", WRENCH, messages)
    return write_bag(path, [sent]), {"samples": "/tactile", "channels": FORCES}


def made(kind):
    """An empty message, as classes of rclpy make them."""
    of = STORE.types
    time = of["builtin_interfaces/msg/Time"]
    header = of["std_msgs/msg/Header"](time(0, 0), "")
    if kind == STATE:
        return of[STATE](header, of["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0))
    assert kind == ONSET
    return of[ONSET](header, time(0, 0), "")


@pytest.fixture
def ros(monkeypatch):
    """A pretended ``rclpy``: ``messages`` come, what is published is in ``published``."""
    world = SimpleNamespace(messages=deque(), published={}, kind=None, on_end=None, take=None)
    rclpy = MagicMock()
    rclpy.__spec__ = ModuleSpec("rclpy", None)

    def subscribe(kind, topic, callback, profile, *, raw):
        assert (topic, raw) == ("/tactile", True)
        world.take = callback

    def publisher(kind, topic, depth):
        def publish(message):
            content = STORE.serialize_cdr(message, message.__msgtype__)
            world.published.setdefault(topic, []).append(content)

        return SimpleNamespace(publish=publish)

    def spin_once(timeout_sec):
        if world.take is not None and world.messages:
            world.take(world.messages.popleft())
        elif world.take is not None:
            world.on_end()

    node = rclpy.create_node.return_value
    node.resolve_topic_name.side_effect = lambda topic: topic
    node.get_topic_names_and_types.side_effect = lambda: [("/tactile", [world.kind])]
    node.create_subscription, node.create_publisher = subscribe, publisher
    rclpy.executors.SingleThreadedExecutor.return_value.spin_once = spin_once
    rclpy.utilities.get_message = lambda kind: lambda: made(kind)
    modules = {"rclpy": rclpy, "rclpy.executors": rclpy.executors, "rclpy.qos": rclpy.qos}
    modules |= {"rosidl_runtime_py": rclpy, "rosidl_runtime_py.utilities": rclpy.utilities}
    for name, content in modules.items():
        monkeypatch.setitem(sys.modules, name, content)
    return world


def stamped(content, kind):
    message = STORE.deserialize_cdr(content, kind)
    stamp = message.header.stamp
    return stamp.sec + stamp.nanosec / 1e9, message


@pytest.mark.parametrize("kind", ["wrench", "array"])
def test_the_bridge_publishes_the_alarms_that_detect_finds(kind, model, ros, tmp_path):  # noqa: F811
    place, said = bag(tmp_path / "bag", kind)
    options = ["reading.samples=/tactile", "decisions=true", "figure=none"]
    options += [f"reading.channels=[{','.join(FORCES)}]"] if "channels" in said else []
    (wanted,) = detected(model, place, tmp_path / "out", *options)["recordings"]
    decided = rows_of(tmp_path / "out" / "bag_decisions.csv")
    with Reader(place) as reader:
        ros.kind = reader.connections[0].msgtype
        ros.messages.extend(bytes(content) for _, _, content in reader.messages())
    detector = SlipDetector.load(model)
    source = RosTopic("/tactile", detector, Reading(**said))
    ros.on_end = source.close
    sink = source.publisher()
    stream = StreamingDetector(detector, SETTINGS, dtype=torch.float64)
    for item in source:
        if isinstance(item, Block):
            sink.decisions(stream.push(item.samples, item.time_s))
    sink.decisions(stream.flush())
    states = [stamped(content, STATE) for content in ros.published["slip/state"]]
    begin = START_NS / 1e9 if kind == "wrench" else 0.0
    atol = 2e-4 if kind == "wrench" else 1e-8  # the jitter of stamps
    for name, of in (("probability", "x"), ("is_on", "y"), ("is_valid", "z")):
        read = {"True": 1, "False": 0, "": "nan"}
        values = [float(read.get(row[name], row[name])) for row in decided]
        np.testing.assert_allclose([getattr(m.vector, of) for _, m in states], values, rtol=1e-9)
    assert ({m.vector.z for _, m in states} == {0.0, 1.0}) == (kind == "wrench")
    times = [float(row["available_s"]) for row in decided]
    np.testing.assert_allclose([time - begin for time, _ in states], times, atol=atol)
    onsets = [stamped(content, ONSET) for content in ros.published["slip/onset"]]
    told = [(t - begin, m.time_ref.sec + m.time_ref.nanosec / 1e9 - begin) for t, m in onsets]
    alarms = [(alarm["alarm_s"], alarm["onset_s"]) for alarm in wanted["alarms"]]
    np.testing.assert_allclose(told, alarms, atol=atol)
    assert any(1.2 < alarm_s < 1.3 for alarm_s, _ in told)
    assert {m.source for _, m in onsets} == {"status"}


def test_messages_that_cannot_be_read_are_told_and_passed_over(model):  # noqa: F811
    detector = SlipDetector.load(model)
    messages = TopicMessages(Topic("/ft", WRENCH), detector, Reading(channels=FORCES))
    first = messages.take(wrench(range(6), START_NS))
    np.testing.assert_array_equal(first.samples, [[0, 1, 2, 3]])
    said = messages.take(wrench(range(6), START_NS)[:40])
    assert (said.kind, "/ft was passed over" in said.text) == ("garbage", True)
    back = messages.take(wrench(range(6), START_NS - 10**9))
    assert (back.kind, "go back" in back.text) == ("garbage", True)
    assert messages.take(wrench(range(6), START_NS - 10**9)) is None
    late = messages.take(wrench(range(6), START_NS + 2 * 10**7))
    assert late.time_s[0] == pytest.approx((START_NS + 2 * 10**7) / 1e9, abs=1e-6)


WRONG = [
    (WRENCH, wrench(range(6), START_NS), "numbers called wrench.force.x"),
    (ARRAY, array([1.0, 2.0]), "/ft has 2 channels, and none is"),
    (ARRAY, array(np.ones(5)), "/ft has 5 channels, the detector 4; say which"),
    ("my_msgs/msg/Skin", b"", "no definition of my_msgs/msg/Skin"),
]


@pytest.mark.parametrize(("kind", "content", "words"), WRONG)
def test_a_topic_that_does_not_fit_is_one_line(kind, content, words, model):  # noqa: F811
    messages = TopicMessages(Topic("/ft", kind), SlipDetector.load(model))
    with pytest.raises(ValueError, match=words) as caught:
        messages.take(content)
    assert "\n" not in str(caught.value)


def test_without_rclpy_it_is_one_line(model):  # noqa: F811
    with pytest.raises(ValueError, match=r"^source=ros2 needs rclpy, .* source the setup.bash"):
        RosTopic("/tactile", SlipDetector.load(model))


def test_no_decision_is_no_message(model):  # noqa: F811
    assert decision_messages(StreamingDetector(SlipDetector.load(model), SETTINGS).flush()) == []

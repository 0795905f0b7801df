"""ROS 2: samples from a topic, and decisions onto topics, where ``rclpy`` is installed.

``TopicMessages`` and ``decision_messages`` make samples of messages and messages of decisions
without ROS; ``RosTopic`` and its publisher carry them. Messages come as bytes (CDR), read by the
rules of recorded ones (``data.formats``): one sample of all channels, or an array of ``std_msgs``
with a dimension called ``samples``.

===============  =================================  ===============================================
published        type                               what
===============  =================================  ===============================================
``slip/state``   ``geometry_msgs/Vector3Stamped``   each decision: probability of slip as x; y is 1
                                                    while an alarm stands, z is 1 while every
                                                    channel in use can be trusted, else 0
``slip/onset``   ``sensor_msgs/TimeReference``      each alarm: its time as stamp, when slip began
                                                    as ``time_ref``, ``onset`` or ``status`` as
                                                    ``source``
===============  =================================  ===============================================

Stamps are on the clock of the samples' stamps; without these, seconds since the first sample.
"""

from __future__ import annotations

import importlib
import importlib.util
import threading
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from tactslip_torch.data.formats import Reading, Refused
from tactslip_torch.data.formats._inference import SECONDS, epoch_unit, time_unit_in
from tactslip_torch.data.formats._messages import Message, Topic, TopicColumns, Types
from tactslip_torch.live.sinks import Block, Event, Sink
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.onset.decisions import Decisions

_VECTOR, _REFERENCE = "geometry_msgs/msg/Vector3Stamped", "sensor_msgs/msg/TimeReference"
_TOPICS = {"slip/state": _VECTOR, "slip/onset": _REFERENCE}
_FRAME = "tactslip"
_FOLLOWED = 0.2  # samples by which a message may move the clock; the detector takes 0.25
_JITTER_S = 0.002
_POLL_S = 0.1
_QUEUE = 2000  # messages


class TopicMessages:
    """The messages of a topic as blocks of samples.

    A stamp is the time of its message's first sample. One that is up to 2 ms early or late
    is taken to follow the message before, as the clock of a sender does; later, samples are
    missing. Messages without stamps follow one another: what is lost of these is not noticed.

    Args:
        topic: its name and the type of its messages.
        detector: whose channels and rate they have.
        reading: which numbers are channels, as of a recording of the topic.
    """

    def __init__(
        self, topic: Topic, detector: SlipDetector, reading: Reading | None = None
    ) -> None:
        self._topic, self._how = topic, reading or Reading()
        self._hand, self._rate = detector.pool.hand.names, detector.pool.sample_rate_hz
        self._columns: TopicColumns | None = None
        self._order: list[int] = []
        self._due_s: float | None = None
        self._is_back = False

    def take(self, content: bytes) -> Block | Event | None:
        """The samples of the next message, or what is wrong with it; ``None``: nothing new.

        Raises:
            ValueError: if the first message does not show which numbers are the channels.
        """
        if self._columns is None:
            self._columns = self._first(content)
        try:
            rows, stamp, named = self._columns.rows(content)
            samples = rows[:, self._order].astype(np.float64)
        except Exception as error:  # rosbags raises many kinds
            message = " ".join(str(error).split())[:200] or type(error).__name__
            return Event("garbage", f"a message on {self._topic.name} was passed over: {message}")
        time_s = stamp / 1e9 if stamp else None
        if named is not None:
            unit = self._how.time_unit or time_unit_in(self._columns.time_name)
            time_s = float(named) * SECONDS[unit or epoch_unit(float(named)) or "s"]
        if time_s is None:
            return Block(samples)
        begin_s = self._followed(time_s)
        if begin_s is None:
            is_reported, self._is_back = self._is_back, True
            text = (
                f"stamps on {self._topic.name} go back to {time_s:.3f} s; start again if they may"
            )
            return None if is_reported else Event("garbage", text)
        self._is_back, self._due_s = False, begin_s + len(samples) / self._rate
        return Block(samples, begin_s + np.arange(len(samples)) / self._rate)

    def _followed(self, time_s: float) -> float | None:
        """The time of a message that has this stamp; ``None``: it was before the last one."""
        if self._due_s is None or time_s - self._due_s > _JITTER_S:
            return time_s
        late = time_s - self._due_s
        most = _FOLLOWED / self._rate
        return None if late < -_JITTER_S else self._due_s + min(max(late, -most), most)

    def _first(self, content: bytes) -> TopicColumns:
        name = self._topic.name
        try:
            columns = self._columns_of(Message(self._topic, 0, content))
            num = columns.num_channels
        except Refused as error:
            raise ValueError(f"topic {name} of {self._topic.kind}: {error}") from None
        named = columns.names is not None and self._how.channels is None
        own = list(columns.names or ()) if named else list(self._hand)[:num]
        if lacking := [each for each in self._hand if each not in own]:
            has = f"numbers called {', '.join(own[:8])}" if named else f"{num} channels"
            raise ValueError(
                f"topic {name} has {has}, and none is {lacking[0]}; list those of the detector's "
                f"{len(self._hand)} channels, in their order, as reading.channels"
            )
        if not named and num != len(self._hand):
            raise ValueError(
                f"topic {name} has {num} channels, the detector {len(self._hand)}; say which as "
                "reading.channels"
            )
        self._order = [own.index(each) for each in self._hand]
        return columns

    def _columns_of(self, first: Message) -> TopicColumns:
        """The hand's channels, whatever they are called, unless the reading names them."""
        if self._how.channels is None:
            with suppress(Refused):
                of_hand = replace(self._how, channels=self._hand)
                return TopicColumns(first, Types(), of_hand)
        return TopicColumns(first, Types(), self._how)


def decision_messages(decisions: Decisions) -> list[tuple[str, dict[str, Any]]]:
    """The topic and the fields of each message that decisions ``[m]`` become, in order."""
    alarms = iter(decisions.alarms)
    made: list[tuple[str, dict[str, Any]]] = []
    columns = (
        decisions.available_s,
        decisions.probability,
        decisions.is_on,
        decisions.is_valid,
        decisions.is_alarm,
    )
    for time_s, probability, is_on, is_valid, is_alarm in zip(
        *(column.tolist() for column in columns), strict=True
    ):
        header = {"stamp": _stamp(time_s), "frame_id": _FRAME}
        vector = {"x": probability, "y": float(is_on), "z": float(is_valid)}
        made.append(("slip/state", {"header": header, "vector": vector}))
        if is_alarm:
            alarm = next(alarms)
            began = {"time_ref": _stamp(alarm.onset_s), "source": alarm.raised_by}
            made.append(("slip/onset", {"header": header, **began}))
    return made


def _stamp(time_s: float) -> dict[str, int]:
    seconds, rest = divmod(round(time_s * 1e9), 10**9)
    return {"sec": seconds, "nanosec": rest}


class RosTopic:
    """A source: a topic, in a node called ``tactslip``; ``publisher`` is the sink beside it.

    Args:
        topic: its name.
        detector: whose channels and rate it has.
        reading: as of ``TopicMessages``.

    Raises:
        ValueError: if ``rclpy`` is not installed.
    """

    is_live = True
    simulated = False

    def __init__(self, topic: str, detector: SlipDetector, reading: Reading | None = None) -> None:
        if importlib.util.find_spec("rclpy") is None:
            raise ValueError(
                "source=ros2 needs rclpy, which this Python does not have; source the setup.bash "
                "of ROS 2 first, and install tactslip for the Python that ROS 2 uses"
            )
        self._rclpy = importlib.import_module("rclpy")
        self.name, self._detector, self._reading = f"ros2:{topic}", detector, reading
        self._stopped = threading.Event()
        if not self._rclpy.ok():
            signals = importlib.import_module("rclpy.signals")  # tactslip answers to signals
            self._rclpy.init(args=[], signal_handler_options=signals.SignalHandlerOptions.NO)
        self._node = self._rclpy.create_node("tactslip")
        self._topic = self._node.resolve_topic_name(topic)

    def publisher(self) -> _Publisher:
        """The sink that publishes decisions; closing it ends the node."""
        return _Publisher(self._node)

    def close(self) -> None:
        """End the iteration."""
        self._stopped.set()

    def __iter__(self) -> Iterator[Block | Event]:
        """Wait for the topic, then its messages."""
        executors = importlib.import_module("rclpy.executors")
        executor = executors.SingleThreadedExecutor()
        executor.add_node(self._node)
        try:
            yield Event("waiting", f"{self.name}: waits for a publisher")
            kind = None
            while kind is None and not self._stopped.is_set():
                there = dict(self._node.get_topic_names_and_types())
                kind = next(iter(there.get(self._topic, [])), None)
                executor.spin_once(timeout_sec=_POLL_S)
            if kind is None:
                return
            yield Event("connected", f"{self.name}: {kind}")
            messages = TopicMessages(Topic(self._topic, kind), self._detector, self._reading)
            came: deque[bytes] = deque()
            qos = importlib.import_module("rclpy.qos")
            profile = qos.QoSProfile(depth=_QUEUE, reliability=qos.ReliabilityPolicy.BEST_EFFORT)
            self._node.create_subscription(
                _class_of(kind), self._topic, came.append, profile, raw=True
            )
            while not self._stopped.is_set():
                executor.spin_once(timeout_sec=_POLL_S)
                while came:
                    if (taken := messages.take(came.popleft())) is not None:
                        yield taken
        finally:
            executor.remove_node(self._node)


class _Publisher(Sink):
    """A sink: decisions as messages of the topics above, published by a node."""

    def __init__(self, node: Any) -> None:
        self._node = node
        self._kinds = {topic: _class_of(kind) for topic, kind in _TOPICS.items()}
        self._publishers = {
            topic: node.create_publisher(kind, topic, _QUEUE) for topic, kind in self._kinds.items()
        }

    def decisions(self, decisions: Decisions) -> None:
        """Publish them."""
        for topic, fields in decision_messages(decisions):
            self._publishers[topic].publish(_filled(self._kinds[topic](), fields))

    def event(self, kind: str, text: str) -> None:
        """Log it, as nodes do."""
        self._node.get_logger().info(f"{kind}: {text}")

    def close(self) -> None:
        """End the node."""
        self._node.destroy_node()


def _filled(message: Any, fields: Mapping[str, Any]) -> Any:
    """A message with its fields set, those of messages in it as well."""
    for name, value in fields.items():
        if isinstance(value, Mapping):
            _filled(getattr(message, name), value)
        else:
            setattr(message, name, value)
    return message


def _class_of(kind: str) -> Any:
    """The Python class of a type of messages."""
    return importlib.import_module("rosidl_runtime_py.utilities").get_message(kind)

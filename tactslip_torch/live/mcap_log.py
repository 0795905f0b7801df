"""A recording or stream with its decisions as an MCAP file, and a layout of panels for Foxglove.

Messages are ``std_msgs`` and the like in CDR with their ROS 2 definitions, under the profile
``ros2``: Foxglove, PlotJuggler, ``mcap`` and ``rosbags`` read them without ROS. (JSON has no NaN,
and ``rosbags`` reads no file with JSON schemas.) Log time is the time of the stream. A message
holds one sample of all channels, since panels draw one point a message: ``/tactile.data[3]`` is
the fourth channel.

============================  ==========================  =============================
topic                         type                        one message for
============================  ==========================  =============================
``/tactile``                  ``Float32MultiArray``       a sample of all channels
``/slip/probability``         ``Float64``                 a decision (NaN: not valid)
``/slip/statistic``           ``Float64``                 a decision
``/slip/onset_score``         ``Float64``                 a decision (NaN: none yet)
``/slip/valid``               ``Bool``                    a decision: it counts
``/slip/in_range``            ``Bool``                    a decision: levels are as in training
``/slip/alarm``               ``Bool``                    a decision: an alarm stands
``/slip/onset``               ``TimeReference``           an alarm: when slip began
``/slip/truth``               ``Bool``                    a change, where it is known
``/slip/events``              ``rcl_interfaces/msg/Log``  an alarm or event, as text
============================  ==========================  =============================
"""

from __future__ import annotations

import json
import math
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch

from tactslip_torch.data.formats._messages import HEADER, RECORDING, TOPIC, Types, kind_of
from tactslip_torch.data.formats._reading import header_of, needs, text_of
from tactslip_torch.data.recording import Recording
from tactslip_torch.hand import HandLayout
from tactslip_torch.live.sinks import Block, Sink
from tactslip_torch.onset.decisions import AlarmSettings, Decisions
from tactslip_torch.onset.rules import NOTHING_YET
from tactslip_torch.runtime import whole_file

_NUMBER, _SWITCH = "std_msgs/msg/Float64", "std_msgs/msg/Bool"
_TIME, _HEADER = "builtin_interfaces/msg/Time", "std_msgs/msg/Header"
_ONSET, _LOG = "sensor_msgs/msg/TimeReference", "rcl_interfaces/msg/Log"
_KINDS = {
    **dict.fromkeys(("probability", "statistic", "onset_score"), _NUMBER),
    **dict.fromkeys(("valid", "in_range", "alarm", "truth"), _SWITCH),
    "onset": _ONSET,
    "events": _LOG,
}
_INFO, _WARN = 20, 30
_CHUNK = 2**18  # bytes; what a killed process loses at most


class McapLog(Sink):
    """A sink that writes an MCAP file, and ``NAME.foxglove.json`` beside it.

    The file has its name once it is closed; a ``with`` block that raises leaves none. A killed
    process leaves ``.NAME.*.tmp.mcap``, of which ``mcap recover`` saves all but the last quarter of
    a MiB; copy it first, since the next file of that name removes it. A file without dropped
    samples and without times of a sender is a recording of this package: ``data.formats`` reads it
    back with its channels, rate and truth.

    Args:
        path: of the file.
        hand: the channels of the samples.
        sample_rate_hz: of the stream.
        settings: of its alarms, for thresholds in the layout.
        recording: its truth, units and origin, whatever its samples; ``None``: nothing is known.
        units: of the samples, if there is no recording.
        dtype: in which samples are kept.
        is_live: whether the first sample is of now, where samples have no times; else it is at 0.

    Raises:
        ValueError: in one line, if ``mcap`` or ``rosbags`` is not installed, or the path is no
            ``.mcap``.
    """

    def __init__(
        self,
        path: Path,
        hand: HandLayout,
        sample_rate_hz: float,
        settings: AlarmSettings,
        *,
        recording: Recording | None = None,
        units: str = "V",
        dtype: torch.dtype = torch.float32,
        is_live: bool = False,
    ) -> None:
        if path.suffix != ".mcap":
            raise ValueError(f"{path} must end in .mcap")
        self._rate, self._is_live = sample_rate_hz, is_live
        self._start_s: float | None = None  # since 1970, of the time 0 of a live stream
        self._last_s = 0.0  # of the last sample
        self._stack = ExitStack()
        library = needs("mcap.writer", "writing .mcap")
        none = torch.empty(len(hand), 0, dtype=dtype)
        known = recording or Recording(none, sample_rate_hz, "unknown", (), (), (), units=units)
        self._header = header_of(replace(known, samples=none), hand, {})
        self._has_onset = settings.onset is not None
        self._num, self._is_even = 0, True
        self._types = Types()
        topics = {f"/slip/{name}": kind for name, kind in _KINDS.items()}
        if not self._has_onset:
            del topics["/slip/onset_score"]
        self._kinds = {TOPIC: kind_of(self._header), **topics}
        self._prefix, self._stored = self._of_samples(len(hand)), np.dtype(self._header["dtype"])
        temporary = self._stack.enter_context(whole_file(path))
        file = self._stack.enter_context(temporary.open("wb"))
        self._writer = library.Writer(file, chunk_size=_CHUNK)
        self._writer.start(profile="ros2", library="tactslip_torch")
        self._channels = {}
        for topic, kind in self._kinds.items():
            text = self._types.definition(kind).encode()
            schema = self._writer.register_schema(kind, "ros2msg", text)
            self._channels[topic] = self._writer.register_channel(topic, "cdr", schema)
        layout = _foxglove_layout(hand, settings, known.units)
        with whole_file(path.with_suffix(".foxglove.json")) as beside:
            beside.write_text(json.dumps(layout, indent=1) + "\n", encoding="utf-8")
        if recording is not None and recording.has_truth:
            slides = sorted((*recording.sliding_s, *recording.slip_s))
            self._write("truth", 0.0, data=any(start <= 0 for start, _ in slides))
            for start_s, end_s in slides:
                self._write("truth", start_s, data=True)
                self._write("truth", end_s, data=False)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: Any
    ) -> None:
        if kind is None:
            self.close()
        else:
            self._stack.__exit__(kind, error, trace)

    def samples(self, first: int, block: Block) -> None:
        """Write a message for each sample."""
        times_s = block.time_s
        if times_s is None:
            times_s = (first + np.arange(len(block.samples))) / self._rate
            if self._is_live and self._start_s is None:
                self._start_s = time.time()
        self._last_s = float(times_s[-1]) if len(times_s) else self._last_s
        self._is_even &= first == self._num and block.time_s is None
        self._num = first + len(block.samples)
        rows = np.asarray(block.samples, self._stored, order="C")
        channel = self._channels[TOPIC]
        for time_s, row in zip(times_s.tolist(), rows, strict=True):
            at = self._ns(time_s)
            self._writer.add_message(channel, at, self._prefix + row.tobytes(), at)

    def decisions(self, decisions: Decisions) -> None:
        """Write a message of each topic for each, and alarms as events."""
        columns: dict[str, Any] = {
            "probability": decisions.probability,
            "statistic": decisions.statistic,
            "valid": decisions.is_valid,
            "in_range": decisions.in_range,
            "alarm": decisions.is_on,
        }
        if self._has_onset:
            columns["onset_score"] = decisions.onset_score
        times_s = decisions.available_s.tolist()
        for name, values in columns.items():
            for time_s, value in zip(times_s, values.tolist(), strict=True):
                is_none = name in ("statistic", "onset_score") and value <= NOTHING_YET
                self._write(name, time_s, data=math.nan if is_none else value)
        for alarm in decisions.alarms:
            header = self._made(_HEADER, stamp=self._clock(alarm.alarm_s), frame_id="")
            began = self._clock(alarm.onset_s)
            self._write(
                "onset", alarm.alarm_s, header=header, time_ref=began, source=alarm.raised_by
            )
            known = "-" if math.isnan(alarm.probability) else f"{alarm.probability:.3f}"
            ago_s = alarm.alarm_s - alarm.onset_s
            text = f"slip alarm by {alarm.raised_by}; slip began {ago_s:.3f} s before; "
            self._log(_WARN, alarm.alarm_s, f"{text}probability {known}")

    def event(self, kind: str, text: str) -> None:
        """Write it at the time of the last sample."""
        self._log(_INFO, self._last_s, f"{kind}: {text}")

    def close(self) -> None:
        """Write the end of the file and give it its name; a second time does nothing."""
        if self._writer is None:
            return
        writer, self._writer = self._writer, None
        with self._stack:
            if self._is_even:
                shape = [len(self._header["channels"]), self._num]
                writer.add_metadata(RECORDING, {HEADER: text_of(self._header | {"shape": shape})})
            writer.finish()

    def _of_samples(self, num: int) -> bytes:
        """What stands before the numbers of a sample; they are the end of its message."""
        axis = self._made(
            "std_msgs/msg/MultiArrayDimension", label="channels", size=num, stride=num
        )
        layout = self._made("std_msgs/msg/MultiArrayLayout", dim=[axis], data_offset=0)
        numbers = np.zeros(num, self._header["dtype"])
        whole = self._packed(self._kinds[TOPIC], layout=layout, data=numbers)
        return whole[: -numbers.nbytes]

    def _made(self, kind: str, **fields: Any) -> Any:
        return self._types.store.types[kind](**fields)

    def _packed(self, kind: str, **fields: Any) -> bytes:
        message = self._made(kind, **fields)
        return bytes(self._types.store.serialize_cdr(message, kind, little_endian=True))

    def _write(self, name: str, time_s: float, /, **fields: Any) -> None:
        at, content = self._ns(time_s), self._packed(_KINDS[name], **fields)
        self._writer.add_message(self._channels[f"/slip/{name}"], at, content, at)

    def _log(self, level: int, time_s: float, text: str) -> None:
        words = {"name": "tactslip", "msg": text, "file": "", "function": "", "line": 0}
        self._write("events", time_s, stamp=self._clock(time_s), level=level, **words)

    def _ns(self, time_s: float) -> int:
        return max(round((self._start_s or 0.0) * 1e9) + round(time_s * 1e9), 0)

    def _clock(self, time_s: float) -> Any:
        seconds, rest = divmod(self._ns(time_s), 10**9)
        return self._made(_TIME, sec=seconds, nanosec=rest)


# The layout --------------------------------------------------------------------------------------


def _foxglove_layout(hand: HandLayout, settings: AlarmSettings, units: str = "V") -> dict[str, Any]:
    """Panels for such a file, as Foxglove imports them (Layouts, Import from file).

    A plot of the channels of each kind, the probability, the statistic and, with an onset
    classifier, its score, both with their threshold as a line; alarm, validity and truth as state
    transitions; alarms and events as a log.

    Reference:
        https://docs.foxglove.dev/docs/visualization/panels/plot (a number for a path is a
        horizontal line) and .../message-path-syntax; the keys are those of ``foxglove.layouts``.
    """
    panels: dict[str, Any] = {}
    for kind in dict.fromkeys(channel.kind for channel in hand.channels):
        lines = [(f"{TOPIC}.data[{n}]", hand.names[n]) for n in hand.indices(kind)]
        panels[f"Plot!{kind}"] = _plot(f"{kind} ({units})", lines)
    panels["Plot!probability"] = _plot(
        "Probability of slip", [("/slip/probability.data", "probability")], least=0, most=1
    )
    thresholds = {"statistic": settings.threshold}
    if settings.onset is not None:
        thresholds["onset_score"] = settings.onset.threshold
    for name, threshold in thresholds.items():
        lines = [(f"/slip/{name}.data", name.replace("_", " "))]
        lines += [(repr(float(threshold)), "threshold")] if math.isfinite(threshold) else []
        panels[f"Plot!{name}"] = _plot(name.replace("_", " ").capitalize(), lines)
    states = [_path(f"/slip/{name}.data", name) for name in ("alarm", "valid", "truth")]
    panels["StateTransitions!states"] = {"paths": states, "isSynced": True}
    panels["RosOut!events"] = {"topicToRender": "/slip/events", "minLogLevel": 1}
    layout: Any
    *names, layout = panels  # stacked, each as high as the others
    for place, name in enumerate(reversed(names), 2):
        split = {"first": name, "second": layout, "direction": "column"}
        layout = split | {"splitPercentage": 100 / place}
    return {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": layout,
    }


def _plot(
    title: str,
    lines: list[tuple[str, str]],
    least: float | None = None,
    most: float | None = None,
) -> dict[str, Any]:
    limits = {"minYValue": least, "maxYValue": most}
    return {
        "foxglovePanelTitle": title,
        "paths": [_path(value, label) for value, label in lines],
        "isSynced": True,
        "xAxisVal": "timestamp",
        "showLegend": True,
        "legendDisplay": "left",
        "showXAxisLabels": True,
        "showYAxisLabels": True,
        **{name: value for name, value in limits.items() if value is not None},
    }


def _path(value: str, label: str) -> dict[str, Any]:
    return {"value": value, "label": label, "enabled": True, "timestampMethod": "receiveTime"}

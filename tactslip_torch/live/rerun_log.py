"""A recording or stream with its decisions as a Rerun recording (``.rrd``), the hand drawn.

Time series of samples by kind of channel, probability, statistic with its threshold, alarm,
validity and truth; alarms and events as a log; and the hand every tenth of a second, each channel
a disc whose area is its part of all shares (``channel_shares``): orange towards slip, blue against.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tactslip_torch.data.formats._reading import needs
from tactslip_torch.data.recording import Recording
from tactslip_torch.hand import HandLayout
from tactslip_torch.live.sinks import Block, FileSink, alarm_text, truth_changes
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.onset.decisions import AlarmSettings, Decisions
from tactslip_torch.onset.rules import NOTHING_YET
from tactslip_torch.runtime import whole_file

_SHARES_S = 0.1  # from one drawing of the hand to the next
_SENT_S = 0.1  # of samples that are sent at once
_FROM_TIP = ("tip", "distal", "intermediate", "middle", "proximal", "base", "palm")
_TO_SLIP, _AGAINST = np.array([213, 94, 0], np.uint8), np.array([0, 114, 178], np.uint8)
_RADIUS = 0.4  # of a channel that is all of it; a segment is 0.92 wide
_MOST_NAMED = 48  # channels; the names of more show where the mouse is
_LONG_AGO_S = 1e8  # times above are since 1970

Array = NDArray[np.float64]


def channel_shares(detector: SlipDetector, samples: Tensor) -> Tensor:
    """How much each channel adds to the score of raw bins: the score less that without it.

    Without a channel the score is the one that the detector expects from the others, as where a
    sensor fails (``predict_raw``), whatever its features and pooling. Shares of several channels do
    not add up to the score, as channels tell the same in part. What the fast evidence of an onset
    classifier says is not in them. 0 of channels that are missing or not in use.

    Shape:
        - samples: ``[N, C, context_before + n + context_after]``, volts
        - output: ``[N, C]``
    """
    num = samples.shape[1]
    without = samples[:, None].repeat(1, num + 1, 1, 1)  # [N, C + 1, C, W], the last one whole
    without[:, range(num), range(num)] = math.nan
    with torch.no_grad():
        score = detector.predict_raw(without).score
    return score[:, num:] - score[:, :num]


class RerunLog(FileSink):
    """A sink that writes a ``.rrd`` file, which has its name once it is closed.

    A ``with`` block that raises leaves none. A killed process leaves ``.NAME.*.tmp.rrd``, which
    Rerun opens too; copy it first, since the next file of that name removes it.

    Args:
        path: of the file.
        detector: whose channels the samples have.
        settings: of its alarms, for thresholds.
        recording: its truth and units; ``None``: nothing is known.
        is_live: whether the first sample is of now, where nobody tells times; else it is at 0.

    Raises:
        ValueError: in one line, if ``rerun-sdk`` is not installed, or the path is no ``.rrd``.
    """

    def __init__(
        self,
        path: Path,
        detector: SlipDetector,
        settings: AlarmSettings,
        *,
        recording: Recording | None = None,
        is_live: bool = False,
    ) -> None:
        super().__init__(path, ".rrd", detector.pool.sample_rate_hz, is_live=is_live)
        self._rr: Any = needs("rerun", "writing .rrd", "rerun")
        self._detector, self._hand = detector, detector.pool.hand
        self._thresholds = settings.thresholds
        self._waiting: list[tuple[Array, Array]] = []  # times and samples
        self._last_sent_s = -math.inf
        self._whole = detector.context_before + detector.pool.bin_samples + detector.look_ahead
        self._unused = detector.context_after - detector.look_ahead  # samples behind these
        self._recent = np.empty((0, len(self._hand)))
        self._every = max(round(_SHARES_S * self._rate), 1)  # samples from one hand to the next
        self._until = self._whole  # samples to the next
        temporary = self._stack.enter_context(whole_file(path))
        self._to: Any = self._rr.RecordingStream("tactslip", recording_id=path.stem)
        self._stack.callback(self._to.disconnect)
        units = recording.units if recording else str(detector.info.get("units", "V"))
        self._to.set_log_time_enabled(False)  # the time of the stream is the only one
        self._to.set_log_tick_enabled(False)
        self._to.save(temporary, default_blueprint=self._blueprint(units))
        self._draw_hand()
        if changes := truth_changes(recording):
            times, is_slip = zip(*changes, strict=True)
            self._send("slip/truth", times, np.array(is_slip)[:, None])

    def samples(self, first: int, block: Block) -> None:
        """Keep them, to be sent by the tenth of a second, and draw the hand as often."""
        if not len(block.samples):
            return
        times_s = self._times_of(first, block)
        self._waiting.append((times_s, block.samples))
        if self._last_s - self._last_sent_s >= _SENT_S:
            self._send_samples()
        self._draw_shares(times_s, block.samples)

    def decisions(self, decisions: Decisions) -> None:
        """Send what each of them says, and alarms as text."""
        times_s = decisions.available_s.tolist()
        self._send("slip/probability", times_s, decisions.probability.double().numpy()[:, None])
        for name, threshold in self._thresholds.items():
            values = getattr(decisions, name).double().numpy()
            values = np.where(values > NOTHING_YET, values, math.nan)
            lines = np.stack([values, np.full_like(values, threshold)], 1)
            self._send(f"slip/{name}", times_s, lines)
        states = torch.stack([decisions.is_on, decisions.is_valid], 1).double().numpy()
        self._send("slip/state", times_s, states)
        for alarm in decisions.alarms:
            entry = self._rr.TextLog(alarm_text(alarm), level="WARN")
            self._log("slip/events", alarm.alarm_s, entry)

    def event(self, kind: str, text: str) -> None:
        """Log it at the time of the last sample."""
        entry = self._rr.TextLog(f"{kind}: {text}", level="INFO")
        self._log("slip/events", self._last_s, entry)

    def close(self) -> None:
        """Write what is left and give the file its name; a second time does nothing."""
        if self._to is not None:
            self._send_samples()
            self._to.flush()
            self._to = None
            self._stack.close()

    # Sending --------------------------------------------------------------------------------------

    def _log(self, entity: str, time_s: float, content: Any) -> None:
        if self._start_s is None and time_s < _LONG_AGO_S:
            self._to.set_time("time", duration=time_s)
        else:
            self._to.set_time("time", timestamp=(self._start_s or 0.0) + time_s)
        self._to.log(entity, content)

    def _send(self, entity: str, times_s: Any, values: Any) -> None:
        """Rows ``[n, k]`` of k lines."""
        times, values = np.asarray(times_s, np.float64), np.asarray(values, np.float64)
        if self._start_s is None and times[-1] < _LONG_AGO_S:
            column = self._rr.TimeColumn("time", duration=times)
        else:
            column = self._rr.TimeColumn("time", timestamp=times + (self._start_s or 0.0))
        scalars = self._rr.Scalars.columns(scalars=values.ravel())
        lengths = [values.shape[1]] * len(values)
        self._to.send_columns(entity, [column], scalars.partition(lengths))

    def _send_samples(self) -> None:
        if self._waiting:
            times_s, samples = map(np.concatenate, zip(*self._waiting, strict=True))
            for kind in self._hand.kinds:
                self._send(f"tactile/{kind}", times_s, samples[:, self._hand.indices(kind)])
            self._waiting, self._last_sent_s = [], self._last_s

    def _draw_shares(self, times_s: Array, samples: Array) -> None:
        """The hand at each tenth of a second that ends in these samples."""
        held, recent = len(self._recent), np.concatenate([self._recent, samples])
        ends = range(held + self._until, len(recent) + 1, self._every)
        self._until += (len(ends) * self._every) - len(samples)
        self._recent = recent[-self._whole :]
        if not ends:
            return
        bins = np.stack([recent[end - self._whole : end].T for end in ends])
        padded = np.pad(bins, ((0, 0), (0, 0), (0, self._unused)))
        shares = channel_shares(self._detector, torch.from_numpy(padded)).numpy()
        at = [float(times_s[end - held - 1]) for end in ends]
        self._send("slip/shares", at, shares)
        for time_s, share in zip(at, shares, strict=True):
            part = np.abs(share) / max(float(np.abs(share).sum()), 1e-12)
            discs = self._rr.Points2D(
                self._places,
                radii=_RADIUS * np.sqrt(0.02 + part),
                colors=np.where(share[:, None] > 0, _TO_SLIP, _AGAINST),
                labels=self._hand.names,
                show_labels=len(self._hand) <= _MOST_NAMED,
            )
            self._log("hand/channels", time_s, discs)

    # What is drawn --------------------------------------------------------------------------------

    def _draw_hand(self) -> None:
        """What does not change: names of lines, and the hand without its channels."""
        names = {
            "slip/probability": ["probability"],
            "slip/state": ["alarm", "valid"],
            "slip/truth": ["slip in truth"],
            "slip/shares": list(self._hand.names),
            **{f"slip/{name}": [name, "threshold"] for name in self._thresholds},
        }
        for kind in self._hand.kinds:
            names[f"tactile/{kind}"] = [self._hand.names[n] for n in self._hand.indices(kind)]
        step = self._rr.components.InterpolationMode.StepAfter
        for entity, lines in names.items():
            how = {"interpolation_mode": step} if entity in ("slip/state", "slip/truth") else {}
            self._to.log(entity, self._rr.SeriesLines(names=lines, **how), static=True)
        self._places, segments = _places_of(self._hand)
        middles = np.array(list(segments.values()))
        grey = [(160, 160, 160)]
        boxes = self._rr.Boxes2D(
            centers=middles, half_sizes=[(0.46, 0.46)], colors=grey, draw_order=0.0
        )
        self._to.log("hand/segments", boxes, static=True)
        tips = {finger: at for (finger, _), at in reversed(segments.items())}  # the first of each
        names_at = [(x, y - 0.75) for x, y in tips.values()]
        fingers = self._rr.Points2D(names_at, radii=0.01, colors=grey, labels=list(tips))
        self._to.log("hand/fingers", fingers, static=True)

    def _blueprint(self, units: str) -> Any:
        """Views: the hand beside the lines."""
        views = self._rr.blueprint
        lines = [(f"tactile/{kind}", f"{kind} ({units})") for kind in self._hand.kinds]
        lines += [("slip/probability", "Probability of slip")]
        lines += [
            (f"slip/{name}", name.replace("_", " ").capitalize()) for name in self._thresholds
        ]
        plots = [views.TimeSeriesView(origin=entity, name=name) for entity, name in lines]
        states = ["/slip/state", "/slip/truth"]
        plots.append(views.TimeSeriesView(contents=states, name="Alarm, validity and truth"))
        beside = [
            views.Spatial2DView(origin="hand", name="Share of each channel in the score"),
            views.TimeSeriesView(origin="slip/shares", name="Shares"),
            views.TextLogView(origin="slip/events", name="Alarms and events"),
        ]
        right = views.Vertical(*beside, row_shares=[4, 2, 1])
        whole = views.Horizontal(views.Vertical(*plots), right)
        return views.Blueprint(whole, collapse_panels=True)


def _places_of(hand: HandLayout) -> tuple[Array, dict[tuple[str, str], tuple[float, float]]]:
    """Where channels ``[C, 2]`` and the middles of segments are drawn: fingers side by side.

    Tips are up (y grows downwards), the thumb is last and lower; in a segment channels stand in
    lines.
    """
    fingers = list(dict.fromkeys(channel.finger for channel in hand.channels))
    fingers.sort(key=lambda finger: finger == "thumb")
    within: dict[tuple[str, str], list[int]] = {}
    for number, channel in enumerate(hand.channels):
        within.setdefault((channel.finger, channel.segment), []).append(number)
    places, segments = np.zeros((len(hand), 2)), {}
    for column, finger in enumerate(fingers):
        own = [segment for of, segment in within if of == finger]
        own.sort(key=lambda s: _FROM_TIP.index(s) if s in _FROM_TIP else len(_FROM_TIP))
        root = 1.3 if finger == "thumb" and column else 0.0
        for row, segment in enumerate(own):
            middle = float(column), root + row - len(own) + 1.0
            segments[finger, segment] = middle
            numbers = within[finger, segment]
            wide = math.ceil(math.sqrt(len(numbers)))
            for place, number in enumerate(numbers):
                line, at = divmod(place, wide)
                x, y = (at + 0.5) / wide - 0.5, (line + 0.5) / wide - 0.5
                places[number] = middle[0] + 0.8 * x, middle[1] + 0.8 * y
    return places, segments

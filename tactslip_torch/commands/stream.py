"""Slip in samples as they come: ``tactslip stream model=detector.pt source=PLACE``.

``live`` does the work; here is what the configuration makes of it. JSON lines alone go to standard
output, what happens to the stream to standard error as well, in a line each.
"""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import torch
from omegaconf import DictConfig

from tactslip_torch.commands.detect import plain_section, reading_of, settings_of
from tactslip_torch.commands.entry import entry_point
from tactslip_torch.commands.hosts import hosts_dir
from tactslip_torch.live.frames import Frames
from tactslip_torch.live.mcap_log import McapLog
from tactslip_torch.live.pump import watch
from tactslip_torch.live.ros2 import RosTopic
from tactslip_torch.live.server import PageServer, page_metadata
from tactslip_torch.live.sinks import Callback, Counts, Event, JsonLines, LineServer, Sink, Source
from tactslip_torch.live.sources import FileInTime, address_of, source_of
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.onset.streaming import StreamingDetector
from tactslip_torch.runtime import check_number

_SWITCH_S = 5e-4
"""Between threads of Python: by default one may keep the others from running for 5 ms."""


def stream(config: DictConfig, folder: Path) -> Counts:
    """Watch a source until it ends.

    Args:
        config: composed from ``conf/stream.yaml``.
        folder: of no use, nothing is left.

    Returns:
        What was counted.

    Raises:
        ValueError: for bad input, in one line.
        OSError: so, of a file, a serial port or an address.
    """
    del folder
    for name in ("decisions", "serve", "repeat"):
        if type(config[name]) is not bool:
            raise ValueError(f"{name} must be true or false, got {config[name]!r}")
    check_number("queue_s", config.queue_s)
    detector = SlipDetector.load(config.model, backend=config.backend)
    settings = settings_of(config, detector)
    source, counts = _source(config, detector), Counts()
    events: SimpleQueue[Event] = SimpleQueue()
    dtype = source.dtype if isinstance(source, FileInTime) else torch.float64
    masked = config.masked_channels or ()
    watching = StreamingDetector(detector, settings, dtype=dtype, masked_channels=masked)
    log = logging.getLogger(StreamingDetector.__module__)
    with ExitStack() as stack, closing(source):
        stack.callback(log.setLevel, log.level)
        log.setLevel(logging.ERROR)  # an event says it
        stack.enter_context(_quick_threads())
        sinks: list[Sink] = [Callback(lambda alarm: None, _say)]
        if config.serve:
            page = _page(config, watching, source, counts, events)
            stack.callback(page.close)  # also where another sink cannot be made
            sinks.append(page)
            print(f"page: {page.address}", file=sys.stderr, flush=True)
        sinks += _logs(config, watching, source)
        if config.output is not None:
            options = {
                "every": config.decisions,
                "has_onset": settings.onset is not None,
                "sample_rate_hz": detector.pool.sample_rate_hz,
            }
            if config.output == "stdout":
                sinks.append(JsonLines(partial(print, end="", flush=True), **options))
            else:
                lines = LineServer(*address_of(str(config.output), "output="), events.put)
                stack.callback(lines.close)
                sinks.append(JsonLines(lines.write, **options))
                print(f"lines: {lines.host}:{lines.port}", file=sys.stderr, flush=True)
        try:
            watch(source, watching, sinks, queue_s=config.queue_s, counts=counts, events=events)
        except BrokenPipeError:  # whoever reads standard output has seen enough
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return counts
    if not counts.received:
        raise ValueError(
            f"{source.name} ended before a sample came; check that it sends, and say what it sends "
            "by frame.columns, frame.separator and so on (tactslip stream --help)"
        )
    return counts


def _source(config: DictConfig, detector: SlipDetector) -> Source:
    """Where samples come from."""
    return source_of(
        str(config.source),
        detector,
        Frames.of(plain_section(config.frame)),
        baud=config.baud,
        reading=reading_of(config, detector),
        speed=config.speed,
        repeat=config.repeat,
    )


def _logs(config: DictConfig, watching: StreamingDetector, source: Source) -> list[Sink]:
    """Files that samples and decisions are written to, and topics of ROS 2 beside the source's."""
    detector, settings = watching.detector, watching.settings
    known = source.recording if isinstance(source, FileInTime) else None
    about: dict[str, Any] = {"recording": known, "is_live": source.is_live}
    sinks: list[Sink] = [source.publisher()] if isinstance(source, RosTopic) else []
    if config.mcap is not None:
        pool, units = detector.pool, str(detector.info.get("units", "V"))
        parts = (Path(str(config.mcap)), pool.hand, pool.sample_rate_hz, settings)
        sinks.append(McapLog(*parts, units=units, dtype=watching.dtype, **about))
    return sinks


def _page(
    config: DictConfig,
    watching: StreamingDetector,
    source: Source,
    counts: Counts,
    events: SimpleQueue[Event],
) -> PageServer:
    """The page, served."""
    port, place = config.port, hosts_dir()
    if type(port) is not int or not 0 <= port < 1 << 16:
        raise ValueError(f"port must be a whole number from 0 to 65535, got {port!r}")
    return PageServer(
        {"": place / "web", "node": place / "node"},
        page_metadata(watching.detector, watching.settings),
        source=source.name,
        simulated=source.simulated,
        counts=counts,
        host=str(config.host),
        port=port,
        token=None if config.token is None else str(config.token),
        report=events.put,
    )


def _say(kind: str, text: str) -> None:
    with suppress(OSError):  # nobody reads it
        print(f"{kind}: {text}", file=sys.stderr, flush=True)


@contextmanager
def _quick_threads() -> Iterator[None]:
    before = sys.getswitchinterval()
    sys.setswitchinterval(_SWITCH_S)
    try:
        yield
    finally:
        sys.setswitchinterval(before)


main = entry_point("stream", stream, lambda config, folder, again: "all decisions are written")

"""A detector on samples as they come: sources, sinks, and the pump between them.

Example:
    >>> from tactslip_torch import SlipDetector, StreamingDetector
    >>> from tactslip_torch.live import Callback, Frames, SerialPort, watch
    >>> detector = SlipDetector.load("detector.pt")  # doctest: +SKIP
    >>> port = SerialPort("/dev/ttyACM0", Frames(), detector)  # doctest: +SKIP
    >>> watch(port, StreamingDetector(detector), [Callback(print)])  # doctest: +SKIP
"""

from tactslip_torch.live.frames import Frames
from tactslip_torch.live.pump import watch
from tactslip_torch.live.server import PageServer, page_metadata
from tactslip_torch.live.sinks import (
    Block,
    Callback,
    Counts,
    Event,
    JsonLines,
    LineServer,
    Sink,
    Source,
)
from tactslip_torch.live.sources import (
    FileInTime,
    SerialPort,
    StandardInput,
    TcpClient,
    TcpListener,
    source_of,
)

__all__ = [
    "Block",
    "Callback",
    "Counts",
    "Event",
    "FileInTime",
    "Frames",
    "JsonLines",
    "LineServer",
    "PageServer",
    "SerialPort",
    "Sink",
    "Source",
    "StandardInput",
    "TcpClient",
    "TcpListener",
    "page_metadata",
    "source_of",
    "watch",
]

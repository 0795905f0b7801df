"""A detector on samples as they come: sources, sinks, and the pump between them."""

from tactslip_torch.live.sinks import Block, Callback, Event, JsonLines, Sink
from tactslip_torch.live.sources import Source

__all__ = ["Block", "Callback", "Event", "JsonLines", "Sink", "Source"]

"""What is broken between the sensors and the file."""

from __future__ import annotations

from dataclasses import dataclass

from tactslip_torch.simulation.knobs.checks import require_finite


@dataclass(frozen=True)
class Faults:
    """Broken channels and lost samples; the truth about the contact is not touched.

    Args:
        dead: channels of which nothing but the converter's zero is recorded.
        saturated: channels that stand at the upper rail.
        swapped: pairs of channels whose cables are exchanged.
        drops_per_s: losses of samples a second, in all channels at once; the last sample before
            a loss is repeated until it ends, as data loggers do.
        drop_ms: range of their length; log-uniform, at most 200 ms.

    Raises:
        ValueError: if a knob is negative or not finite, a pair is not two channels, a channel has
            two faults, or losses may be longer than 200 ms.
    """

    dead: tuple[str, ...] = ()
    saturated: tuple[str, ...] = ()
    swapped: tuple[tuple[str, str], ...] = ()
    drops_per_s: float = 0.0
    drop_ms: tuple[float, float] = (1.0, 50.0)

    def __post_init__(self) -> None:
        require_finite(self)
        if self.drop_ms[1] > 200:
            raise ValueError(f"Faults.drop_ms must be at most 200, got {self.drop_ms}")
        for pair in self.swapped:
            if len(pair) != 2 or pair[0] == pair[1]:
                raise ValueError(f"Faults.swapped takes pairs of channels, got {pair}")
        named = self.names
        twice = sorted({name for name in named if named.count(name) > 1})
        if twice:
            raise ValueError(f"Faults names {', '.join(twice)} twice; a channel has one fault")

    @property
    def names(self) -> tuple[str, ...]:
        """Channels with a fault of their own."""
        return (*self.dead, *self.saturated, *(name for pair in self.swapped for name in pair))

"""Many recordings at once: their lanes are integrated side by side, on any device.

``simulate`` is the batch of one. The compiled engine carries lanes by 16, which the elements of
one recording nearly fill, so there a batch saves little; the eager engine makes few large calls of
what would be many small ones.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import torch

from tactslip_torch.data.recording import Recording
from tactslip_torch.simulation.dynamics.contact import given
from tactslip_torch.simulation.dynamics.stepper import EngineName
from tactslip_torch.simulation.dynamics.traces import traces_of
from tactslip_torch.simulation.scene import Scene
from tactslip_torch.simulation.simulate import simulate


def simulate_many(
    scenes: Iterable[Scene],
    *,
    windows: Sequence[Sequence[tuple[float, float]] | None] | None = None,
    channels: Iterable[str] | None = None,
    device: torch.device | str = "cpu",
    dtype: torch.dtype = torch.float64,
    engine: EngineName = "auto",
    at_once: int = 32,
) -> Iterator[Recording]:
    """The recordings of several scenes, in their order, each when it is asked for.

    On the CPU in float64, engine ``"auto"``, each has the bytes that ``simulate`` gives it; by the
    eager engine, in float32 or on a GPU what it differs by is the integration's rounding.

    Args:
        scenes: of any rungs; those of the kinematic one are simulated one by one.
        windows: of every scene, as ``simulate`` takes them; ``None`` for all of all.
        channels: names of the channels to compute, ``None`` for all.
        device: where lanes are integrated; sensors are simulated on the CPU.
        dtype: in which lanes are integrated, float32 or float64; samples are float32.
        engine: ``"compiled"`` or ``"eager"``, ``"auto"`` for what there is.
        at_once: how many recordings are integrated together.

    Raises:
        ValueError: as ``simulate``; or if there are not as many windows as scenes, or ``at_once``
            is not positive.

    Example:
        >>> scenes = [Scene("M2", fidelity="lugre", cycle=cycle) for cycle in range(2)]
        >>> [len(recording.onsets_s) for recording in simulate_many(scenes, channels=["SG1"])]
        [3, 3]
    """
    scenes = list(scenes)
    if at_once < 1:
        raise ValueError(f"at_once must be at least 1, got {at_once}")
    if windows is not None and len(windows) != len(scenes):
        raise ValueError(f"expected windows of each of {len(scenes)} scenes, got {len(windows)}")
    named = None if channels is None else [channels] if isinstance(channels, str) else [*channels]
    wanted = [None] * len(scenes) if windows is None else list(windows)
    return _recordings(scenes, wanted, named, torch.device(device), dtype, engine, at_once)


def _recordings(
    scenes: list[Scene],
    windows: Sequence[Sequence[tuple[float, float]] | None],
    channels: list[str] | None,
    device: torch.device,
    dtype: torch.dtype,
    engine: EngineName,
    at_once: int,
) -> Iterator[Recording]:
    for start in range(0, len(scenes), at_once):
        part = scenes[start : start + at_once]
        dynamic = list(dict.fromkeys(scene for scene in part if scene.fidelity != "kinematic"))
        found = traces_of(dynamic, device=device, dtype=dtype, engine=engine)
        traces = dict(zip(dynamic, found, strict=True))
        for scene, wanted in zip(part, windows[start : start + at_once], strict=True):
            with given(traces):
                recording = simulate(scene, windows=wanted, channels=channels)
            yield recording

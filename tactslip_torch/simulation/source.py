"""Sets of simulated recordings, each made when asked for."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from tactslip_torch.data.recording import Recording, RecordingId
from tactslip_torch.hand import HandLayout
from tactslip_torch.simulation.dynamics.stepper import integrator
from tactslip_torch.simulation.materials import SEEN_MATERIALS, UNSEEN_MATERIALS
from tactslip_torch.simulation.scene import PAPER, paper_scenes
from tactslip_torch.simulation.simulate import simulate
from tactslip_torch.simulation.timeline import Timeline, timeline


class SimulatedRecordings:
    """A ``RecordingSource`` of simulated scenes: the paper's, another, or several kinds.

    Args:
        seed: of the whole set.
        cycles: recordings per material and kind of scene.
        materials: ids in ``MATERIALS``.
        channels: rows for ``HandLayout.from_rows``; ``None`` for the paper's hand.
        fidelity: the rung to simulate on, one of ``FIDELITIES``.
        scene: overrides of any knob of the scenes; ``name`` is the kind they are.
        others: further kinds of scenes by name, with their overrides; ``cycles`` among them is
            the kind's own number. They start from the same knobs as ``scene``.

    Raises:
        ValueError: as ``paper_scenes``.

    Example:
        >>> source = SimulatedRecordings(
        ...     cycles=2, materials=["M1"], others={"noisy": {"machine_mv": 20.0, "cycles": 1}}
        ... )
        >>> [str(recording) for recording in source.ids]
        ['M1/0', 'M1/1', 'M1/0/noisy']
    """

    is_simulated = True

    def __init__(
        self,
        *,
        seed: int = 0,
        cycles: int = 28,
        materials: Iterable[str] = SEEN_MATERIALS + UNSEEN_MATERIALS,
        channels: Iterable[Mapping[str, str]] | None = None,
        fidelity: str = "kinematic",
        scene: Mapping[str, Any] | None = None,
        others: Mapping[str, Mapping[str, Any]] | None = None,
    ) -> None:
        self.hand = HandLayout.paper24() if channels is None else HandLayout.from_rows(channels)
        base = {"fidelity": fidelity, "name": PAPER, **(scene or {})}
        materials = tuple(materials)
        scenes = paper_scenes(seed=seed, cycles=cycles, materials=materials, hand=self.hand, **base)
        for name, knobs in (others or {}).items():
            own = {**base, "cycles": cycles, **knobs, "name": name}
            scenes += paper_scenes(seed=seed, materials=materials, hand=self.hand, **own)
        self._scenes = {RecordingId(s.material, s.cycle, s.name): s for s in scenes}
        self.ids = tuple(self._scenes)
        self.sample_rate_hz = scenes[0].sample_rate_hz if scenes else 2000.0

    def timeline(self, recording: RecordingId) -> Timeline:
        """When things happen, without a sample being simulated."""
        return timeline(self._scenes[recording])

    def key(self, recording: RecordingId) -> Mapping[str, Any]:
        """The scene as plain values and, on a dynamic rung, what integrates it here."""
        scene = self._scenes[recording]
        if scene.fidelity == "kinematic":
            return scene.to_dict()
        return {**scene.to_dict(), "integrator": integrator()}

    def load(
        self, recording: RecordingId, windows: Sequence[tuple[float, float]] | None = None
    ) -> Recording:
        """Simulate the recording, or the stretches of it that are asked for."""
        return simulate(self._scenes[recording], windows=windows)

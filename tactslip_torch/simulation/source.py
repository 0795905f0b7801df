"""Sets of simulated recordings, each made when asked for."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import Any

from tactslip_torch.data.recording import Recording, RecordingId
from tactslip_torch.hand import HandLayout
from tactslip_torch.simulation._bristles import integrator
from tactslip_torch.simulation.scene import (
    PAPER,
    SEEN_MATERIALS,
    UNSEEN_MATERIALS,
    Scene,
    paper_scenes,
)
from tactslip_torch.simulation.simulate import Timeline, simulate, timeline


class SimulatedRecordings:
    """A ``RecordingSource`` of simulated scenes: the paper's, another, or several kinds.

    Args:
        seed: of the whole set.
        cycles: recordings per material, session and kind of scene.
        materials: ids in ``MATERIALS``.
        channels: rows for ``HandLayout.from_rows``; ``None`` for the paper's hand.
        fidelity: of the contact, one of ``FIDELITIES``.
        scene: overrides of any parameter of the scenes; ``name`` is the kind they are.
        extra_scenes: further kinds of scenes by name, with their overrides; ``cycles`` among them
            is the kind's own number. They start from the same parameters as ``scene``.
        sessions: mountings of every material, each with all its cycles and kinds of scenes. The
            first one's recordings are those of a set with one session; further ones are named
            "2", "3" and so on, and draw everything that belongs to a mounting again: noise floor,
            mains, gains, offsets, load shares, couplings, skin, and the surface's own sample.

    Raises:
        ValueError: as ``paper_scenes``; or if there is no session.

    Example:
        >>> noisy = {"machine_mv": 20.0, "cycles": 1}
        >>> source = SimulatedRecordings(
        ...     cycles=2, materials=["M1"], extra_scenes={"noisy": noisy}
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
        extra_scenes: Mapping[str, Mapping[str, Any]] | None = None,
        sessions: int = 1,
    ) -> None:
        if sessions < 1:
            raise ValueError(f"data.sessions must be at least 1, got {sessions}")
        self.hand = HandLayout.paper24() if channels is None else HandLayout.from_rows(channels)
        base = {"fidelity": fidelity, "name": PAPER, **(scene or {})}
        kinds = [{**base, "cycles": cycles}]
        kinds += [
            {**kinds[0], **changes, "name": name} for name, changes in (extra_scenes or {}).items()
        ]
        materials = tuple(materials)
        self._scenes: dict[RecordingId, Scene] = {}
        for session, kind in product(["", *map(str, range(2, sessions + 1))], kinds):
            for one in paper_scenes(seed=seed, materials=materials, hand=self.hand, **kind):
                mounting = f"{one.session}/{session}" if session else one.session
                name = RecordingId(one.material, one.cycle, one.name, session)
                self._scenes[name] = replace(one, session=mounting)
        self.ids = tuple(self._scenes)
        first = next(iter(self._scenes.values()), None)
        self.sample_rate_hz = 2000.0 if first is None else first.sample_rate_hz

    def timeline(self, recording: RecordingId) -> Timeline:
        """When things happen, without a sample being simulated."""
        return timeline(self._scenes[recording])

    def key(self, recording: RecordingId) -> Mapping[str, Any]:
        """The scene as plain values and, with bristles, what integrates it here."""
        scene = self._scenes[recording]
        if scene.fidelity == "kinematic":
            return scene.to_dict()
        return {**scene.to_dict(), "integrator": integrator()}

    def load(
        self, recording: RecordingId, windows: Sequence[tuple[float, float]] | None = None
    ) -> Recording:
        """Simulate the recording, or the intervals of it that are asked for."""
        return simulate(self._scenes[recording], windows=windows)

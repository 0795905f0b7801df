"""From a detector to a promise: at most so many false alarms an hour, and how late alarms come.

Behind the fit, on recordings that were not trained on. Half of the seen materials' cycles
*calibrate*: score to log likelihood ratio, the threshold of every rule, how far an onset lies back.
The other half and the unseen materials say what became of it. Nothing of them sets anything.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from tactslip_torch.alarming.curve import threshold_curve
from tactslip_torch.alarming.methods import FITS, Promise, methods_of
from tactslip_torch.alarming.outcome import amounts_of, events_of, push_seconds, reliability_of
from tactslip_torch.alarming.watching import Clock, Stream, watch
from tactslip_torch.data.labels import whole_samples
from tactslip_torch.data.recording import RecordingId, RecordingSource
from tactslip_torch.data.splits import PAPER_SCENE
from tactslip_torch.features.cache import cache_key
from tactslip_torch.model.calibration import Platt
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.onset.scoring import Scorer
from tactslip_torch.onset.sequential import Rule, rule_from_dict
from tactslip_torch.onset.settings import KEY, AlarmSettings

log = logging.getLogger(__name__)

OURS = "detector"
"""The name of the detector among those that watch."""

FIRST_TRANSITION = "first transition"
"""The name of the paper's rule."""


@dataclass(frozen=True)
class Alarming:
    """The stage behind the fit.

    Args:
        streams: recordings, those trained on among them or not; of the paper's scene, without
            slip, and of others to be fooled by.
        hop_ms: distance of two decisions.
        false_alarms_per_hour: the promise.
        hours: of recordings without slip, at most, to set thresholds on, and as many to check
            them on, for seen and for unseen materials.
        slip_free: the scene without slip.
        rules: of ``onset.sequential``, by name.
        rule: the one that the detector's file gets; those of baselines are like it.
        calibration: ``"platt"`` or ``"isotonic"``.
        slip_share: how much of a stream is slip, for probabilities.
        rearm_s: how long the statistic must stay low before the next alarm.
        refractory_s: shortest time between two alarms.
        level: of intervals.

    Raises:
        ValueError: for a rule, calibration or scene that is not there, a hop that is no whole
            number of samples, or a number out of range.
    """

    streams: RecordingSource
    hop_ms: float
    false_alarms_per_hour: float
    hours: float
    slip_free: str
    rules: Mapping[str, Mapping[str, Any]]
    rule: str
    calibration: str = "platt"
    slip_share: float = 0.5
    rearm_s: float = 0.1
    refractory_s: float = 0.2
    level: float = 0.95

    def __post_init__(self) -> None:
        if self.rule not in self.rules:
            raise ValueError(
                f"onset.rule must be one of {', '.join(self.rules)}, got {self.rule!r}"
            )
        if self.calibration not in FITS:
            raise ValueError(
                f"onset.calibration must be one of {', '.join(FITS)}, got {self.calibration!r}"
            )
        for name in ("hop_ms", "false_alarms_per_hour", "hours"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"onset.{name} must be positive, got {getattr(self, name)}")
        if not 0 < self.level < 1:
            raise ValueError(f"onset.level must lie between 0 and 1, got {self.level}")
        scenes = {recording.scene for recording in self.streams.ids}
        if self.slip_free not in scenes:
            raise ValueError(
                f"onset.slip_free must be a scene of onset.streams, {', '.join(sorted(scenes))}, "
                f"got {self.slip_free!r}"
            )
        for rule in self.made_rules(self.hop_samples).values():  # bad numbers are refused now
            AlarmSettings(
                self.hop_samples,
                Platt(1.0, 0.0),
                rule,
                math.inf,
                self.false_alarms_per_hour,
                self.slip_share,
                self.rearm_s,
                self.refractory_s,
            )

    @property
    def hop_samples(self) -> int:
        """Distance of two decisions."""
        return whole_samples(self.hop_ms, self.streams.sample_rate_hz, "onset.hop_ms")

    def made_rules(self, bin_samples: int) -> dict[str, Rule]:
        """The rules; where they leave it open, evidence is hop / bin and the hop is ours."""
        made = {}
        for name, given in self.rules.items():
            numbers = dict(given)
            if numbers.get("evidence", 1) is None:
                numbers["evidence"] = min(1.0, self.hop_samples / bin_samples)
            if numbers.get("name") == "bayes":
                numbers["hop_s"] = self.hop_samples / self.streams.sample_rate_hz
            made[name] = rule_from_dict(numbers)
        return made

    def roles(self, detector: SlipDetector) -> dict[str, list[RecordingId]]:
        """Which recordings calibrate, and which are judged, seen and unseen.

        Every second cycle of a seen material calibrates, of the paper's scene and the one without
        slip; nothing that was trained on has a role.

        Raises:
            ValueError: if there is no recording to calibrate on.
        """
        trained = set(detector.info.get("train_recordings", {}).values())
        seen = set(detector.info.get("train_materials", ()))
        roles: dict[str, list[RecordingId]] = {"calibrate": [], "test": [], "unseen": []}
        places: dict[tuple[str, str], int] = {}
        hours = dict.fromkeys(roles, 0.0)
        fresh = [r for r in self.streams.ids if cache_key(self.streams.key(r)) not in trained]
        for recording in sorted(fresh, key=lambda r: (r.scene, r.cycle, r.material)):
            of = (recording.material, recording.scene)
            place = places[of] = places.get(of, -1) + 1
            role = "unseen" if recording.material not in seen else "test"
            if (
                role == "test"
                and recording.scene in (PAPER_SCENE, self.slip_free)
                and place % 2 == 0
            ):
                role = "calibrate"
            if recording.scene == self.slip_free:
                if hours[role] >= self.hours:
                    continue
                hours[role] += self.streams.timeline(recording).duration_s / 3600
            roles[role].append(recording)
        for role, found in hours.items():
            if 0 < found < self.hours:
                log.warning(
                    "%s has %.2f h of %s, onset.hours=%g were asked for: give onset.streams more",
                    role,
                    found,
                    self.slip_free,
                    self.hours,
                )
        for scene in (PAPER_SCENE, self.slip_free):
            if not any(recording.scene == scene for recording in roles["calibrate"]):
                raise ValueError(
                    f"no recording of scene {scene} that was not trained on is left to calibrate "
                    "on; give onset.streams more cycles of it"
                )
        return roles

    def __call__(
        self,
        detector: SlipDetector,
        others: Mapping[str, Scorer] | None = None,
        num_workers: int | None = None,
    ) -> dict[str, Any]:
        """Set the alarm of a detector, in its ``info``, and say what became of it.

        Args:
            detector: fitted.
            others: baselines by name, which are calibrated and judged alike.
            num_workers: processes that watch.

        Returns:
            JSON-able: ``"rule"``, ``"settings"`` of it, ``"sample_rate_hz"``; ``"streams"``,
            recordings, hours and slips of each role and scene; ``"methods"``; ``"reliability"`` of
            each role; ``"events"`` of the protocol and its quiet, by role and method;
            ``"scenes"``, the same of every other scene by role, and whether it was ``"trained"``
            on.

        Raises:
            ValueError: if there is nothing to calibrate on.
        """
        roles = self.roles(detector)
        role_of = {recording: role for role, own in roles.items() for recording in own}
        scorers: dict[str, Scorer] = {OURS: detector, **(others or {})}
        streams: dict[str, list[Stream]] = {role: [] for role in roles}
        for stream in watch(self.streams, list(role_of), scorers, self.hop_samples, num_workers):
            streams[role_of[stream.recording]].append(stream)
        rate = self.streams.sample_rate_hz
        clocks = {
            name: Clock(rate, self.hop_samples, scorer.pool.bin_samples, scorer.look_ahead)
            for name, scorer in scorers.items()
        }
        calibrating = streams.pop("calibrate")
        methods = methods_of(
            self.promise(),
            self.made_rules(detector.pool.bin_samples),
            self.rule,
            self.calibration,
            calibrating,
            clocks,
            OURS,
            FIRST_TRANSITION,
        )
        amounts = amounts_of({"calibrate": calibrating, **streams})
        settings = methods[self.rule].settings
        quiet = [stream for stream in calibrating if stream.recording.scene == self.slip_free]
        facts = {
            "simulated": self.streams.is_simulated,
            "streams": amounts["calibrate"],
            "threshold_curve": threshold_curve(quiet, OURS, settings, clocks[OURS]),
        }
        settings = replace(settings, facts={**settings.facts, **facts})
        detector.info[KEY] = settings.to_dict()
        usual, scenes = self._parts(streams)
        compute_s = {OURS: push_seconds(detector, settings)}
        parts = {**usual, **{f"{role}/{scene}": own for (role, scene), own in scenes.items()}}
        events = events_of(parts, methods, clocks, compute_s, self.level)
        trained = {
            name.split("/")[2]
            for name in detector.info.get("train_recordings", {})
            if name.count("/") > 1
        }
        return {
            "rule": self.rule,
            "sample_rate_hz": rate,
            "settings": settings.to_dict(),
            "streams": amounts,
            "methods": {name: method.to_dict() for name, method in methods.items()},
            "reliability": reliability_of(usual, OURS, settings, clocks[OURS]),
            "events": {part: events[part] for part in usual},
            "scenes": {
                scene: {
                    "trained": scene in trained,
                    **{r: events[f"{r}/{s}"] for r, s in scenes if s == scene},
                }
                for scene in dict.fromkeys(scene for _, scene in scenes)
            },
        }

    def promise(self) -> Promise:
        """What thresholds are set for."""
        return Promise(
            self.false_alarms_per_hour,
            self.slip_free,
            self.slip_share,
            self.rearm_s,
            self.refractory_s,
            self.level,
        )

    def _parts(
        self, streams: Mapping[str, list[Stream]]
    ) -> tuple[dict[str, list[Stream]], dict[tuple[str, str], list[Stream]]]:
        """The protocol and its quiet by role, and every other scene by role and scene."""
        usual: dict[str, list[Stream]] = {}
        scenes: dict[tuple[str, str], list[Stream]] = {}
        for role, own in streams.items():
            for stream in own:
                scene = stream.recording.scene
                if scene in (PAPER_SCENE, self.slip_free):
                    usual.setdefault(f"{role} stream", []).append(stream)
                else:
                    scenes.setdefault((role, scene), []).append(stream)
        return usual, scenes

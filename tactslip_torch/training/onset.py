"""Fits the onset classifier: hops in which a slip begins against all that is no beginning.

Negatives are what robots hear: holding, handling (taps, grips, the carrying arm), machines, mains,
the moment before an onset, and steady sliding, which is the business of the classifier of bins.
Each of these, of each scene, weighs alike, and so do onsets of each scene. The loudest hops of each
kind of negative are a kind of their own: a knock while a grip is changed is rare, and like a slip.

What cannot be known beforehand is chosen by leaving out each material: the penalty and the length
of the comb that suppresses mains. The measure is how many onset hops score above all but
``_FALSE_SHARE`` of the hops of every kind of negative.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tactslip_torch.data.recording import RecordingId, RecordingSource, Timeline
from tactslip_torch.model.fit import TrainingBins
from tactslip_torch.model.kernels import Polynomial, QuadraticForm
from tactslip_torch.model.leave_one_group_out import HeldOut
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.onset.events import first_releases
from tactslip_torch.onset.evidence import OnsetClassifier, OnsetEvidence
from tactslip_torch.runtime import in_processes

log = logging.getLogger(__name__)

ONSET_S = (0.002, 0.030)
"""Behind an onset, in which hops are positive."""
_KNOWN_S = 0.1  # behind an onset, from which on sliding is known; and behind a slide, until rest
_BEFORE_S = 0.3  # before a slip, a kind of negatives of its own
_MOST_HOPS = 250  # of a recording and kind
_MOST_LOUD = 300  # likewise
_FALSE_SHARE = 1e-3
_KERNEL = Polynomial(2)
_FAST_KNEE, _SLOW_KNEE = 0.1, 1.0  # of what is usual in training
_LEAST_KNEE = 1e-30
_KNEE_RECORDINGS = 12
_TAIL = 0.001  # of hops whose columns are clipped at either end
_ONSET = "onset"
_FOLDS = 5  # of cycles, where there is one material
Array = NDArray[np.float64]


@dataclass(frozen=True)
class OnsetTraining:
    """How an onset classifier is fitted.

    Args:
        hop_ms: between its decisions, at most 5.
        penalties: the paper's ``C``, to choose from.
        comb_periods: of the mains, to choose from.
        mains_hz: nominal.
    """

    hop_ms: float = 5.0
    penalties: Sequence[float] = (1.0, 10.0, 100.0)
    comb_periods: Sequence[int] = (1, 4)
    mains_hz: float = 50.0

    def __call__(
        self,
        source: RecordingSource,
        recordings: Sequence[RecordingId],
        num_workers: int | None = None,
    ) -> tuple[OnsetClassifier, dict[str, Any]]:
        """Fit on some recordings; the threshold is left at infinity.

        Args:
            source: of the recordings.
            recordings: of several materials, or of one in several cycles.
            num_workers: processes.

        Returns:
            The classifier, and JSON-able what was chosen from what.

        Raises:
            ValueError: if there is no recording, or no slip begins in them.
        """
        if not recordings:
            raise ValueError(
                "no recording is left to learn onsets from; give onset.streams more cycles"
            )
        hop_samples = round(self.hop_ms * 1e-3 * source.sample_rate_hz)
        evidences = [
            OnsetEvidence(
                source.hand,
                source.sample_rate_hz,
                hop_samples,
                mains_hz=self.mains_hz,
                comb_periods=periods,
            )
            for periods in self.comb_periods
        ]
        some = recordings[:: -(-len(recordings) // _KNEE_RECORDINGS)]
        usual = partial(_knees, source, evidences)
        knees = list(in_processes(usual, some, "onsets, scales", "recording", num_workers))
        for place, evidence in enumerate(evidences):
            fast, slow = (
                tuple(np.maximum(np.median(np.stack(of), 0), _LEAST_KNEE).tolist())
                for of in zip(*(k[place] for k in knees), strict=True)
            )
            evidences[place] = replace(evidence, fast_knee=fast, slow_knee=slow)
        read = partial(_hops, source, evidences)
        made = list(in_processes(read, recordings, "onsets, evidence", "recording", num_workers))
        kinds = [kind for _, own in made for kind in own]
        is_onset = np.array([kind.startswith(_ONSET) for kind in kinds], bool)
        if not is_onset.any():
            raise ValueError("no slip begins in the recordings that onsets are learned from")
        names = [r.material for r in recordings]
        if len(set(names)) == 1:
            names = [str(r.cycle % _FOLDS) for r in recordings]
        place_of = {name: number for number, name in enumerate(dict.fromkeys(names))}
        groups = torch.tensor(
            [place_of[name] for name, (_, own) in zip(names, made, strict=True) for _ in own]
        )
        weights = _weights(kinds, is_onset)
        tried, best = [], None
        for place, evidence in enumerate(evidences):
            columns = torch.from_numpy(np.concatenate([own[place] for own, _ in made]))
            scaler = FeatureScaler.fit(columns, tail=_TAIL)
            bins = TrainingBins(scaler(columns), torch.from_numpy(is_onset), weights)
            held_out = HeldOut(bins, groups, _KERNEL)
            for penalty in self.penalties:
                try:
                    fit = held_out.at(penalty)
                except ValueError as error:  # too close to singular to be told
                    log.warning("onset.classifier.penalties: %s", error)
                    continue
                found = _found_share(fit.scores, kinds)
                periods = evidence.comb_periods
                tried.append({"comb_periods": periods, "penalty": penalty, "found": found})
                if best is None or found > best[0]:
                    assert isinstance(fit.head, QuadraticForm)
                    best = found, OnsetClassifier(evidence, scaler, fit.head, float("inf"))
        if best is None:
            raise ValueError("no penalty of onset.classifier.penalties can be told; lower them")
        counts = {kind: kinds.count(kind) for kind in dict.fromkeys(kinds)}
        return best[1], {"tried": tried, "hops": counts}


def _knees(
    source: RecordingSource, evidences: Sequence[OnsetEvidence], recording: RecordingId
) -> list[tuple[Array, Array]]:
    """By evidence, a tenth of the usual root power of each filter, and the usual step."""
    samples, found = source.load(recording).samples, []
    for evidence in evidences:
        blocks = evidence.blocks_of_recording(samples)
        steps = blocks.mean.unfold(-1, len(evidence.step_matrix), 1) @ evidence.step_matrix
        fast = blocks.power.sqrt().transpose(0, 1).flatten(1).nanmedian(-1).values
        if not source.hand.slow:
            steps = torch.zeros(1, 1, steps.shape[-1])
        slow = steps.abs().flatten(0, 1).nanmedian(0).values
        found.append((_FAST_KNEE * fast.numpy(), _SLOW_KNEE * slow.numpy()))
    return found


def _hops(
    source: RecordingSource, evidences: Sequence[OnsetEvidence], recording: RecordingId
) -> tuple[list[Array], list[str]]:
    """The hops of a recording that are learned from: evidence ``[N, K]`` each, and their kinds."""
    samples = source.load(recording).samples
    made = [evidence.columns(evidence.blocks_of_recording(samples)) for evidence in evidences]
    num = min(len(columns) for columns, _ in made)  # a longer comb begins later
    usable = torch.stack([is_usable[-num:] for _, is_usable in made]).all(0).numpy()
    evidence = evidences[0]
    last = samples.shape[-1] // evidence.hop_samples
    time_s = np.arange(last - num + 1, last + 1) * evidence.hop_samples / evidence.sample_rate_hz
    loudness = made[0][0][-num:, : len(evidence.fast_knee)].amax(1).numpy()
    places, kinds = list[NDArray[np.int64]](), list[str]()
    for kind, is_kind in kinds_of(source.timeline(recording), time_s, recording.scene).items():
        place = np.flatnonzero(is_kind & usable)
        if not kind.startswith(_ONSET):
            loudest = place[np.argsort(-loudness[place], kind="stable")[:_MOST_LOUD]]
            places.append(loudest)
            kinds += [f"loud {kind}"] * len(loudest)
        if len(place) > _MOST_HOPS:
            place = place[np.linspace(0, len(place) - 1, _MOST_HOPS).astype(int)]
        places.append(place)
        kinds += [kind] * len(place)
    chosen = np.concatenate(places)
    return [columns[-num:].numpy()[chosen] for columns, _ in made], kinds


def kinds_of(
    times: Timeline, time_s: NDArray[np.float64], scene: str
) -> dict[str, NDArray[np.bool_]]:
    """Which hops are learned as what; the others are not.

    Between the first release and ``ONSET_S`` behind the onset nobody can say.

    Args:
        times: what is true of the recording.
        time_s: ends of hops.
        scene: of the recording.

    Shape:
        - time_s, masks: ``[N]``
    """
    firsts = first_releases(times.onsets_s, times.released_s)
    onset, before, slide, unclear = (np.zeros(len(time_s), bool) for _ in range(4))
    for first, onset_s, (_, end) in zip(firsts, times.onsets_s, times.sliding_s, strict=True):
        since = time_s - onset_s
        onset |= (since >= ONSET_S[0]) & (since <= ONSET_S[1])
        unclear |= (time_s > first) & (since < ONSET_S[0])
        unclear |= (since > ONSET_S[1]) & (since < _KNOWN_S)
        unclear |= (time_s > end) & (time_s <= end + _KNOWN_S)
        slide |= (since >= _KNOWN_S) & (time_s <= end)
        before |= (time_s > first - _BEFORE_S) & (time_s <= first)
    for start, end in times.slip_s:
        unclear |= (time_s > start) & (time_s <= end + _KNOWN_S)
    handled = np.zeros(len(time_s), bool)
    for start, end in times.non_slip_s:
        handled |= (time_s > start) & (time_s <= end)
    negative = ~(onset | unclear)
    rest = negative & ~slide & ~before
    return {
        f"{_ONSET} {scene}": onset,
        "before": negative & before & ~slide,
        "slide": negative & slide,
        f"handled {scene}": rest & handled,
        f"rest {scene}": rest & ~handled,
    }


def _weights(kinds: Sequence[str], is_onset: NDArray[np.bool_]) -> Tensor:
    """Of each hop: kinds alike, onsets and the others alike; 1 in the mean."""
    _, index = np.unique(kinds, return_inverse=True)
    each = 1.0 / np.bincount(index)[index]
    for mask in (is_onset, ~is_onset):
        each[mask] /= each[mask].sum()
    return torch.from_numpy(each * len(each) / 2)


def _found_share(scores: Tensor, kinds: Sequence[str]) -> float:
    """Of onset hops, kinds alike, those above all but ``_FALSE_SHARE`` of every negative kind."""
    of_kind: dict[str, list[float]] = {}
    for kind, score in zip(kinds, scores.tolist(), strict=True):
        of_kind.setdefault(kind, []).append(score)
    onsets = {kind: np.array(own) for kind, own in of_kind.items() if kind.startswith(_ONSET)}
    threshold = max(
        np.quantile(own, 1 - _FALSE_SHARE) for kind, own in of_kind.items() if kind not in onsets
    )
    return float(np.mean([(own >= threshold).mean() for own in onsets.values()]))

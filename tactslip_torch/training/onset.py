"""Fits the onset classifier: hops in which a slip begins against all others.

Negatives are holding, handling, machines, mains, the moment before an onset, and steady sliding;
each kind of each scene weighs alike, and so do onsets of each scene. Hard negatives of the first
pass get their own class weight in the second.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tactslip_torch.data.recording import RecordingId, RecordingSource, Timeline
from tactslip_torch.features.sensing import SILENT_FRACTION
from tactslip_torch.hand import HandLayout
from tactslip_torch.model.fit import TrainingBins, fit_machine
from tactslip_torch.model.kernels import Polynomial
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.onset.events import first_releases
from tactslip_torch.onset.evidence import OnsetClassifier, OnsetEvidence
from tactslip_torch.runtime import check_number, in_processes

ONSET_S = (0.002, 0.030)
"""Behind an onset, in which hops are positive."""
_KNOWN_S = 0.1  # behind an onset, from which on sliding is known; and behind a slide, until rest
_BEFORE_S = 0.3  # before a slip, a kind of negatives of its own
_MOST_HOPS, _MOST_LIKE = 20, 60  # of a recording and kind: at even distances; most like a slip
_FIRST_HOPS, _FIRST_RECORDINGS = 100, 60  # of the first machine
_KERNEL = Polynomial(2)
_FAST_SCALE, _SLOW_SCALE = 0.1, 1.0  # of what is usual in training
_LEAST_SCALE = 1e-30
_SCALE_RECORDINGS = 12
_TAIL = 0.001  # of hops whose columns are clipped at either end
_ONSET = "onset"
Array = NDArray[np.float64]


@dataclass(frozen=True)
class OnsetTraining:
    """How an onset classifier is fitted.

    Args:
        hop_ms: between its decisions, at most 5.
        penalty: the paper's ``C``, of hops whose weights sum to 1.
        comb_periods: of the mains, over which the comb takes the mean.
        mains_hz: nominal.
        scenes: kinds of recordings that it is fitted on, where others are there too.
        cycles: recordings of each material and scene, at most, that it is fitted on then.

    Raises:
        ValueError: if the number of cycles is not positive.
    """

    hop_ms: float = 5.0
    penalty: float = 2e4
    comb_periods: int = 1
    mains_hz: float = 50.0
    scenes: Sequence[str] = ()
    cycles: int = 4

    def __post_init__(self) -> None:
        check_number("onset.classifier.cycles", self.cycles, whole=True)

    def evidence(self, hand: HandLayout, sample_rate_hz: float) -> OnsetEvidence:
        """What decisions are made of, before its scales are learned.

        Raises:
            ValueError: if the hand has no fast channel, or the rate no such hop.
        """
        return OnsetEvidence(
            hand,
            sample_rate_hz,
            round(self.hop_ms * 1e-3 * sample_rate_hz),
            mains_hz=self.mains_hz,
            comb_periods=self.comb_periods,
        )

    def __call__(
        self,
        source: RecordingSource,
        recordings: Sequence[RecordingId],
        num_workers: int | None = None,
    ) -> tuple[OnsetClassifier, dict[str, OnsetClassifier], dict[str, int]]:
        """Fit on some recordings; thresholds are left at infinity.

        Args:
            source: of the recordings.
            recordings: with slips among them.
            num_workers: processes.

        Returns:
            The classifier; for each material, one that was fitted without it, on the hops that were
            chosen with it; and how many hops of each kind the first was fitted on.

        Raises:
            ValueError: if there is no recording, or no slip begins in them.
        """
        if not recordings:
            raise ValueError(
                "no recording is left to learn onsets from; give onset.streams more cycles"
            )
        evidence = self.evidence(source.hand, source.sample_rate_hz)
        usual, some = (
            partial(_compression_scales, source, evidence),
            _some(recordings, _SCALE_RECORDINGS),
        )
        scales = in_processes(usual, some, "onsets, scales", "recording", num_workers)
        *usual_of, rms = zip(*scales, strict=True)
        fast, slow = (
            tuple(np.maximum(np.median(np.stack(of), 0), _LEAST_SCALE).tolist()) for of in usual_of
        )
        least = SILENT_FRACTION * np.min(np.stack(rms), 0)
        evidence, first = replace(evidence, fast_compression=fast, slow_compression=slow), None
        evidence = replace(evidence, least_rms=tuple(map(tuple, least.tolist())))
        for own in (_some(recordings, _FIRST_RECORDINGS), recordings):
            read = partial(_hops, source, evidence, first)
            made = list(in_processes(read, own, "onsets, evidence", "recording", num_workers))
            columns = torch.from_numpy(np.concatenate([found for found, _ in made]))
            kinds = np.array([kind for _, of_recording in made for kind in of_recording])
            first = self._fit(evidence, columns, kinds)
        assert first is not None
        of = np.repeat([one.material for one in own], [len(found) for found, _ in made])
        materials = np.unique(of)
        left_out = {
            str(material): self._fit(evidence, columns[of != material], kinds[of != material])
            for material in (materials if len(materials) > 1 else ())
        }
        names, counts = np.unique(kinds, return_counts=True)
        return first, left_out, dict(zip(names.tolist(), counts.tolist(), strict=True))

    def _fit(
        self, evidence: OnsetEvidence, columns: Tensor, kinds: NDArray[np.str_]
    ) -> OnsetClassifier:
        is_onset = np.char.startswith(kinds, _ONSET)
        if not is_onset.any():
            raise ValueError("no slip begins in the recordings that onsets are learned from")
        scaler = FeatureScaler.fit(columns, tail=_TAIL)
        weights = _weights(kinds, is_onset)
        bins = TrainingBins(scaler(columns), torch.from_numpy(is_onset), weights)
        head = fit_machine(bins, self.penalty / len(kinds), _KERNEL)
        return OnsetClassifier(evidence, scaler, head, float("inf"))


def _some(recordings: Sequence[RecordingId], number: int) -> Sequence[RecordingId]:
    """At even distances, at most so many."""
    return recordings[:: -(-len(recordings) // number)]


def _compression_scales(
    source: RecordingSource, evidence: OnsetEvidence, recording: RecordingId
) -> tuple[Array, Array, Array]:
    """A tenth of the usual root power of each filter, the usual step, each channel's own power."""
    blocks = evidence.blocks_of_recording(source.load(recording).samples)
    rms = blocks.power.sqrt()  # [F, B, k]
    fast = rms.transpose(0, 1).flatten(1).nanmedian(-1).values
    steps = torch.zeros(1, 1, len(evidence.slow_compression))
    if source.hand.slow:
        steps = blocks.mean.unfold(-1, len(evidence.step_matrix), 1) @ evidence.step_matrix
    slow = steps.abs().flatten(0, 1).nanmedian(0).values
    scale = torch.tensor(evidence.fast_compression).square()[:, None]
    usual = (blocks.power - scale).clamp(min=0).sqrt().nanmedian(-1).values.nan_to_num(0.0)
    return _FAST_SCALE * fast.numpy(), _SLOW_SCALE * slow.numpy(), usual.numpy()


def _hops(
    source: RecordingSource,
    evidence: OnsetEvidence,
    first: OnsetClassifier | None,
    recording: RecordingId,
) -> tuple[Array, list[str]]:
    """The hops of a recording that are learned from: evidence ``[N, K]``, and their kinds."""
    samples = source.load(recording).samples
    columns, is_usable = evidence.columns(evidence.blocks_of_recording(samples))
    last = samples.shape[-1] // evidence.hop_samples
    number = np.arange(last - len(columns) + 1, last + 1)
    time_s = number * evidence.hop_samples / evidence.sample_rate_hz
    places, kinds = list[NDArray[np.int64]](), list[str]()
    score = None if first is None else first.head(first.scaler(columns)).numpy()
    num_even = _FIRST_HOPS if first is None else _MOST_HOPS
    for kind, is_kind in kinds_of(source.timeline(recording), time_s, recording.scene).items():
        place = np.flatnonzero(is_kind & is_usable.numpy())
        if score is not None and not kind.startswith(_ONSET):
            most = place[np.argsort(-score[place], kind="stable")[:_MOST_LIKE]]
            places.append(most)
            kinds += [f"like {kind}"] * len(most)
        if len(place) > num_even:
            place = place[np.linspace(0, len(place) - 1, num_even).astype(int)]
        places.append(place)
        kinds += [kind] * len(place)
    return columns.numpy()[np.concatenate(places)], kinds


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


def _weights(kinds: NDArray[np.str_], is_onset: NDArray[np.bool_]) -> Tensor:
    """Of each hop: kinds alike, onsets and the others alike; 1 in the mean."""
    _, index = np.unique(kinds, return_inverse=True)
    each = 1.0 / np.bincount(index)[index]
    for mask in (is_onset, ~is_onset):
        each[mask] /= each[mask].sum()
    return torch.from_numpy(each * len(each) / 2)

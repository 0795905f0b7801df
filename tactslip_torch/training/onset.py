"""Fits the classifier of slipping now: hops in which a hand slips against all others.

A hop is positive from the release of half of the load to 0.3 s behind it, or to the end of the
slide. Left out are those from the first release to that of half, and the rest of the slide with
0.25 s behind it. All others are negative; kinds of recordings weigh alike, or as is said, and the
0.3 s before a first release may be a kind of their own: a load grows there, and nothing slips yet.
Heads are fitted by the logistic loss on all hops; that which finds more slips of materials left out
is taken.
"""

from __future__ import annotations

import logging
import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal, get_args

import lightning as L
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.utils.data import DataLoader, IterableDataset

from tactslip_torch.data.recording import RecordingId, RecordingSource, Timeline
from tactslip_torch.features.sensing import SILENT_FRACTION
from tactslip_torch.hand import HandLayout
from tactslip_torch.model.kernels import QuadraticForm
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.native import backend_of
from tactslip_torch.onset.events import first_releases
from tactslip_torch.onset.evidence import (
    Head,
    OnsetClassifier,
    OnsetEvidence,
    Perceptron,
    engine_of,
    mean_of_hops,
)
from tactslip_torch.onset.rules import NOTHING_YET, lowest_threshold
from tactslip_torch.runtime import check_number, in_processes

log = logging.getLogger(__name__)

HeadName = Literal["quadratic", "network"]
POSITIVE_S = 0.3
"""Behind the release of half of the load, in which hops are positive."""
SETTLED_S = 0.25
"""Behind a slide, from which on hops are negative."""
FOUND_S = 0.25
"""Behind the first release, within which an alarm counts as found."""
BEFORE, BEFORE_S = "before", 0.3
"""A kind of hops where it has a weight: so long before a first release; they are negative."""
_POSITIVE_WEIGHT = 0.5  # of all positive hops, over that of all others
_TAIL = 0.001  # of hops whose columns are clipped at either end
_SCALED_ROWS = 200_000  # of which ranges are taken
_USUAL_RECORDINGS = 60  # of which resolution and rest are taken
_BATCH, _EVERY_NEGATIVE = 2048, 2
_PER_HOUR = 10.0  # of false alarms, at which heads are compared
_REARM_S = 0.2
Array = NDArray[Any]


@dataclass(frozen=True)
class OnsetTraining:
    """How the classifier is fitted.

    Args:
        head: ``"quadratic"``, ``"network"``, or ``"auto"`` for the better in validation.
        epochs: passes over all hops.
        widths: of the network's hidden layers.
        folds: parts into which materials are divided; each is scored by a classifier that was
            fitted without it.
        comb_periods: of the mains, over which the comb takes the mean.
        mains_hz: nominal.
        weights: of kinds of recordings without slip, in place of 1. With ``"before"``, hops just
            before slips are a kind of their own.
        seed: of a network's weights and batches.

    Raises:
        ValueError: for an unknown head, or a number out of range.
    """

    head: Literal["auto", "quadratic", "network"] = "auto"
    epochs: int = 10
    widths: Sequence[int] = (64, 32)
    folds: int = 3
    comb_periods: int = 1
    mains_hz: float = 50.0
    weights: Mapping[str, float] = field(default_factory=dict)
    seed: int = 0

    def __post_init__(self) -> None:
        known = ("auto", *get_args(HeadName))
        if self.head not in known:
            raise ValueError(
                f"onset.classifier.head must be one of {', '.join(known)}, got {self.head!r}"
            )
        for name in ("epochs", "folds"):
            check_number(f"onset.classifier.{name}", getattr(self, name), whole=True)
        for kind, weight in self.weights.items():
            check_number(f"onset.classifier.weights.{kind}", weight)

    def evidence(self, hand: HandLayout, sample_rate_hz: float) -> OnsetEvidence:
        """What decisions are made of, before anything is learned.

        Raises:
            ValueError: if the rate is below 10 Hz.
        """
        return OnsetEvidence(
            hand, sample_rate_hz, mains_hz=self.mains_hz, comb_periods=self.comb_periods
        )

    def __call__(
        self,
        source: RecordingSource,
        recordings: Sequence[RecordingId],
        num_workers: int | None = None,
    ) -> tuple[OnsetClassifier, dict[str, OnsetClassifier], dict[str, Any]]:
        """Fit on some recordings; thresholds are left at infinity.

        Args:
            source: of the recordings.
            recordings: with slips among them.
            num_workers: processes.

        Returns:
            The classifier; for each material, one that was fitted without it (none of a single
            material); and JSON-able, what it was fitted on and how heads compare.

        Raises:
            ValueError: if there is no recording, or no slip begins in them.
        """
        if not recordings:
            raise ValueError("no recording is left to learn slips from; give onset.worlds some")
        evidence = self._fitted_evidence(source, recordings, num_workers)
        if limits := evidence.limits():
            log.warning("%s", limits)
        hops = _read_hops(source, evidence, recordings, num_workers)
        if not (hops.label > 0).any():
            raise ValueError("no slip begins in the recordings that slips are learned from")
        materials = list(dict.fromkeys(recording.material for recording in recordings))
        size = -(-len(materials) // self.folds)
        parts = [materials[i : i + size] for i in range(0, len(materials), size)]
        parts = parts if len(parts) > 1 else []
        names = (self.head,) if self.head != "auto" else get_args(HeadName)
        heads, made = dict[str, Any](), dict[str, OnsetClassifier]()
        if parts:
            for name in names:
                made[name] = self._fit(evidence, hops, name, parts[0])
                heads[name] = _found(made[name], hops, parts[0])
        name = max(heads, key=lambda n: heads[n]["found"]) if heads else names[-1]
        left_out = dict[str, OnsetClassifier]()
        for part in parts:
            own = made[name] if part is parts[0] else self._fit(evidence, hops, name, part)
            left_out |= dict.fromkeys(part, own)
        report = {
            "head": name,
            "heads": heads,
            "recordings": len(recordings),
            "slips": sum(len(hops.firsts_s[i]) for i in range(len(recordings))),
            "hours": len(hops.label) * evidence.hop_samples / source.sample_rate_hz / 3600,
            "positive_hops": int((hops.label > 0).sum()),
        }
        return self._fit(evidence, hops, name), left_out, report

    def _fitted_evidence(
        self, source: RecordingSource, recordings: Sequence[RecordingId], num_workers: int | None
    ) -> OnsetEvidence:
        """With resolution, rest and stillness of the channels in some recordings."""
        evidence = self.evidence(source.hand, source.sample_rate_hz)
        some = recordings[:: -(-len(recordings) // _USUAL_RECORDINGS)]
        usual = partial(_usual, source, evidence)
        rows = in_processes(usual, some, "slips, resolution", "recording", num_workers)
        steps, rms, still = map(np.stack, zip(*rows, strict=True))
        resolution = steps.min(0)
        resolution[~np.isfinite(resolution)] = 0.0
        least = SILENT_FRACTION * rms.min(0)  # [F, B]
        return replace(
            evidence,
            resolution=tuple(resolution.tolist()),
            least_rms=tuple(map(tuple, least.tolist())),
            is_still=tuple((np.mean(still, 0) > 0.5).tolist()),
        )

    def _fit(
        self, evidence: OnsetEvidence, hops: _Hops, name: str, without: Sequence[str] = ()
    ) -> OnsetClassifier:
        """On the recordings of materials that are not left out."""
        used = ~np.isin(hops.material, without)[hops.recording]
        known = np.flatnonzero(used & (hops.label != 0))
        rows = known[:: -(-len(known) // _SCALED_ROWS)]
        scaler = FeatureScaler.fit(torch.from_numpy(hops.columns[rows]).double(), tail=_TAIL)
        head: Head
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.seed)
            num = evidence.num_columns
            lags = evidence.lags if name == "network" else []
            module = (
                Perceptron.drawn(num * (1 + len(lags)), self.widths)
                if name == "network"
                else _Form(num)
            )
            batches = _Batches(hops, known, scaler, lags, self.weights, self.seed)
            _train(module, batches, self.epochs)
        if isinstance(module, Perceptron):
            head = module.double().requires_grad_(False)
        else:
            head = module.form()
        return OnsetClassifier(evidence, scaler, head, math.inf)


@dataclass(frozen=True)
class _Hops:
    """Hops of recordings, one behind the other.

    Attributes:
        columns: of each, ``[N, K]``, float16.
        label: 1 slip, -1 not, -2 not yet, 0 left out, ``[N]``.
        recording: number of its recording, ``[N]``.
        first: number of the first hop of its recording, ``[N]``.
        time_s: end of each, ``[N]``.
        material, kind: of each recording.
        firsts_s, ends_s: of each recording, when slips begin and slides end.
    """

    columns: Array
    label: Array
    recording: Array
    first: Array
    time_s: Array
    material: Array
    kind: Array
    firsts_s: list[tuple[float, ...]]
    ends_s: list[tuple[float, ...]]

    def inputs(self, places: Array, scaler: FeatureScaler, lags: Sequence[int]) -> Tensor:
        """What a head takes of some hops, ``[n, (1 + lags) * K]``, float32."""
        rows = [places, *(np.maximum(places - lag, self.first[places]) for lag in lags)]
        columns = torch.from_numpy(self.columns[np.stack(rows, 1)]).float()  # [n, 1 + lags, K]
        width = scaler.maximum - scaler.minimum
        slope = torch.where(width > 0, 2.0 / width, 0.0)  # in place: a third of a batch's time
        columns.sub_(scaler.minimum).mul_(slope).sub_(slope.sign()).clamp_(-1.0, 1.0)
        return columns.flatten(1)


def _read_hops(
    source: RecordingSource,
    evidence: OnsetEvidence,
    recordings: Sequence[RecordingId],
    num_workers: int | None,
) -> _Hops:
    read = partial(_hops_of, source, evidence)
    made = list(in_processes(read, recordings, "slips, evidence", "recording", num_workers))
    columns, labels, times_s = zip(*made, strict=True)
    lengths = list(map(len, labels))
    starts = np.cumsum([0, *lengths[:-1]])
    timelines = [source.timeline(recording) for recording in recordings]
    return _Hops(
        np.concatenate(columns),
        np.concatenate(labels),
        np.repeat(np.arange(len(lengths)), lengths),
        np.repeat(starts, lengths),
        np.concatenate(times_s),
        np.array([recording.material for recording in recordings]),
        np.array([recording.scene for recording in recordings]),
        [first_releases(times.onsets_s, times.released_s) for times in timelines],
        [tuple(end for _, end in times.sliding_s) for times in timelines],
    )


def _hops_of(
    source: RecordingSource, evidence: OnsetEvidence, recording: RecordingId
) -> tuple[Array, Array, Array]:
    """Columns, labels and ends of the hops of a recording whose blocks are not lost."""
    samples = source.load(recording).samples
    columns, is_usable = _columns_of(evidence, samples)
    number = np.arange(len(columns)) - len(columns) + samples.shape[-1] // evidence.hop_samples
    time_s = (number + 1) * evidence.hop_samples / evidence.sample_rate_hz
    label = _labels_of(source.timeline(recording), time_s)
    label[~is_usable] = 0
    known = ~np.isnan(columns).any(1)
    narrow = np.clip(columns[known], -6e4, 6e4).astype(np.float16)
    return narrow, label[known], time_s[known]


def _columns_of(evidence: OnsetEvidence, samples: Tensor) -> tuple[Array, Array]:
    """Evidence of every block of a recording that has its context, and whether it has a score.

    NaN of blocks that are lost, which begin nothing anew.

    Shape:
        - samples: ``[C, T]``
        - output: ``[k, K]`` and ``[k]``, bool
    """
    num = evidence.num_columns
    if backend_of("auto") == "native":
        scaler = FeatureScaler(-torch.ones(num).double(), torch.ones(num).double())
        form = QuadraticForm(torch.zeros(0, 0), torch.zeros(num), torch.tensor(0.0))
        classifier = OnsetClassifier(evidence, scaler, form.double(), math.inf)
        engine = engine_of(classifier, samples.shape[-1], with_columns=True)
        start = -(-evidence.context // evidence.hop_samples) * evidence.hop_samples
        x = np.ascontiguousarray(samples[:, start - evidence.context :])
        score, _, columns = engine(x, np.ones(len(evidence.hand), bool))
        return columns, np.isfinite(score)
    blocks = evidence.blocks_of_recording(samples)
    kept = np.flatnonzero(~evidence.is_lost(blocks, torch.ones(len(evidence.hand)).bool()).numpy())
    columns, usable = np.full((len(blocks.means), num), math.nan), np.zeros(len(blocks.means), bool)
    if len(kept):
        made, is_usable, _ = evidence.columns(blocks.only(kept))
        columns[kept], usable[kept] = made.numpy(), is_usable.numpy()
    return columns, usable


def _labels_of(times: Timeline, time_s: NDArray[np.float64]) -> NDArray[np.int8]:
    """1 where a hand slips, -1 where it does not, -2 just before, 0 where nothing is learned.

    Args:
        times: what is true of the recording.
        time_s: ends of hops.

    Shape:
        - time_s, output: ``[N]``
    """
    label = np.full(len(time_s), -1, np.int8)
    firsts = first_releases(times.onsets_s, times.released_s)
    for first_s in firsts:
        label[(time_s > first_s - BEFORE_S) & (time_s <= first_s)] = -2
    stretches = [*times.slip_s, *times.missing_s, *times.unlabelled_s]
    for start_s, end_s in stretches:
        label[(time_s > start_s) & (time_s <= end_s + SETTLED_S)] = 0
    for first_s, (_, end_s) in zip(firsts, times.sliding_s, strict=True):
        label[(time_s > first_s) & (time_s <= end_s + SETTLED_S)] = 0
    for onset_s, (_, end_s) in zip(times.onsets_s, times.sliding_s, strict=True):
        label[(time_s >= onset_s) & (time_s <= min(onset_s + POSITIVE_S, end_s))] = 1
    return label


def _usual(
    source: RecordingSource, evidence: OnsetEvidence, recording: RecordingId
) -> tuple[Array, Array, Array]:
    """Smallest step of each channel, usual rms beyond rounding, and which fast ones are still."""
    samples = source.load(recording).samples.double()
    changes = samples.diff(dim=-1).abs()
    steps = torch.where(changes > 0, changes, math.inf).nan_to_num(math.inf).amin(-1)
    blocks = evidence.blocks_of_recording(samples)
    power = (2 * blocks.logs).exp() - evidence.rounding
    rms = power.clamp(min=0.0).sqrt().nanmedian(0).values.nan_to_num(0.0).mT  # [F, B]
    still = ~blocks.moves.double().nanmean(0).gt(0.5)
    return steps.numpy(), rms.numpy(), still.numpy()


class _Form(nn.Module):
    """A quadratic form with gradients."""

    def __init__(self, num: int) -> None:
        super().__init__()
        self.quadratic = nn.Parameter(torch.zeros(num, num))
        self.linear = nn.Linear(num, 1)

    def forward(self, z: Tensor) -> Tensor:
        score: Tensor = ((z @ self.quadratic) * z).sum(-1) + self.linear(z)[..., 0]
        return score

    def form(self) -> QuadraticForm:
        """As it is kept."""
        square = self.quadratic.detach().double()
        linear, constant = self.linear.weight.detach()[0], self.linear.bias.detach()[0]
        return QuadraticForm((square + square.mT) / 2, linear.double(), constant.double())


class _Batches(IterableDataset[tuple[Tensor, Tensor, Tensor]]):
    """Inputs, labels and weights of hops in random order; another one in each pass."""

    def __init__(
        self,
        hops: _Hops,
        known: Array,
        scaler: FeatureScaler,
        lags: Sequence[int],
        weights: Mapping[str, float],
        seed: int,
    ) -> None:
        super().__init__()
        label = hops.label[known]
        is_used = (label > 0) | (np.arange(len(known)) % _EVERY_NEGATIVE == 0)
        known, label = known[is_used], label[is_used]
        self._hops, self._known, self._lags = hops, known, lags
        self._scaler = FeatureScaler(scaler.minimum.float(), scaler.maximum.float())
        self._target = torch.from_numpy((label > 0).astype(np.float32))
        kinds = hops.kind[hops.recording[known]]
        if BEFORE in weights:
            kinds = np.where(label == -2, BEFORE, kinds)
        self._weight = torch.from_numpy(_weights(kinds, label > 0, weights))
        self._rng = np.random.default_rng(seed)

    @property
    def num(self) -> int:
        """Batches of a pass."""
        return -(-len(self._known) // _BATCH)

    def __iter__(self) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        order = self._rng.permutation(len(self._known))
        for start in range(0, len(order), _BATCH):
            own = order[start : start + _BATCH]
            inputs = self._hops.inputs(self._known[own], self._scaler, self._lags)
            yield inputs, self._target[own], self._weight[own]


def _weights(
    kinds: Array, is_slip: NDArray[np.bool_], given: Mapping[str, float]
) -> NDArray[np.float32]:
    """Of each hop, 1 in the mean: kinds without slip alike, or as given."""
    names, kind = np.unique(kinds, return_inverse=True)
    others = ~is_slip
    counts = np.bincount(kind[others], minlength=len(names))
    shares = np.array([given.get(name, 1.0) for name in names.tolist()]) * (counts > 0)
    each = np.zeros(len(kinds))
    each[others] = (shares / (shares.sum() or 1.0) / np.maximum(counts, 1))[kind[others]]
    each[is_slip] = _POSITIVE_WEIGHT / max(1, is_slip.sum())
    weights: NDArray[np.float32] = (each / each.mean()).astype(np.float32)
    return weights


class _Learner(L.LightningModule):
    """Fits a head by the weighted logistic loss."""

    def __init__(self, head: nn.Module, num_steps: int) -> None:
        super().__init__()
        self.head, self._num_steps = head, num_steps
        self._rate, self._decay = (2e-3, 1e-3) if isinstance(head, Perceptron) else (5e-3, 0.0)

    def training_step(self, batch: tuple[Tensor, Tensor, Tensor], number: int) -> Tensor:
        inputs, target, weight = batch
        return nn.functional.binary_cross_entropy_with_logits(self.head(inputs), target, weight)

    def configure_optimizers(self) -> Any:
        optimizer = torch.optim.AdamW(self.head.parameters(), self._rate, weight_decay=self._decay)
        schedule = torch.optim.lr_scheduler.OneCycleLR(
            optimizer, self._rate, total_steps=self._num_steps + 1
        )
        return {
            "optimizer": optimizer,
            "lr_scheduler": {"scheduler": schedule, "interval": "step"},
        }


def _train(head: nn.Module, batches: _Batches, epochs: int) -> None:
    """Fit a head in place, on the processor."""
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", module="lightning")
        trainer = L.Trainer(
            accelerator="cpu",
            max_epochs=epochs,
            logger=False,
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
        )
        trainer.fit(_Learner(head, epochs * batches.num), DataLoader(batches, batch_size=None))


def _found(classifier: OnsetClassifier, hops: _Hops, materials: Sequence[str]) -> dict[str, float]:
    """Slips of some materials found at the threshold of ten false alarms an hour beside them."""
    evidence = classifier.evidence
    hop_s = evidence.hop_samples / evidence.sample_rate_hz
    rearm = math.ceil(_REARM_S / hop_s)
    scores, quiet, slips = [], [], list[tuple[Array, Array, tuple[float, ...]]]()
    of_material = np.flatnonzero(np.isin(hops.material, materials))
    bounds = np.searchsorted(hops.recording, np.append(of_material, len(hops.material)))
    for place, number in enumerate(of_material):
        own = np.flatnonzero(hops.recording[bounds[place] :] == number) + bounds[place]
        if not len(own):
            continue
        inputs = hops.inputs(own, classifier.scaler, classifier.lags).double()
        with torch.no_grad():
            score = classifier.head(inputs).numpy()
        score[hops.time_s[own] - hops.time_s[own[0]] < evidence.blind * hop_s] = math.nan
        score = mean_of_hops(np.concatenate([[math.nan, math.nan], score]))
        scores.append(score)
        is_quiet = (hops.label[own] < 0) & (score > NOTHING_YET)
        for first_s in hops.firsts_s[number]:
            is_quiet &= (hops.time_s[own] < first_s - _REARM_S) | (hops.time_s[own] > first_s)
        quiet.append(is_quiet)
        slips.append((score, hops.time_s[own], hops.firsts_s[number]))
    hours = float(sum(map(np.sum, quiet))) * hop_s / 3600
    allowed = int(_PER_HOUR * hours)
    threshold = lowest_threshold(scores, quiet, allowed, rearm=rearm, refractory=rearm)
    found = [
        bool(((score >= threshold) & (time_s >= first_s) & (time_s <= first_s + FOUND_S)).any())
        for score, time_s, firsts_s in slips
        for first_s in firsts_s
    ]
    return {
        "found": float(np.mean(found)) if found else 0.0,
        "slips": len(found),
        "hours": hours,
        "threshold": threshold,
    }

"""Evidence that a slip begins, every few milliseconds, and the classifier on it.

- *fast channels*: power of four band filters over 10, 25 and 50 ms, as a log ratio to the channel's
  mean log power over the last second;
- *slow channels*: steps between means of neighbouring stretches of 10 to 100 ms, their size and,
  with their sign, how far they exceed the channel's noise;
- each as mean, largest and smallest over the channels of its kind.

Three filters are differences of neighbouring means (Haar wavelets); the fourth first subtracts the
mean of the last periods of the mains, a comb. The classifier is the kernel machine of degree 2,
averaged over three hops. All is causal; the first second of a stream has no evidence.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tactslip_torch.features.sensing import least_alive
from tactslip_torch.hand import HandLayout
from tactslip_torch.model.kernels import QuadraticForm
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.native import BackendName, OnsetEngine, backend_of
from tactslip_torch.onset.rules import HOLD_S, NOTHING_YET, most_lost

Array = NDArray[Any]

WINDOWS_S = (0.01, 0.025, 0.05)
FLOOR_S = 1.0
WIDTHS_S = (0.0005, 0.002, 0.004)
"""Of the means whose differences the first three band filters are: 1, 4 and 8 samples at 2 kHz."""
COMB_WIDTH_S = 0.001
STEPS_S = (
    (0.010, 0.010, 0.010),
    (0.025, 0.025, 0.025),
    (0.025, 0.050, 0.050),
    (0.050, 0.100, 0.100),
    (0.050, 0.050, 0.200),
    (0.100, 0.100, 0.400),
)
"""Length of the latest stretch, that of the one it is compared with, and how far back it ends."""
MEAN_HOPS = 3
"""Over which the score is averaged: a knock is over sooner than a slip begins."""
_NUMBERS: Mapping[str, Any] = {"hop_samples": int, "mains_hz": float, "comb_periods": int}
_SCALES = ("fast_compression", "slow_compression")
FEWEST_BLOCK_SAMPLES = 4
"""Of a block that counts as still where all its samples are one value."""
_LEAST_RISE = 1e-6  # of a floor over that of silence, in half the log power


class Blocks(NamedTuple):
    """What is kept of a stream: a column for each block of ``hop_samples``.

    Attributes:
        power: of each fast channel and filter, mean square and compression scale, ``[F, B, m]``.
        mean: of each slow channel, ``[S, m]``.
        moves: whether the block's own samples of a fast channel are not all one value,
            ``[F, m]``, bool; of blocks of fewer than 4 samples always. Not kept.
    """

    power: Tensor
    mean: Tensor
    moves: Tensor | None = None


@dataclass(frozen=True, eq=False)
class OnsetEvidence:
    """From samples to K columns a hop.

    Args:
        hand: the channels; at least one is fast.
        sample_rate_hz: of the stream.
        hop_samples: length of a block, and distance of decisions.
        fast_compression: root mean square that counts as silence, of each filter, ``[B]``.
        slow_compression: step that counts as none, of each of ``STEPS_S``, ``[D]``.
        mains_hz: whose period the comb has.
        comb_periods: over how many it takes the mean.
        least_rms: root mean square of each fast channel and filter, ``[F, B]``, below which the
            channel is silent; empty: below rounding.
        min_alive: fast channels that must be alive for evidence; 0: half of them.

    Raises:
        ValueError: if the hand has no fast channel, a hop is longer than 5 ms, or a scale is not
            positive and finite.
    """

    hand: HandLayout
    sample_rate_hz: float
    hop_samples: int
    fast_compression: tuple[float, ...] = (1e-30,) * (len(WIDTHS_S) + 1)
    slow_compression: tuple[float, ...] = (1e-30,) * len(STEPS_S)
    mains_hz: float = 50.0
    comb_periods: int = 1
    least_rms: tuple[tuple[float, ...], ...] = ()
    min_alive: int = 0

    def __post_init__(self) -> None:
        if not self.hand.fast:
            raise ValueError(
                "evidence of onsets needs fast channels, and this hand has none; "
                "take onset=debounced"
            )
        if not 1 <= self.hop_samples <= 0.005 * self.sample_rate_hz:
            raise ValueError(
                f"onsets are decided at least every 5 ms, got {self.hop_samples} samples between "
                f"decisions at {self.sample_rate_hz:g} Hz; take onset=debounced, which needs no "
                "such rate"
            )
        scales = [*self.fast_compression, *self.slow_compression]
        num_scales = len(WIDTHS_S) + 1 + len(STEPS_S)
        if len(scales) != num_scales or not all(0 < scale < float("inf") for scale in scales):
            raise ValueError(f"expected {num_scales} positive and finite scales, got {scales}")
        shape = (len(self.hand.fast), len(self.fast_compression))
        least = np.array(self.least_rms or np.zeros(shape), np.float64)
        if least.shape != shape or not (np.isfinite(least) & (least >= 0)).all():
            raise ValueError(f"least_rms must be finite, at least 0 and {list(shape)}")
        if not self.min_alive:
            object.__setattr__(self, "min_alive", least_alive(shape[0]))

    def blocks_in(self, seconds: float) -> int:
        """A length of time in blocks, rounded up."""
        return max(1, -(-round(seconds * self.sample_rate_hz) // self.hop_samples))

    @cached_property
    def silence(self) -> Tensor:
        """Half the log power of a silent channel, ``[B, F]``, float64.

        Minus infinity for a channel that was still in the usual block of training, such as one of
        few counts: it is never silent.
        """
        scale = np.array(self.fast_compression)
        least = np.array(self.least_rms or np.zeros((len(self.hand.fast), len(scale))))
        silence = np.log(np.hypot(scale, least)) + _LEAST_RISE
        if self.least_rms:
            silence[(least == 0).all(-1)] = -np.inf
        return torch.from_numpy(silence.T.copy())

    @cached_property
    def context(self) -> int:
        """Samples before a block that its filters reach back to."""
        return len(self._filters[0]) - 1

    @cached_property
    def windows(self) -> list[int]:
        """``WINDOWS_S`` in blocks."""
        return [self.blocks_in(seconds) for seconds in WINDOWS_S]

    @cached_property
    def memory(self) -> int:
        """Blocks that the evidence of a hop rests on, its own included."""
        return self.blocks_in(FLOOR_S) + self.windows[-1]

    @property
    def first_hop(self) -> int:
        """Number of the first hop of a stream that has evidence."""
        return -(-self.context // self.hop_samples) + self.memory - 1

    @cached_property
    def num_columns(self) -> int:
        """``K``."""
        num_rows = len(WINDOWS_S) * len(self.fast_compression)
        num = num_rows * (3 if len(self.hand.fast) > 1 else 1)
        num_slow = len(self.hand.slow)
        return num + 2 * len(STEPS_S) * (3 if num_slow > 1 else num_slow)

    @cached_property
    def _filters(self) -> Array:
        """Impulse responses, ``[B, context + 1]``; the first number meets the latest sample."""

        def haar(seconds: float) -> Array:
            width = max(1, round(seconds * self.sample_rate_hz))
            return np.repeat([1.0, -1.0], width) / width

        period = self.sample_rate_hz / self.mains_hz
        comb = np.zeros(int(np.ceil(self.comb_periods * period)) + 1)
        comb[0] = 1.0
        for number in range(1, self.comb_periods + 1):
            whole, part = divmod(number * period, 1)
            comb[int(whole)] -= (1 - part) / self.comb_periods
            if part:
                comb[int(whole) + 1] -= part / self.comb_periods
        rows = [*map(haar, WIDTHS_S), np.convolve(comb, haar(COMB_WIDTH_S))]
        return np.stack([np.pad(row, (0, max(map(len, rows)) - len(row))) for row in rows])

    @cached_property
    def filter_matrix(self) -> Array:
        """A block with its context to the outputs of all filters: ``[context + hop, B, hop]``."""
        hop, length = self.hop_samples, self.context + 1
        matrix = np.zeros((self.context + hop, len(self._filters), hop))
        for place in range(hop):
            matrix[place : place + length, :, place] = self._filters[:, ::-1].T
        return matrix

    @cached_property
    def step_matrix(self) -> Tensor:
        """Means of the last blocks to steps: ``[b, D]``."""
        spans = [[self.blocks_in(seconds) for seconds in step] for step in STEPS_S]
        matrix = np.zeros((max(back + length for _, length, back in spans), len(spans)))
        for row, (latest, length, back) in zip(matrix.T, spans, strict=True):
            row[len(row) - latest :] += 1 / latest
            row[len(row) - back - length : len(row) - back] -= 1 / length
        return torch.from_numpy(matrix)

    def blocks(self, samples: Tensor) -> Blocks:
        """Of every whole block that has its context.

        Args:
            samples: raw, ``context`` of them before the first block; NaN makes its blocks NaN.

        Shape:
            - samples: ``[C, context + k * hop]``
            - output: of k blocks
        """
        x = samples.double()
        hop, context = self.hop_samples, self.context
        frames = x[list(self.hand.fast)].unfold(-1, context + hop, hop)  # [F, k, context + hop]
        filtered = (frames - frames[..., :1]) @ torch.from_numpy(self.filter_matrix).flatten(1)
        square = (
            filtered.unflatten(-1, (len(self.fast_compression), hop)).square().mean(-1)
        )  # [F, k, B]
        power = square.mT + torch.from_numpy(np.square(self.fast_compression))[:, None]
        mean = x[list(self.hand.slow), context:].unfold(-1, hop, hop).mean(-1)
        own = frames[..., context:]
        moves = (own != own[..., :1]).any(-1) | (hop < FEWEST_BLOCK_SAMPLES)
        return Blocks(power, mean, moves)

    def blocks_of_recording(self, samples: Tensor) -> Blocks:
        """Of a whole recording ``[C, T]``: those that have their context."""
        start = -(-self.context // self.hop_samples) * self.hop_samples - self.context
        return self.blocks(samples[:, start:])

    def columns(self, blocks: Blocks, masked: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """The evidence of each hop, and whether enough fast channels gave it.

        A channel that is masked, that had a NaN or an Inf in the last second, or that has been
        silent for all of it, is left out of the pools. With fewer than ``min_alive`` fast ones
        there is no evidence.

        Args:
            blocks: of ``memory - 1`` hops before the first and of k more.
            masked: channels to leave out.

        Shape:
            - masked: ``[C]``, bool
            - output: ``[k, K]`` and ``[k]``, bool
        """
        power, mean, _ = blocks
        num, windows = power.shape[-1] - self.memory + 1, self.windows
        level = torch.stack([_moving_mean(power, n)[..., -num:] for n in windows], -1)
        logs = power[..., : -windows[-1]].log() * 0.5
        floor = _moving_mean(logs, self.memory - windows[-1])
        rows = mean.unfold(-1, len(self.step_matrix), 1)[:, -num:]
        steps = (rows - rows[..., :1]) @ self.step_matrix  # [S, k, D]
        used = torch.ones(len(self.hand), dtype=torch.bool) if masked is None else ~masked
        return self.pooled(
            level.permute(2, 3, 1, 0),
            floor.permute(2, 1, 0),
            steps.permute(1, 2, 0),
            used[list(self.hand.fast)],
            used[list(self.hand.slow)],
        )

    def pooled(
        self, level: Tensor, floor: Tensor, steps: Tensor, fast: Tensor, slow: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Columns of what was measured; in operations that tensors and values of a graph share.

        Args:
            level: mean power in each window and of each filter.
            floor: mean of half the log power over the last second.
            steps: of the slow channels.
            fast: fast channels in use.
            slow: slow ones.

        Shape:
            - level: ``[k, W, B, F]``; floor: ``[k, B, F]``; steps: ``[k, D, S]``
            - fast: ``[F]``, slow: ``[S]``, bool
            - output: ``[k, K]`` and ``[k]``, bool
        """
        loudness = level.log() * 0.5
        rises = loudness - floor.unsqueeze(1)
        is_finite = rises.sum(1).sum(1).isfinite()
        in_use = ((floor - self.silence).amax(1) > 0.0) & is_finite & fast  # [k, F]
        columns = _over_channels(rises, in_use, len(self.hand.fast))
        columns = [torch.cat(columns, 1).flatten(-2)]
        if num_slow := len(self.hand.slow):
            scale = torch.tensor(self.slow_compression, dtype=torch.float64)[:, None]
            size = (steps.abs() + scale).log()
            way = steps.sign() * (size - scale.log())
            both = torch.cat([size.unsqueeze(1), way.unsqueeze(1)], 1)  # [k, 2, D, S]
            pools = _over_channels(both, size.sum(1).isfinite() & slow, num_slow)
            columns.append(torch.cat(pools, -1).flatten(-2))
        num_alive = in_use.type_as(level).sum(-1)
        return torch.cat(columns, -1), num_alive >= float(self.min_alive)

    def to_dict(self) -> dict[str, Any]:
        """All but the hand and the sample rate, which are the detector's."""
        plain = {name: getattr(self, name) for name in (*_NUMBERS, "min_alive")}
        plain["least_rms"] = [list(row) for row in self.least_rms]
        return plain | {name: list(getattr(self, name)) for name in _SCALES}


@dataclass(frozen=True, eq=False)
class OnsetClassifier:
    """Whether a slip begins, by the evidence of each hop: at least the threshold says yes.

    Args:
        evidence: what a hop is described by.
        scaler: of its columns.
        head: the machine on scaled columns.
        threshold: of its score.
        lead_s: from an onset to the first hop that speaks for one, in the middle.
    """

    evidence: OnsetEvidence
    scaler: FeatureScaler
    head: QuadraticForm
    threshold: float
    lead_s: float = 0.0

    def score(self, blocks: Blocks, masked: Tensor | None = None) -> Tensor:
        """Of every hop alone, float64; NaN where too few fast channels are alive.

        Shape:
            - blocks, masked: as ``OnsetEvidence.columns`` takes them
            - output: ``[k]``
        """
        columns, is_usable = self.evidence.columns(blocks, masked)
        return torch.where(is_usable, self.head(self.scaler(columns)), math.nan)

    def score_recording(self, samples: Tensor) -> Tensor:
        """Means over ``MEAN_HOPS`` of every whole hop; ``NOTHING_YET`` where one has no score.

        So within the first second of a recording.

        Shape:
            - samples: ``[C, T]``
            - output: ``[T // hop_samples]``, float64
        """
        return OnsetStream(self).push(samples)

    def to_dict(self) -> dict[str, Any]:
        """The classifier as plain JSON types, without hand and sample rate."""
        return {
            **self.evidence.to_dict(),
            "minimum": self.scaler.minimum.tolist(),
            "maximum": self.scaler.maximum.tolist(),
            "quadratic": self.head.matrix.tolist(),
            "linear": self.head.linear.tolist(),
            "constant": float(self.head.constant),
            "threshold": self.threshold,
            "lead_s": self.lead_s,
        }

    @classmethod
    def from_dict(
        cls, plain: Mapping[str, Any], hand: HandLayout, sample_rate_hz: float
    ) -> OnsetClassifier:
        """The classifier that ``to_dict`` wrote, of a detector's hand.

        Raises:
            KeyError, TypeError, ValueError: if a number is missing or no such number.
        """

        def tensor(name: str) -> Tensor:
            return torch.tensor(plain[name], dtype=torch.float64)

        numbers = {name: kind(plain[name]) for name, kind in _NUMBERS.items()}
        numbers |= {name: tuple(map(float, plain[name])) for name in _SCALES}
        numbers["least_rms"] = tuple(tuple(map(float, row)) for row in plain["least_rms"])
        numbers["min_alive"] = int(plain["min_alive"])
        evidence, num = OnsetEvidence(hand, sample_rate_hz, **numbers), len(plain["linear"])
        quadratic = tensor("quadratic") if plain["quadratic"] else torch.zeros(0, 0).double()
        head = QuadraticForm(quadratic, tensor("linear"), tensor("constant"))
        scaler = FeatureScaler(tensor("minimum"), tensor("maximum"))
        if len(scaler.minimum) != evidence.num_columns or num != evidence.num_columns:
            raise ValueError(f"expected {evidence.num_columns} columns of evidence, got {num}")
        if len(quadratic) not in (0, num):
            raise ValueError(f"expected a quadratic part of {num} columns, got {len(quadratic)}")
        return cls(evidence, scaler, head, float(plain["threshold"]), float(plain["lead_s"]))


class OnsetStream:
    """Onset scores of a stream as its samples come; its memory has a fixed size.

    A block in which too few fast channels are alive (``OnsetEvidence.min_alive``) is lost. It has
    no score and leaves the memory as it is. Beyond ``most_lost_samples`` of lost samples the memory
    begins anew, as at the beginning of a stream.

    Args:
        classifier: that scores.
        most_lost_samples: in a row.
        backend: ``"auto"`` takes the native engine where it can be used.

    Raises:
        ValueError: for an unknown backend, or one that cannot be used here.
    """

    def __init__(
        self,
        classifier: OnsetClassifier,
        most_lost_samples: int | None = None,
        backend: BackendName = "auto",
    ) -> None:
        evidence = classifier.evidence
        if most_lost_samples is None:
            most_lost_samples = round(HOLD_S * evidence.sample_rate_hz)
        self._classifier = classifier
        window = evidence.context + evidence.hop_samples
        self._most_lost = most_lost(window, most_lost_samples, evidence.hop_samples)
        is_native = backend_of(backend) == "native"
        self._engine = _engine_of(classifier, self._most_lost) if is_native else None
        self._hop = 0  # of the next score
        self._skipped = 0  # samples before those that are held
        self._held: Array | None = None
        self._all = np.ones(len(evidence.hand), bool)
        # half the log powers of blocks, and behind them the means
        width = len(evidence.hand.fast) * len(evidence.fast_compression) + len(evidence.hand.slow)
        self._rows, self._num_rows = np.empty((4 * evidence.memory, width)), 0
        self._num_lost = 0
        self._scores = np.full(MEAN_HOPS - 1, math.nan)  # of the last blocks that are not lost

    @property
    def state_bytes(self) -> int:
        """Memory of what is remembered."""
        held = 0 if self._held is None else self._held.nbytes
        return int(self._rows.nbytes + held)

    def push(self, samples: Tensor, masked: Tensor | None = None) -> Tensor:
        """The scores of the hops that these samples complete.

        Shape:
            - samples: ``[C, n]``; masked: ``[C]``, bool
            - output: ``[k]``, as ``OnsetClassifier.score_recording`` has them
        """
        evidence, x = self._classifier.evidence, np.ascontiguousarray(samples.detach())
        hop, context, memory = evidence.hop_samples, evidence.context, evidence.memory
        held = x if self._held is None else np.concatenate([self._held, x], -1)
        num = (self._skipped + held.shape[-1]) // hop
        mean = np.full(num - self._hop, NOTHING_YET)
        first = max(self._hop, -(-context // hop))  # block that has its context
        for start in range(first, num, memory):
            stop = min(start + memory, num)
            begin = start * hop - context - self._skipped
            made, is_lost = self._score(held[:, begin : stop * hop - self._skipped], masked)
            known = np.concatenate([self._scores, made[~is_lost]])
            mean[start - self._hop : stop - self._hop][~is_lost] = _mean_of_hops(known)
            self._scores = known[1 - MEAN_HOPS :]
        first = max(first, num)
        self._hop, surplus = num, max(first * hop - context - self._skipped, 0)
        self._held = held[:, surplus:].copy()
        self._skipped += min(surplus, held.shape[-1])
        return torch.from_numpy(mean)

    def _score(self, x: Array, masked: Tensor | None) -> tuple[Array, Array]:
        """Scores of the next hops, at most ``memory``, NaN without evidence; which are lost."""
        evidence, memory = self._classifier.evidence, self._classifier.evidence.memory
        num = (x.shape[-1] - evidence.context) // evidence.hop_samples
        if self._num_rows + num > len(self._rows):
            kept = memory - 1
            self._rows[:kept] = self._rows[self._num_rows - kept : self._num_rows].copy()
            self._num_rows = kept
        start = max(self._num_rows + 1 - memory, 0)
        listened = self._all if masked is None else ~masked.numpy()
        call = self._by_torch if self._engine is None else self._engine
        rows, num_before = self._rows[start : self._num_rows + num], self._num_rows - start
        score, is_lost, num_rows, self._num_lost = call(
            x, rows, num_before, self._num_lost, listened
        )
        if num_rows < num_before + int((~is_lost).sum()):  # began anew: what was before is gone
            self._rows[:num_rows], start = rows[:num_rows].copy(), 0
        self._num_rows = start + num_rows
        return score, is_lost

    def _by_torch(
        self, x: Array, rows: Array, num_rows: int, num_lost: int, listened: Array
    ) -> tuple[Array, Array, int, int]:
        """As ``native.OnsetEngine``."""
        evidence = self._classifier.evidence
        made = evidence.blocks(torch.from_numpy(x))
        logs = (made.power.log() * 0.5).transpose(1, 2)  # [F, k, B]
        fast = listened[list(evidence.hand.fast)]
        rises = (logs - evidence.silence.T[:, None]).amax(-1)
        assert made.moves is not None  # of blocks that were just made
        alive = logs.sum(-1).isfinite() & ((rises > 0.0) & made.moves | rises.isinf())  # [F, k]
        is_lost = alive.numpy()[fast].sum(0) < evidence.min_alive
        made_rows = torch.cat([logs.transpose(1, 2).flatten(0, 1), made.mean]).T.numpy()
        score, kept = np.full(len(made_rows), math.nan), np.flatnonzero(~is_lost)
        lost_before = np.diff(kept, prepend=-1 - num_lost) - 1
        num_lost = len(is_lost) + (-1 - int(kept[-1]) if len(kept) else num_lost)
        begins_anew = np.flatnonzero(lost_before > self._most_lost)
        for part, hops in enumerate(np.split(kept, begins_anew)):
            first = 0 if part else num_rows
            num_rows = first + len(hops)
            rows[first:num_rows] = made_rows[hops]
            known = torch.from_numpy(rows[max(first + 1 - evidence.memory, 0) : num_rows].T)
            if (num := known.shape[-1] - evidence.memory + 1) > 0:
                own, means = known.split([len(known) - len(made.mean), len(made.mean)])
                power = (2.0 * own).exp().unflatten(0, (-1, made.power.shape[1]))
                found = self._classifier.score(Blocks(power, means), torch.from_numpy(~listened))
                score[hops[-num:]] = found.numpy()
        return score, is_lost, num_rows, num_lost


def _engine_of(classifier: OnsetClassifier, most_lost: int) -> OnsetEngine:
    evidence, scaler, head = classifier.evidence, classifier.scaler, classifier.head
    width = (scaler.maximum - scaler.minimum).numpy()
    slope = np.divide(2.0, width, out=np.zeros_like(width), where=width > 0)
    offset = np.where(width > 0, -1.0, 0.0) - slope * scaler.minimum.numpy()
    quadratic = np.empty((0, 0)) if head.is_linear else head.matrix.numpy()
    return OnsetEngine(
        fast=evidence.hand.fast,
        slow=evidence.hand.slow,
        windows=evidence.windows,
        memory=evidence.memory,
        filters=evidence.filter_matrix,
        steps=evidence.step_matrix.numpy(),
        scales=(evidence.fast_compression, evidence.slow_compression),
        scaling=(slope, offset),
        head=(quadratic, head.linear.numpy(), float(head.constant)),
        silence=evidence.silence.T.numpy(),
        min_alive=evidence.min_alive,
        most_lost=most_lost,
    )


def _over_channels(values: Tensor, in_use: Tensor, num_channels: int) -> list[Tensor]:
    """Mean, largest and smallest over channels in use, 0 of none; of one channel itself alone.

    Shape:
        - values: ``[k, *, *, C]``; in_use: ``[k, C]``; output: ``[k, *, *]`` each
    """
    rows = in_use.unsqueeze(1).unsqueeze(1)
    mean = torch.where(rows, values, 0.0).sum(-1) / rows.type_as(values).sum(-1).clamp(min=1.0)
    known = torch.where(rows, values, mean.unsqueeze(-1))
    return [mean, known.amax(-1), known.amin(-1)] if num_channels > 1 else [mean]


def _mean_of_hops(score: Array) -> Array:
    """Means of each hop and those before it, ``NOTHING_YET`` for NaN: ``[2 + k] -> [k]``."""
    mean = sum((score[i : len(score) + 1 - MEAN_HOPS + i] for i in range(MEAN_HOPS)), 0.0)
    return np.where(np.isfinite(mean), mean / MEAN_HOPS, NOTHING_YET)


def _moving_mean(x: Tensor, length: int) -> Tensor:
    """Over the last axis, of every ``length`` neighbours."""
    return x.unfold(-1, length, 1).mean(-1)

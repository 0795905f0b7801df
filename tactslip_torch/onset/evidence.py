"""Evidence that a hand slips now, every few milliseconds, and the classifier on it.

All columns are ratios, so neither gain nor unit of a channel matters:

- *fast channels*: power of up to four band filters over 10, 25 and 50 ms, as a log ratio to the
  channel's own *floor*, its mean log power over the last 1, 0.3 and 0.1 s; mean, largest, smallest
  and spread over channels; squared correlation between channels, of each filter: its mean, its
  largest, and its mean with the rises of both channels as weights, as few may touch;
- *slow channels*: steps between means of neighbouring stretches over the mean size of such steps in
  the last second; their size and, with their sign, mean, largest and smallest over channels, and
  how far the signs agree.

Three filters are differences of neighbouring means (Haar wavelets); the fourth first subtracts the
mean of the last periods of the mains, a comb. What a hand does not have is left out. Floors are
recursive means, and end a window before the hop. What was before the first hop of a stream counts
as equal to it; a stream has a score after a quarter of a second. The score is averaged over three
hops.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from tactslip_torch.features.sensing import least_alive
from tactslip_torch.hand import HandLayout
from tactslip_torch.model.kernels import QuadraticForm
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.native import BackendName, OnsetEngine, backend_of
from tactslip_torch.onset.rules import HOLD_S, NOTHING_YET, most_lost

Array = NDArray[Any]

HOP_S = 0.005
WINDOWS_S, _WINDOW_SAMPLES = (0.01, 0.025, 0.05), (4, 6, 8)
"""Over which power is taken; never fewer samples."""
FLOORS_S, _FLOOR_WINDOWS = (1.0, 0.3, 0.1), (3.0, 1.5, 0.75)
"""Of floors; never fewer of the longest windows."""
_WIDTHS_S, _WIDTH_SAMPLES = (0.0005, 0.002, 0.004), (1, 2, 4)
"""Of the means whose differences the first three band filters are; never fewer samples."""
COMB_WIDTH_S = 0.001
_COMB_SAMPLES = 4  # of a period of the mains, below which there is no comb
STEPS_S = (
    (0.010, 0.010, 0.010),
    (0.025, 0.025, 0.025),
    (0.025, 0.050, 0.050),
    (0.050, 0.100, 0.100),
    (0.050, 0.050, 0.200),
    (0.100, 0.100, 0.400),
    (0.200, 0.200, 0.600),
)
"""Length of the latest stretch, that of the one it is compared with, and how far back it ends."""
LAGS_S, _LAG_HOPS = (0.015, 0.040, 0.080), (1, 2, 4)
"""Of the columns of before that a network sees beside those of now; never fewer hops."""
MEAN_HOPS = 3
"""Over which the score is averaged: a knock is over sooner than a slip begins."""
SLOWEST_HZ = 10.0
FEWEST_BLOCK_SAMPLES = 4
"""Of a block that counts as still where all its samples are one value."""
_BLIND_WINDOWS = 5  # of a stream without a score, in longest windows
_MOST_PAIRS = 120  # of channels whose correlation is taken
_LEAST_RISE = 1e-6  # of a floor over that of silence, in half the log power; or a sum of weights
_LEAST_STEPS = 1e-3  # sum over channels of steps over their floors, that counts as none
_LEAST_POWER = 1e-30  # of a filter, where the converter's step is not known
_NUMBERS: Mapping[str, Any] = {
    "hop_samples": int,
    "mains_hz": float,
    "comb_periods": int,
    "min_alive": int,
}


class _Blocks(NamedTuple):
    """What is measured of a stream in blocks of ``hop_samples``, ``m`` of them.

    Attributes:
        logs: half the log power of each filter and fast channel, ``[m, B, F]``.
        products: mean product of pairs of fast channels, ``[m, B, P]``.
        means: of each slow channel, ``[m, S]``.
        moves: whether the block's own samples of a fast channel are not all one value, ``[m, F]``,
            bool; of blocks of fewer than 4 samples always.
    """

    logs: Tensor
    products: Tensor
    means: Tensor
    moves: Tensor

    def only(self, places: Any) -> _Blocks:
        """Some of the blocks."""
        return _Blocks(*(each[places] for each in self))


class _Memory(NamedTuple):
    """What is kept between two hops.

    Attributes:
        num_known: blocks so far.
        logs, products, means, steps: of the last blocks, the latest last.
        floor: of each length, filter and fast channel, ``[3, B, F]``.
        step_floor: mean size of each step of each slow channel, ``[D, S]``.
        scaled: scaled columns of the last hops, ``[L, K]``.
    """

    num_known: Tensor
    logs: Tensor
    products: Tensor
    means: Tensor
    steps: Tensor
    floor: Tensor
    step_floor: Tensor
    scaled: Tensor


@dataclass(frozen=True, eq=False)
class OnsetEvidence:
    """From samples to K columns a hop.

    Args:
        hand: the channels.
        sample_rate_hz: of the stream, at least 10.
        hop_samples: length of a block, and distance of decisions; 0: of 5 ms, at least one.
        resolution: step of each channel's converter; empty or 0: not known.
        mains_hz: whose period the comb has.
        comb_periods: over how many it takes the mean.
        least_rms: root mean square of each fast channel and filter, ``[F, B]``, below which the
            channel is silent; empty: below rounding.
        is_still: of each fast channel, whether the usual block holds one value, as of few counts.
        min_alive: fast channels (slow ones of a hand without) that must be alive; 0: half of them.

    Raises:
        ValueError: if the rate is below 10 Hz, a hop is longer than 5 ms and a sample, or a number
            is not finite or of another shape.
    """

    hand: HandLayout
    sample_rate_hz: float
    hop_samples: int = 0
    resolution: tuple[float, ...] = ()
    mains_hz: float = 50.0
    comb_periods: int = 1
    least_rms: tuple[tuple[float, ...], ...] = ()
    is_still: tuple[bool, ...] = ()
    min_alive: int = 0

    def __post_init__(self) -> None:
        rate = self.sample_rate_hz
        if not SLOWEST_HZ <= rate < math.inf:
            raise ValueError(
                f"evidence of slip needs at least {SLOWEST_HZ:g} samples a second, got {rate:g} "
                "Hz; take onset=debounced"
            )
        if self.hop_samples == 0:
            object.__setattr__(self, "hop_samples", max(1, round(HOP_S * rate)))
        if not 1 <= self.hop_samples <= max(1, HOP_S * rate):
            raise ValueError(
                f"slip is decided at least every 5 ms or every sample, got {self.hop_samples} "
                f"samples between decisions at {rate:g} Hz"
            )
        num_fast, shape = len(self.hand.fast), (len(self.hand.fast), self.num_filters)
        least = np.array(self.least_rms or np.zeros(shape), np.float64)
        if least.shape != shape or not (np.isfinite(least) & (least >= 0)).all():
            raise ValueError(f"least_rms must be finite, at least 0 and {list(shape)}")
        steps = np.array(self.resolution or np.zeros(len(self.hand)), np.float64)
        if steps.shape != (len(self.hand),) or not (np.isfinite(steps) & (steps >= 0)).all():
            raise ValueError(f"resolution must be finite, at least 0 and [{len(self.hand)}]")
        if len(self.is_still) not in (0, num_fast):
            raise ValueError(f"is_still must be of {num_fast} channels, got {len(self.is_still)}")
        if not self.min_alive:
            object.__setattr__(self, "min_alive", least_alive(len(self.counted)))

    # lengths and shapes ---------------------------------------------------------------------------

    @property
    def counted(self) -> tuple[int, ...]:
        """Channels that must be alive: the fast ones; of a hand without, the slow ones."""
        return self.hand.fast or self.hand.slow

    def blocks_in(self, seconds: float) -> int:
        """A length of time in blocks, rounded up."""
        return max(1, -(-round(seconds * self.sample_rate_hz) // self.hop_samples))

    @cached_property
    def windows(self) -> list[int]:
        """``WINDOWS_S`` in blocks."""
        pairs = zip(WINDOWS_S, _WINDOW_SAMPLES, strict=True)
        return [max(self.blocks_in(s), -(-least // self.hop_samples)) for s, least in pairs]

    @property
    def delay(self) -> int:
        """_Blocks by which floors lag behind: the longest window."""
        return self.windows[-1]

    @cached_property
    def floor_rates(self) -> list[float]:
        """What a block adds to each floor, of a mean as steady as one over that length."""
        pairs = zip(FLOORS_S, _FLOOR_WINDOWS, strict=True)
        lengths = [max(self.blocks_in(s), math.ceil(n * self.delay)) for s, n in pairs]
        return [2.0 / (length + 1) for length in lengths]

    @cached_property
    def lags(self) -> list[int]:
        """``LAGS_S`` in hops."""
        return [max(self.blocks_in(s), n) for s, n in zip(LAGS_S, _LAG_HOPS, strict=True)]

    @property
    def blind(self) -> int:
        """Known blocks before the first one with a score."""
        return _BLIND_WINDOWS * self.delay

    @property
    def first_hop(self) -> int:
        """Number of the first hop of a stream that has a score of its own."""
        return -(-self.context // self.hop_samples) + self.blind

    @cached_property
    def has_comb(self) -> bool:
        """Whether the mains is slow enough to be filtered out."""
        return self.sample_rate_hz >= _COMB_SAMPLES * self.mains_hz

    @property
    def num_filters(self) -> int:
        """``B``."""
        return len(_WIDTHS_S) + self.has_comb

    @cached_property
    def filters(self) -> Array:
        """Impulse responses, ``[B, context + 1]``; the first number meets the latest sample."""

        def haar(seconds: float, least: int = 1) -> Array:
            width = max(least, round(seconds * self.sample_rate_hz))
            return np.repeat([1.0, -1.0], width) / width

        rows = list(map(haar, _WIDTHS_S, _WIDTH_SAMPLES))
        if self.has_comb:
            period = self.sample_rate_hz / self.mains_hz
            comb = np.zeros(int(np.ceil(self.comb_periods * period)) + 1)
            comb[0] = 1.0
            for number in range(1, self.comb_periods + 1):
                whole, part = divmod(number * period, 1)
                comb[int(whole)] -= (1 - part) / self.comb_periods
                if part:
                    comb[int(whole) + 1] -= part / self.comb_periods
            rows.append(np.convolve(comb, haar(COMB_WIDTH_S)))
        return np.stack([np.pad(row, (0, max(map(len, rows)) - len(row))) for row in rows])

    @property
    def context(self) -> int:
        """Samples before a block that its filters reach back to."""
        return self.filters.shape[1] - 1 if self.hand.fast else 0

    @cached_property
    def filter_matrix(self) -> Array:
        """A block with its context to the outputs of all filters: ``[context + hop, B, hop]``."""
        hop, length = self.hop_samples, self.filters.shape[1]
        matrix = np.zeros((length - 1 + hop, len(self.filters), hop))
        for place in range(hop):
            matrix[place : place + length, :, place] = self.filters[:, ::-1].T
        return matrix

    @cached_property
    def step_matrix(self) -> Tensor:
        """Means of the last blocks to steps: ``[b, D]``; steps of equal blocks once."""
        spans = dict.fromkeys(tuple(map(self.blocks_in, step)) for step in STEPS_S)
        matrix = np.zeros((max(back + length for _, length, back in spans), len(spans)))
        for row, (latest, length, back) in zip(matrix.T, spans, strict=True):
            row[len(row) - latest :] += 1 / latest
            row[len(row) - back - length : len(row) - back] -= 1 / length
        return torch.from_numpy(matrix)

    @cached_property
    def pairs(self) -> Array:
        """Places among the fast channels of those whose correlation is taken, ``[2, P]``."""
        every = np.stack(np.triu_indices(len(self.hand.fast), 1))
        return every[:, :: -(-max(every.shape[1], 1) // _MOST_PAIRS)]

    @cached_property
    def rounding(self) -> Tensor:
        """Power of the converter's rounding behind each filter, ``[B, F]``, float64."""
        steps = np.array(self.resolution or np.zeros(len(self.hand)))[list(self.hand.fast)]
        power = np.square(self.filters).sum(1)[:, None] * np.square(steps) / 12
        return torch.from_numpy(np.maximum(power, _LEAST_POWER))

    @cached_property
    def least_step(self) -> Tensor:
        """Of each slow channel, beside its usual steps, ``[S]``: a third of the converter's."""
        steps = np.array(self.resolution or np.zeros(len(self.hand)))[list(self.hand.slow)]
        return torch.from_numpy(np.maximum(steps / 3, math.sqrt(_LEAST_POWER)))

    @cached_property
    def silence(self) -> Tensor:
        """Half the log power of a silent channel, ``[B, F]``, float64."""
        shape = (len(self.hand.fast), self.num_filters)
        least = torch.tensor(self.least_rms or np.zeros(shape), dtype=torch.float64)
        return 0.5 * (self.rounding + least.mT.square()).log() + _LEAST_RISE

    @cached_property
    def num_columns(self) -> int:
        """``K``."""
        blocks = _Blocks(
            torch.zeros(1, self.num_filters, len(self.hand.fast)).double(),
            torch.zeros(1, self.num_filters, self.pairs.shape[1]).double(),
            torch.zeros(1, len(self.hand.slow)).double(),
            torch.ones(1, len(self.hand.fast)).bool(),
        )
        return self.columns(blocks)[0].shape[1]

    def limits(self) -> str:
        """What a lower rate than 2 kHz takes away, in words; empty if nothing."""
        rate, hop = self.sample_rate_hz, self.hop_samples
        if rate >= 1 / _WIDTHS_S[0]:
            return ""
        lost = [
            f"a decision every {1e3 * hop / rate:g} ms",
            f"power over {1e3 * self.windows[0] * hop / rate:g} ms and longer",
            f"no vibration above {rate / 2:g} Hz",
            f"{1e3 * self.blind * hop / rate:.0f} ms without a score at the start",
        ]
        comb = [] if self.has_comb else ["no filter for the mains"]
        return f"at {rate:g} Hz there is {', '.join(lost + comb)}"

    # what is measured -----------------------------------------------------------------------------

    def blocks(self, samples: Tensor) -> _Blocks:
        """Of every whole block that has its context.

        Args:
            samples: raw, ``context`` of them before the first block; NaN makes its blocks NaN.

        Shape:
            - samples: ``[C, context + m * hop]``
        """
        x, hop, context = samples.double(), self.hop_samples, self.context
        own = x[:, context:].unfold(-1, hop, hop)  # [C, m, hop]
        num = own.shape[1]
        logs = x.new_zeros(num, self.num_filters, 0)
        products = x.new_zeros(num, self.num_filters, 0)
        moves = torch.ones(num, 0, dtype=torch.bool)
        if fast := list(self.hand.fast):
            frames = x[fast].unfold(-1, context + hop, hop)  # [F, m, context + hop]
            matrix = torch.from_numpy(self.filter_matrix).flatten(1)
            filtered = ((frames - frames[..., :1]) @ matrix).unflatten(-1, (-1, hop))
            filtered = filtered.permute(1, 2, 0, 3)  # [m, B, F, hop]
            logs = 0.5 * (filtered.square().mean(-1) + self.rounding).log()
            first, second = torch.from_numpy(self.pairs.copy())
            products = (filtered[:, :, first] * filtered[:, :, second]).mean(-1)
            moves = (own[fast] != own[fast][..., :1]).any(-1).mT | (hop < FEWEST_BLOCK_SAMPLES)
        return _Blocks(logs, products, own[list(self.hand.slow)].mean(-1).mT, moves)

    def blocks_of_recording(self, samples: Tensor) -> _Blocks:
        """Of a whole recording ``[C, T]``: those that have their context."""
        start = -(-self.context // self.hop_samples) * self.hop_samples - self.context
        return self.blocks(samples[:, start:])

    def is_lost(self, blocks: _Blocks, in_use: Tensor) -> Tensor:
        """_Blocks in which too few channels are alive, ``[m]``, bool.

        A fast one is alive where it is finite, moves and is not silent, a slow one where it is
        finite.

        Args:
            blocks: any.
            in_use: channels that are not left out, ``[C]``, bool.
        """
        if not self.hand.fast:
            known = blocks.means.isfinite() & in_use[list(self.hand.slow)]
            return known.sum(-1) < self.min_alive
        known = blocks.logs.sum(1).isfinite() & in_use[list(self.hand.fast)]
        moves = blocks.moves & ((blocks.logs - self.silence).amax(1) > 0.0)
        still = torch.tensor(self.is_still or (False,) * len(self.hand.fast))
        return (known & (moves | still)).sum(-1) < self.min_alive

    def begin(self, blocks: _Blocks) -> _Memory:
        """What is kept where a block is the first: all that was before is equal to it."""
        first = blocks.only(slice(0, 1))
        num_fast, num_slow = len(self.hand.fast), len(self.hand.slow)
        num_steps = self.step_matrix.shape[1]
        zeros = first.logs.new_zeros
        no_step = (0.0 * first.means).unsqueeze(1)  # NaN where a channel is missing
        return _Memory(
            zeros(()),
            first.logs.expand(self.delay, -1, -1),
            first.products.expand(self.delay, -1, -1),
            first.means.expand(len(self.step_matrix) - 1, -1),
            no_step.expand(self.delay, num_steps, num_slow),
            first.logs.new_full((len(FLOORS_S), self.num_filters, num_fast), math.nan),
            first.logs.new_full((num_steps, num_slow), math.nan),
            zeros(0, 0),
        )

    def columns(
        self, blocks: _Blocks, memory: _Memory | None = None, in_use: Tensor | None = None
    ) -> tuple[Tensor, Tensor, _Memory]:
        """The evidence of each of some blocks in a row, at least one, of which none is lost.

        A channel is left out of the pools where one of its blocks that a column rests on is not
        finite, and a fast one while its quickest floor is that of silence.

        Args:
            blocks: ``k`` of them.
            memory: of the blocks before; ``None``: there are none.
            in_use: channels that are not left out, ``[C]``, bool; default all.

        Returns:
            Columns ``[k, K]``; whether there is evidence, ``[k]``, bool; and what is kept, but for
            scaled columns.
        """
        memory = self.begin(blocks) if memory is None else memory
        num, delay, num_floors = len(blocks.means), self.delay, len(FLOORS_S)
        count = memory.num_known + 1 + torch.arange(num, dtype=torch.float64)
        logs = torch.cat([memory.logs, blocks.logs])
        products = torch.cat([memory.products, blocks.products])
        means = torch.cat([memory.means, blocks.means])
        rows = means.unfold(0, len(self.step_matrix), 1)  # [k, S, b]
        steps = ((rows - rows[..., :1]) @ self.step_matrix).mT  # [k, D, S]
        sizes = torch.cat([memory.steps, steps.abs()])
        usual, step_floor = self._floors(
            count,
            torch.cat([logs[:num].repeat(1, num_floors, 1).flatten(1), sizes[:num].flatten(1)], 1),
            torch.cat([memory.floor.flatten(), memory.step_floor.flatten()]),
            blocks.logs[0].numel(),
        )
        floors = usual.unflatten(1, (num_floors * self.num_filters, logs.shape[2]))
        power = (2.0 * logs).exp()
        used = torch.ones(len(self.hand), dtype=torch.bool) if in_use is None else in_use
        columns, is_usable = self.pooled(
            torch.cat([_last_means(power, n, num) for n in self.windows], 1),
            torch.cat([_last_means(products, n, num) for n in self.windows], 1),
            floors,
            steps,
            step_floor.unflatten(1, steps.shape[1:]),
            used[list(self.hand.fast)],
            used[list(self.hand.slow)],
        )
        kept = _Memory(
            count[-1],
            logs[-delay:],
            products[-delay:],
            means[len(means) - len(memory.means) :],
            sizes[-delay:],
            floors[-1].unflatten(0, (num_floors, self.num_filters)),
            step_floor[-1].unflatten(0, steps.shape[1:]),
            memory.scaled,
        )
        return columns, is_usable & (count > self.blind), kept

    def _floors(
        self, count: Tensor, values: Tensor, before: Tensor, num_logs: int
    ) -> tuple[Tensor, Tensor]:
        """Recursive means of delayed finite values: of logs, and of steps.

        Shape:
            - count: ``[k]``; values: ``[k, V]``; before: ``[V]``
            - output: ``[k, 3 * B * F]`` and ``[k, D * S]``
        """
        num_of_logs = num_logs * len(FLOORS_S)
        rates = torch.tensor(self.floor_rates, dtype=torch.float64).repeat_interleave(num_logs)
        rates = torch.cat(
            [rates, rates.new_full((values.shape[1] - num_of_logs,), self.floor_rates[0])]
        )
        since = (count - self.delay).clamp(min=1.0)[:, None]
        made = []
        for x, rate in zip(values, torch.maximum(1.0 / since, rates), strict=True):
            known = torch.where(before.isfinite(), before, x)
            before = torch.where(x.isfinite(), known + rate * (x - known), before)
            made.append(before)
        floors = torch.stack(made)
        return floors[:, :num_of_logs], floors[:, num_of_logs:]

    def pooled(
        self,
        power: Tensor,
        products: Tensor,
        floors: Tensor,
        steps: Tensor,
        step_floor: Tensor,
        fast: Tensor | None = None,
        slow: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Columns of what was measured; in operations that tensors and values of a graph share.

        Args:
            power: mean over each window, of each filter.
            products: the same of pairs.
            floors: of each length and filter.
            steps: of the slow channels.
            step_floor: their usual size.
            fast: fast channels that are not left out; default all.
            slow: slow ones.

        Shape:
            - power: ``[k, W * B, F]``; products: ``[k, W * B, P]``; floors: ``[k, 3 * B, F]``
            - steps, step_floor: ``[k, D, S]``; fast: ``[F]``; slow: ``[S]``, bool
            - output: ``[k, K]`` and ``[k]``, bool
        """
        columns, num_fast, num_slow = list[Tensor](), len(self.hand.fast), len(self.hand.slow)
        alive = None
        if num_fast:
            contrasts, quickest = self._contrasts
            rises = torch.matmul(contrasts, torch.cat([power.log(), floors], 1))  # [k, R, F]
            alive = rises.sum(1).isfinite() & ((floors - quickest).amax(1) > 0.0)  # [k, F]
            alive = alive if fast is None else alive & fast
            rises = torch.where(alive.unsqueeze(1), rises, 0.0)
            columns += _over_channels(rises, alive, num_fast, with_spread=True)
            if num_fast > 1:
                columns += self._correlations(power, products, rises, alive)
        if num_slow:
            known = (steps + step_floor).sum(1).isfinite()
            known = known if slow is None else known & slow
            alive = known if alive is None else alive
            relative = steps / (step_floor + self.least_step)
            relative = torch.where(known.unsqueeze(1), relative, 0.0)
            size = (relative.abs() + 1.0).log()
            columns += _over_channels(torch.cat([size, relative.sign() * size], 1), known, num_slow)
            if num_slow > 1:
                columns.append(relative.sum(-1) / (relative.abs().sum(-1) + _LEAST_STEPS))
        assert alive is not None  # a hand has a channel
        num_alive = alive.type_as(steps if num_slow else power).sum(-1)
        return torch.cat(columns, -1)[..., self._order], num_alive >= float(self.min_alive)

    @cached_property
    def _contrasts(self) -> tuple[Tensor, Tensor]:
        """Log powers and floors to rises, and what a channel that is not silent is above somewhere.

        Rises are those over the longest floor, of each window and filter; then those over the
        shorter ones, of the two shorter windows.

        Shape:
            - output: ``[R, W * B + 3 * B]`` and ``[3 * B, F]``, of which the quickest floors count
        """
        pairs = [(window, 0) for window in range(len(WINDOWS_S))]
        pairs += [(window, floor) for window in (0, 1) for floor in (1, 2)]
        levels, floors = (np.eye(3)[list(each)] for each in zip(*pairs, strict=True))
        signs = np.kron(np.hstack([levels / 2, -floors]), np.eye(self.num_filters))
        slower = torch.full_like(self.silence, math.inf).repeat(len(FLOORS_S) - 1, 1)
        return torch.from_numpy(signs), torch.cat([slower, self.silence])

    @cached_property
    def _order(self) -> list[int]:
        """Where each column is among those that are pooled together."""
        num_levels, num_steps = len(WINDOWS_S) * self.num_filters, self.step_matrix.shape[1]
        num_rises = len(self._contrasts[0])
        fast, slow = (min(len(each), 2) for each in (self.hand.fast, self.hand.slow))
        sizes = [[0, 1, 4][fast] * num_rises, [0, 0, 3][fast] * num_levels]
        sizes += [[0, 1, 3][slow] * 2 * num_steps, [0, 0, 1][slow] * num_steps]
        parts = np.split(np.arange(sum(sizes)), np.cumsum(sizes)[:-1])
        rises, steps = parts[0].reshape(-1, num_rises), parts[2].reshape(-1, 2, num_steps)
        parts[0] = np.r_[rises[:, :num_levels].ravel(), rises[:2, num_levels:].ravel()]
        parts[2] = steps.swapaxes(0, 1).ravel()
        return [int(place) for place in np.concatenate(parts)]

    def _correlations(
        self, power: Tensor, products: Tensor, rises: Tensor, alive: Tensor
    ) -> list[Tensor]:
        """Squared correlation over pairs in use, 0 of none: mean, largest, mean by rises.

        Shape:
            - power: ``[k, W * B, F]``; products: ``[k, W * B, P]``; rises: ``[k, R, F]``, those of
              power first, 0 where not alive; alive: ``[k, F]``
            - output: ``[k, W * B]`` each
        """
        num_fast, num_pairs = len(self.hand.fast), self.pairs.shape[1]
        num_levels = len(WINDOWS_S) * self.num_filters
        first, second = torch.zeros(2, num_fast, num_pairs, dtype=torch.float64)
        first[self.pairs[0], torch.arange(num_pairs)] = 1.0
        second[self.pairs[1], torch.arange(num_pairs)] = 1.0
        rows = alive.unsqueeze(1)
        known = torch.where(rows, power, 1.0)
        own = torch.split(rises, [num_levels, len(self._contrasts[0]) - num_levels], 1)[0]
        of_channels = torch.cat([known, own.clamp(min=0.0), rows.type_as(power)], 1)
        of_pairs = (of_channels @ first) * (of_channels @ second)
        known, weight, both = torch.split(of_pairs, [num_levels, num_levels, 1], 1)
        square = torch.where(both > 0.0, products * products / known, 0.0)
        by_rises = (square * weight).sum(-1) / (weight.sum(-1) + _LEAST_RISE)
        return [square.sum(-1) / both.sum(-1).clamp(min=1.0), square.amax(-1), by_rises]

    def to_dict(self) -> dict[str, Any]:
        """All but the hand and the sample rate, which are the detector's."""
        plain = {name: getattr(self, name) for name in _NUMBERS}
        return plain | {
            "resolution": list(self.resolution),
            "least_rms": [list(row) for row in self.least_rms],
            "is_still": list(self.is_still),
        }

    @classmethod
    def from_dict(
        cls, plain: Mapping[str, Any], hand: HandLayout, sample_rate_hz: float
    ) -> OnsetEvidence:
        """What ``to_dict`` wrote, of a detector's hand; other entries are passed over.

        Raises:
            KeyError, TypeError, ValueError: if a number is missing or no such number.
        """
        numbers = {name: kind(plain[name]) for name, kind in _NUMBERS.items()}
        return cls(
            hand,
            sample_rate_hz,
            resolution=tuple(map(float, plain["resolution"])),
            least_rms=tuple(tuple(map(float, row)) for row in plain["least_rms"]),
            is_still=tuple(map(bool, plain["is_still"])),
            **numbers,
        )


class Perceptron(nn.Module):
    """A network of linear layers with SiLU between them, and one output.

    Args:
        weights: of each layer, ``[out, in]``.
        biases: likewise, ``[out]``.

    Raises:
        ValueError: if shapes disagree, or there is more than one output.
    """

    def __init__(self, weights: Sequence[Tensor], biases: Sequence[Tensor]) -> None:
        super().__init__()
        shapes = [tuple(each.shape) for each in weights]
        fits = all(len(s) == 2 for s in shapes) and [s[0] for s in shapes] == list(map(len, biases))
        fits = fits and all(a[0] == b[1] for a, b in pairwise(shapes))
        if not (shapes and fits and shapes[-1][0] == 1):
            raise ValueError(f"layers must follow each other and end in one output, got {shapes}")
        self.weights = nn.ParameterList([each.detach().clone() for each in weights])
        self.biases = nn.ParameterList([each.detach().clone() for each in biases])

    @classmethod
    def drawn(cls, num_inputs: int, widths: Sequence[int]) -> Perceptron:
        """With weights drawn as ``torch.nn.Linear`` does."""
        sizes = [num_inputs, *widths, 1]
        layers = [nn.Linear(a, b) for a, b in pairwise(sizes)]
        return cls([layer.weight for layer in layers], [layer.bias for layer in layers])

    @property
    def num_features(self) -> int:
        """How many inputs it takes."""
        return int(self.weights[0].shape[1])

    def forward(self, z: Tensor) -> Tensor:
        """The score: ``[*, K] -> [*]``."""
        last = len(self.weights) - 1
        for number, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            z = z @ weight.mT + bias
            if number < last:
                z = z * z.sigmoid()
        return z[..., 0]


Head = QuadraticForm | Perceptron


@dataclass(frozen=True, eq=False)
class OnsetClassifier:
    """Whether a hand slips now, by the evidence of each hop: at least the threshold says yes.

    Args:
        evidence: what a hop is described by.
        scaler: of its columns.
        head: on scaled columns, and on those of the hops ``evidence.lags`` ago behind them if it
            takes as many.
        threshold: of its score.
        hint: a lower one, at which a controller may tighten a little; infinite for none.
        lead_s: from the onset to the first hop that says slip, in the middle.
    """

    evidence: OnsetEvidence
    scaler: FeatureScaler
    head: Head
    threshold: float
    hint: float = math.inf
    lead_s: float = 0.0

    @property
    def lags(self) -> list[int]:
        """Hops back of the further columns that the head takes."""
        is_now = self.head.num_features == self.evidence.num_columns
        return [] if is_now else self.evidence.lags

    def inputs(self, scaled: Tensor, before: Tensor | None = None) -> Tensor:
        """What the head takes of hops in a row.

        Args:
            scaled: columns, ``[k, K]``.
            before: those of the last hops before; ``None``: equal to the first.
        """
        if not (lags := self.lags):
            return scaled
        num = len(scaled)
        if before is None:
            before = scaled[:1].expand(max(lags), -1)
        rows = torch.cat([before, scaled])
        return torch.cat([scaled, *(rows[len(rows) - num - lag :][:num] for lag in lags)], 1)

    def scores(
        self, blocks: _Blocks, memory: _Memory | None = None, in_use: Tensor | None = None
    ) -> tuple[Tensor, _Memory]:
        """Of hops in a row of which none is lost; NaN where there is no evidence.

        Arguments and shapes are those of ``OnsetEvidence.columns``.
        """
        columns, is_usable, kept = self.evidence.columns(blocks, memory, in_use)
        scaled = self.scaler(columns)
        before = None if memory is None else memory.scaled
        score = self.head(self.inputs(scaled, before))
        if lags := self.lags:
            first = scaled[:1].expand(max(lags), -1) if before is None else before
            kept = kept._replace(scaled=torch.cat([first, scaled])[-max(lags) :])
        return torch.where(is_usable, score, math.nan), kept

    def score_recording(self, samples: Tensor) -> Tensor:
        """Means over ``MEAN_HOPS`` of every whole hop; ``NOTHING_YET`` where one has no score.

        So within the first quarter of a second of a recording.

        Shape:
            - samples: ``[C, T]``
            - output: ``[T // hop_samples]``, float64
        """
        return OnsetStream(self).push(samples)

    def to_dict(self) -> dict[str, Any]:
        """The classifier as plain JSON types, without hand and sample rate."""
        of_head: dict[str, Any]
        if isinstance(self.head, Perceptron):
            of_head = {
                "weights": list(map(_packed, self.head.weights)),
                "biases": list(map(_packed, self.head.biases)),
            }
        else:
            of_head = {
                "quadratic": _packed(self.head.matrix),
                "linear": _packed(self.head.linear),
                "constant": float(self.head.constant),
            }
        return {
            **self.evidence.to_dict(),
            "minimum": self.scaler.minimum.tolist(),
            "maximum": self.scaler.maximum.tolist(),
            "head": of_head,
            "threshold": self.threshold,
            "hint": self.hint if self.hint < math.inf else None,
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
        evidence, of_head = OnsetEvidence.from_dict(plain, hand, sample_rate_hz), plain["head"]
        head: Head
        if "weights" in of_head:
            layers = [[*map(_unpacked, of_head[name])] for name in ("weights", "biases")]
            head = Perceptron(*layers).requires_grad_(False)
        else:
            constant = torch.tensor(of_head["constant"], dtype=torch.float64)
            quadratic, linear = (_unpacked(of_head[n]) for n in ("quadratic", "linear"))
            head = QuadraticForm(quadratic, linear, constant)
            if len(quadratic) not in (0, len(linear)):
                raise ValueError(
                    f"expected a quadratic part of {len(linear)} columns, got {len(quadratic)}"
                )
        bounds = (torch.tensor(plain[name], dtype=torch.float64) for name in ("minimum", "maximum"))
        scaler, num = FeatureScaler(*bounds), evidence.num_columns
        known = (num, num * (1 + len(evidence.lags)))
        if len(scaler.minimum) != num or head.num_features not in known:
            raise ValueError(
                f"expected {num} columns of evidence, got {len(scaler.minimum)} and a head of "
                f"{head.num_features}; another version made this alarm, train again"
            )
        hint = math.inf if plain["hint"] is None else float(plain["hint"])
        return cls(evidence, scaler, head, float(plain["threshold"]), hint, float(plain["lead_s"]))


def _packed(x: Tensor) -> dict[str, Any]:
    """Many numbers as text: they are kept in float32."""
    values = x.detach().float().numpy().astype("<f4")
    return {"shape": list(x.shape), "float32": base64.b64encode(values.tobytes()).decode()}


def _unpacked(plain: Mapping[str, Any]) -> Tensor:
    """What ``_packed`` wrote, in float64."""
    values = np.frombuffer(base64.b64decode(plain["float32"]), "<f4").astype(np.float64)
    return torch.from_numpy(values.reshape(plain["shape"]))


class OnsetStream:
    """Scores of a stream as its samples come; its memory has a fixed size.

    A block that is lost (``OnsetEvidence.is_lost``) has no score and leaves the memory as it is.
    Beyond ``most_lost_samples`` of lost samples the memory begins anew, as at the beginning of a
    stream.

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
        self._engine = engine_of(classifier, self._most_lost) if is_native else None
        self._memory: _Memory | None = None  # of torch; the engine has its own
        self._num_lost = 0
        self._hop = 0  # of the next score
        self._skipped = 0  # samples before those that are held
        self._held: Array | None = None
        self._all = np.ones(len(evidence.hand), bool)
        self._scores = np.full(MEAN_HOPS - 1, math.nan)  # of the last blocks that are not lost

    @property
    def state_bytes(self) -> int:
        """_Memory of what is remembered."""
        kept = [] if self._memory is None else [8 * x.numel() for x in self._memory]
        engine = 0 if self._engine is None else self._engine.memory.nbytes
        return sum(kept) + engine + (0 if self._held is None else self._held.nbytes)

    def push(self, samples: Tensor, masked: Tensor | None = None) -> Tensor:
        """The scores of the hops that these samples complete.

        Shape:
            - samples: ``[C, n]``; masked: ``[C]``, bool
            - output: ``[k]``, as ``OnsetClassifier.score_recording`` has them
        """
        evidence, x = self._classifier.evidence, np.ascontiguousarray(samples.detach())
        hop, context = evidence.hop_samples, evidence.context
        held = x if self._held is None else np.concatenate([self._held, x], -1)
        num = (self._skipped + held.shape[-1]) // hop
        mean = np.full(num - self._hop, NOTHING_YET)
        first = max(self._hop, -(-context // hop))  # block that has its context
        if first < num:
            begin = first * hop - context - self._skipped
            in_use = self._all if masked is None else ~masked.numpy()
            made, is_lost = self._score(held[:, begin : num * hop - self._skipped], in_use)
            known = np.concatenate([self._scores, made[~is_lost]])
            mean[first - self._hop :][~is_lost] = mean_of_hops(known)
            self._scores = known[1 - MEAN_HOPS :]
        first = max(first, num)
        self._hop, surplus = num, max(first * hop - context - self._skipped, 0)
        self._held = held[:, surplus:].copy()
        self._skipped += min(surplus, held.shape[-1])
        return torch.from_numpy(mean)

    def _score(self, x: Array, in_use: Array) -> tuple[Array, Array]:
        """Scores of the next hops, NaN without evidence; which are lost."""
        if self._engine is not None:
            score, is_lost, _ = self._engine(x, in_use)
            return score, is_lost
        evidence = self._classifier.evidence
        made, listened = evidence.blocks(torch.from_numpy(x)), torch.from_numpy(in_use)
        is_lost = evidence.is_lost(made, listened).numpy()
        score, kept = np.full(len(is_lost), math.nan), np.flatnonzero(~is_lost)
        lost_before = np.diff(kept, prepend=-1 - self._num_lost) - 1
        self._num_lost = len(is_lost) + (-1 - int(kept[-1]) if len(kept) else self._num_lost)
        for part, hops in enumerate(np.split(kept, np.flatnonzero(lost_before > self._most_lost))):
            memory = None if part else self._memory
            if len(hops):
                found, memory = self._classifier.scores(made.only(hops), memory, listened)
                score[hops] = found.detach().numpy()
            self._memory = memory
        return score, is_lost


def engine_of(
    classifier: OnsetClassifier, most_lost: int, *, with_columns: bool = False
) -> OnsetEngine:
    """The native engine of a classifier; ``with_columns``: it hands out columns, not scaled."""
    evidence, scaler, head = classifier.evidence, classifier.scaler, classifier.head
    width = (scaler.maximum - scaler.minimum).numpy()
    slope = np.divide(2.0, width, out=np.zeros_like(width), where=width > 0)
    offset = np.where(width > 0, -1.0, 0.0) - slope * scaler.minimum.numpy()
    if isinstance(head, Perceptron):
        pairs = zip(head.weights, head.biases, strict=True)
        layers = [(w.detach().double().numpy(), b.detach().double().numpy()) for w, b in pairs]
        form = None
    else:
        quadratic = np.empty((0, 0)) if head.is_linear else head.matrix.double().numpy()
        layers, form = [], (quadratic, head.linear.double().numpy(), float(head.constant))
    return OnsetEngine(
        fast=evidence.hand.fast,
        slow=evidence.hand.slow,
        windows=evidence.windows,
        pairs=evidence.pairs,
        lags=classifier.lags,
        filters=evidence.filter_matrix,
        context=evidence.context,
        steps=evidence.step_matrix.numpy(),
        rounding=evidence.rounding.numpy(),
        least_step=evidence.least_step.numpy(),
        silence=evidence.silence.numpy(),
        rates=evidence.floor_rates,
        scaling=(slope, offset),
        layers=layers,
        form=form,
        is_still=evidence.is_still or (False,) * len(evidence.hand.fast),
        min_alive=evidence.min_alive,
        blind=evidence.blind,
        most_lost=most_lost,
        with_columns=with_columns,
    )


def _over_channels(
    values: Tensor, in_use: Tensor, num_channels: int, *, with_spread: bool = False
) -> list[Tensor]:
    """Mean, largest, smallest, spread over channels in use, 0 of none; of one channel itself.

    Values of others are 0.

    Shape:
        - values: ``[k, R, C]``; in_use: ``[k, C]``; output: ``[k, R]`` each
    """
    rows = in_use.unsqueeze(1)
    num = rows.type_as(values).sum(-1).clamp(min=1.0)
    mean = values.sum(-1) / num
    if num_channels == 1:
        return [mean]
    known = torch.where(rows, values, mean.unsqueeze(-1))
    found = [mean, known.amax(-1), known.amin(-1)]
    if with_spread:
        off = known - mean.unsqueeze(-1)
        found.append(((off * off).sum(-1) / num).sqrt())
    return found


def mean_of_hops(score: Array) -> Array:
    """Means of each hop and those before it, ``NOTHING_YET`` for NaN: ``[2 + k] -> [k]``."""
    mean = sum((score[i : len(score) + 1 - MEAN_HOPS + i] for i in range(MEAN_HOPS)), 0.0)
    return np.where(np.isfinite(mean), mean / MEAN_HOPS, NOTHING_YET)


def _last_means(rows: Tensor, length: int, num: int) -> Tensor:
    """Of the last ``num`` rows, each the mean of it and those before, ``length`` in all."""
    return rows[len(rows) - num - length + 1 :].unfold(0, length, 1).mean(-1)

"""The pipeline as the paper writes it, for ``torch.onnx.export``: the peer of our own export.

A convolution for the filter, ptwt's convolutions for the wavelet, ``torch.fft`` for the spectra,
every descriptor by its definition, the scaler, and the kernel sum over the training bins. What
descriptors share is computed once, and nothing is made slower than it has to be.
"""

from __future__ import annotations

import contextlib
import io
import logging
import warnings
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import conv1d

from benchmarks.deployment.definitions import described
from tactslip_torch.features.names import FeatureName
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.hand import Adapting
from tactslip_torch.model.kernel_sum import KernelSum
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.runtime import whole_file
from tactslip_torch.signals.filtering import ChannelFilter, edge_matrices
from tactslip_torch.signals.spectrum import amplitude_spectrum, frequency_axis_hz
from tactslip_torch.signals.wavelet import branch_names, wavelet_branches

OPSET = 20
_RATIO = "band_energy_ratio"
_WAYS: tuple[Adapting, ...] = ("slow", "fast")


class _Block(NamedTuple):
    """Features that are made together: each descriptor of each component of each channel."""

    channels: tuple[str, ...]
    components: tuple[str, ...]
    domain: str
    descriptors: tuple[str, ...]

    @classmethod
    def around(cls, names: Sequence[FeatureName]) -> _Block:
        """The smallest that holds these features, all of one domain."""
        columns = zip(*((n.channel, n.component, n.descriptor) for n in names), strict=True)
        channels, components, descriptors = (tuple(dict.fromkeys(column)) for column in columns)
        return cls(channels, components, names[0].domain, descriptors)

    def names(self) -> list[FeatureName]:
        """In the order in which they are made."""
        each = product(self.channels, self.components, self.descriptors)
        return [FeatureName(ch, component, self.domain, name) for ch, component, name in each]


class NaivePipeline(nn.Module):
    """Raw bins to scores.

    Args:
        pool: what features there are.
        channel_filter: centred, with one frame for gauges and one for films.
        selected: pool indices of the K features that the head takes, in its order.
        scaler: of these.
        machine: the kernel sum.
        is_whole: whether the whole pool is made before K features of it are taken, as the paper
            does; else only the channels, branches and descriptors that some selected feature needs.

    Shape:
        - samples: ``[B, C, n + 2 * context]``, volts
        - output: ``[B]``, dtype of the module, which starts in float64
    """

    take: Tensor
    frequency_hz: Tensor
    low: Tensor
    width: Tensor
    knee: Tensor | None

    def __init__(
        self,
        pool: FeaturePool,
        channel_filter: ChannelFilter,
        selected: Sequence[int],
        scaler: FeatureScaler,
        machine: KernelSum,
        is_whole: bool = True,
    ) -> None:
        super().__init__()
        chosen = [pool.names[index] for index in selected]
        self._pool, self._context = pool, channel_filter.context
        self._blocks = _blocks(pool.names if is_whole else chosen)
        made = [name for block in self._blocks for name in block.names()]
        constants = {
            "take": torch.tensor([made.index(name) for name in chosen]),
            "frequency_hz": frequency_axis_hz(pool.bin_samples, pool.sample_rate_hz, pool.spectrum),
            "low": scaler.minimum,
            "width": scaler.maximum - scaler.minimum,
            "knee": scaler.knee,
        }
        for way in _WAYS:
            length = channel_filter.window_lengths[_places(pool, way)[0]]
            kernel = edge_matrices(length, channel_filter.polyorder, "centred")[1]
            constants[f"kernel_{way}"] = kernel[None, None]  # symmetric, as it is centred
        for name, value in constants.items():
            self.register_buffer(name, None if value is None else value.clone())
        self.machine = KernelSum(machine.support, machine.beta, machine.kernel)

    def forward(self, samples: Tensor) -> Tensor:
        """Scores; at least 0 means slip."""
        features = self._features(samples).index_select(-1, self.take)
        if self.knee is not None:
            features = features.sign() * self.knee * (features.abs() / self.knee).log1p()
        score: Tensor = self.machine((2 * ((features - self.low) / self.width) - 1).clamp(-1, 1))
        return score

    def _features(self, samples: Tensor) -> Tensor:
        films = self._filtered(samples, "fast")
        flat = wavelet_branches(films.flatten(0, 1), self._pool.wavelet, self._pool.level)
        branches = flat.unflatten(0, (-1, films.shape[1]))  # [B, films, branches, n]
        spectra = amplitude_spectrum(branches, self._pool.spectrum)
        parts = []
        for block in self._blocks:
            if block.components == ("raw",):
                gauges = _taken(self._filtered(samples, "slow"), 1, self._rows("slow", block))
                values = described(gauges[:, :, None], gauges.abs().amax(-1)[..., None])
            elif block.descriptors == (_RATIO,):
                energies = (spectra * spectra).sum(-1)
                shares = energies / energies.sum(-1, keepdim=True)
                values = {_RATIO: self._chosen(shares, block)}
            else:
                raw = _taken(films, 1, self._rows("fast", block))[:, :, None]
                scale = raw.abs().amax(-1)
                x = self._chosen(branches if block.domain == "time" else spectra, block)
                if block.domain == "time":
                    values = described(x, scale, reference=raw)
                else:
                    values = described(x, scale, frequency_hz=self.frequency_hz)
            parts.append(torch.stack([values[name] for name in block.descriptors], -1).flatten(1))
        return torch.cat(parts, -1)

    def _filtered(self, samples: Tensor, way: Adapting) -> Tensor:
        """All channels that adapt so, ``[B, channels, n]``."""
        kernel = self.get_buffer(f"kernel_{way}")
        start = self._context - kernel.shape[-1] // 2
        rows = _taken(samples, 1, list(_places(self._pool, way)))
        rows = rows.narrow(-1, start, self._pool.bin_samples + kernel.shape[-1] - 1)
        num = rows.shape[1]
        filtered: Tensor = conv1d(rows.flatten(0, 1)[:, None], kernel)
        return filtered.reshape(-1, num, self._pool.bin_samples)

    def _chosen(self, x: Tensor, block: _Block) -> Tensor:
        """Of all films and branches, ``[B, films, branches, *]``, those of a block."""
        order = branch_names(self._pool.level)
        components = [order.index(name) for name in block.components]
        return _taken(_taken(x, 1, self._rows("fast", block)), 2, components)

    def _rows(self, way: Adapting, block: _Block) -> list[int]:
        """Places of a block's channels among those that adapt as they do."""
        order = [self._pool.hand.names[index] for index in _places(self._pool, way)]
        return [order.index(name) for name in block.channels]


def _places(pool: FeaturePool, way: Adapting) -> tuple[int, ...]:
    return pool.hand.slow if way == "slow" else pool.hand.fast


def export_naive(module: NaivePipeline, samples: Tensor, path: Path) -> None:
    """Write ``samples [B, C, n + 2 * context] -> score [B]`` in float32, as PyTorch exports it.

    float32, because onnxruntime has no convolution in float64.

    Args:
        module: the pipeline; it becomes float32.
        samples: some raw bins, at least two.
        path: of the file.
    """
    with whole_file(path) as temporary, _quiet():
        torch.onnx.export(
            module.float().eval(),
            (samples.float(),),
            str(temporary),
            dynamo=True,
            external_data=False,
            opset_version=OPSET,
            input_names=["samples"],
            output_names=["score"],
            dynamic_shapes=({0: torch.export.Dim.DYNAMIC},),
        )


def _blocks(names: Sequence[FeatureName]) -> list[_Block]:
    """What holds all features: gauges, then films in time and frequency, then energy ratios."""
    kinds = (
        [name for name in names if name.component == "raw"],
        [name for name in names if name.component != "raw" and name.domain == "time"],
        [name for name in names if name.domain == "freq" and name.descriptor != _RATIO],
        [name for name in names if name.descriptor == _RATIO],
    )
    return [_Block.around(kind) for kind in kinds if kind]


def _taken(x: Tensor, axis: int, places: list[int]) -> Tensor:
    """``x`` at some places of an axis; neighbours as a view."""
    if places == list(range(places[0], places[0] + len(places))):
        return x.narrow(axis, places[0], len(places))
    return x.index_select(axis, torch.tensor(places))


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keep the exporter, which prints its progress and warns of its own internals, to itself."""
    loggers = [logging.getLogger(name) for name in ("torch.onnx", "onnxscript", "onnx_ir")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.ERROR)
    try:
        with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)

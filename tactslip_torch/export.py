"""Write a detector as ONNX: ``python -m tactslip_torch.export model=detector.pt``.

The graph takes raw bins with their filter context, in float32, and gives for each a score and
whether it is valid, as ``SlipDetector.judge_raw``: a channel with a NaN or Inf counts as missing.
It holds the whole pool, matrices for every linear map, and no operator that is slow or missing in
onnxruntime. A file is left only if onnxruntime gives torch's scores and flags at batch sizes the
graph was not traced with, on dead and broken channels too.

ONNX has no ``log1p``: a scaler's knee becomes ``Log(1 + x)``, off by some float64 eps of the knee.
"""

from __future__ import annotations

import contextlib
import copy
import io
import logging
import os
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path

import hydra
import numpy as np
import onnx
import onnxruntime
import torch
from omegaconf import DictConfig
from torch import Tensor, nn

import tactslip_torch
from tactslip_torch.config import conf_dir, errors_in_one_line, run_entry_point
from tactslip_torch.files import whole_file
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.simulation.extremes import EXTREMES, extreme_bins

OPSET = 20
CHECKED_BATCHES = (1, 7, 56)
WORST_ERROR = 1e-3
"""Largest allowed ``onnx_error``."""
CHECKED_SHARE = 0.9
"""Share of bins that it speaks of where the pool computes in float32 (``arithmetic="native"``):
mode and entropy step, and a step may fall between two sums. It speaks of all where it does not."""


class _RawJudgement(nn.Module):
    """``judge_raw`` as ``forward``, which is what gets exported."""

    def __init__(self, detector: SlipDetector) -> None:
        super().__init__()
        self.detector = detector

    def forward(self, samples: Tensor) -> tuple[Tensor, Tensor]:
        score, is_valid, _ = self.detector.judge_raw(samples)
        return score, is_valid


def export_onnx(detector: SlipDetector, path: str | os.PathLike[str]) -> float:
    """Write ``samples [B, C, before + n + after] -> score [B], valid [B]``, float32, and check it.

    Returns:
        ``onnx_error`` of the file.

    Raises:
        ValueError: if onnxruntime's scores differ by more than ``WORST_ERROR``, or its flags at
            all; no file is left.
    """
    single = copy.deepcopy(detector).float().eval()
    with whole_file(path) as temporary:
        traced = torch.randn(3, *_input_shape(detector))
        _write_graph(_RawJudgement(single), traced, temporary, ("score", "valid"))
        _describe_in_file(detector, temporary)
        worst = onnx_error(detector, temporary)
        if not worst <= WORST_ERROR:
            raise ValueError(
                f"onnxruntime and torch differ by {worst:.2e} standard deviations of the score, "
                f"more than {WORST_ERROR:g}: {os.fspath(path)} was not written"
            )
        if wrong := _wrong_flags(detector, temporary):
            raise ValueError(
                f"onnxruntime and torch disagree on which bins are valid (kinds {wrong}): "
                f"{os.fspath(path)} was not written"
            )
    return worst


def onnx_error(detector: SlipDetector, path: str | os.PathLike[str]) -> float:
    """Difference between the scores of an exported file and of the detector in float32.

    On noise of several sizes, at batch sizes the graph was not traced with; in units of the
    standard deviation of the detector's scores there; exceeded by no bin, or by a tenth of the bins
    at most where features are computed in float32.
    What float32 itself costs is another question: it belongs to the detector, not to the file.

    Raises:
        ValueError: if the graph gives another number of scores than bins.
    """
    single = copy.deepcopy(detector).float()
    session = onnxruntime.InferenceSession(os.fspath(path), providers=["CPUExecutionProvider"])
    generator = torch.Generator().manual_seed(0)
    errors, scores = [], []
    for batch in CHECKED_BATCHES:
        size = 10 ** torch.linspace(0, -3, batch)[:, None, None]
        samples = size * torch.randn(batch, *_input_shape(detector), generator=generator)
        with torch.no_grad():
            expected = single.score_raw(samples)
        got = torch.from_numpy(session.run(["score"], {"samples": samples.numpy()})[0])
        if got.shape != expected.shape:
            raise ValueError(
                f"the graph gives scores {tuple(got.shape)} at batch {batch}, "
                f"expected {tuple(expected.shape)}"
            )
        errors.append((got - expected).abs())
        scores.append(expected)
    share = CHECKED_SHARE if single.pool.arithmetic == "native" else 1.0
    return float(torch.cat(errors).quantile(share) / torch.cat(scores).std())


def _wrong_flags(detector: SlipDetector, path: Path) -> list[str]:
    """Kinds of extreme bins of which a file and the detector disagree, or give no finite score."""
    single = copy.deepcopy(detector).float()
    session = onnxruntime.InferenceSession(os.fspath(path), providers=["CPUExecutionProvider"])
    generator = torch.Generator().manual_seed(2)
    wrong = []
    for kind in (*EXTREMES, "nan", "inf"):
        broken = kind not in EXTREMES
        drawn = extreme_bins(
            "plain" if broken else kind, (24, *_input_shape(detector)), generator, torch.float32
        )
        if broken:  # one sample of one channel a bin
            rows = torch.arange(24)
            drawn[rows, rows % drawn.shape[1], 5 * rows % drawn.shape[2]] = float(kind)
        with torch.no_grad():
            expected = single.judge_raw(drawn).is_valid
        score, is_valid = session.run(["score", "valid"], {"samples": drawn.numpy()})
        if not (np.isfinite(score).all() and np.array_equal(is_valid, expected.numpy())):
            wrong.append(kind)
    return wrong


def float32_error(detector: SlipDetector, num_bins: int = 256) -> dict[str, float]:
    """What float32 costs the detector: torch against torch in float64, on generated bins.

    Noise of several sizes, the gauges with an offset of 1 V. ``certify`` measures it on recordings.

    Returns:
        ``float32_median`` and ``float32_p95``, differences in standard deviations of the score, and
        ``float32_flips``, the share of bins whose decision differs.
    """
    hand = detector.pool.hand
    generator = torch.Generator().manual_seed(1)
    size = 10 ** torch.linspace(0, -3, num_bins)[:, None, None]
    samples = size * torch.randn(num_bins, *_input_shape(detector), generator=generator)
    samples[:, list(hand.indices("SG"))] += 1.0
    with torch.no_grad():
        single = copy.deepcopy(detector).float().score_raw(samples)
        double = copy.deepcopy(detector).double().score_raw(samples.double())
    errors = (single - double).abs() / double.std()
    return {
        "float32_median": float(errors.median()),
        "float32_p95": float(errors.quantile(0.95)),
        "float32_flips": float(((single >= 0) != (double >= 0)).double().mean()),
    }


def _write_graph(
    module: nn.Module, traced: Tensor, path: Path, outputs: Sequence[str] = ("score",)
) -> None:
    """Trace a module of one input and named outputs; their first axis may have any length."""
    # the exporter prints its progress and warns of its own internals
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings(), _quiet():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            module,
            (traced,),
            str(path),
            dynamo=True,
            external_data=False,
            opset_version=OPSET,
            input_names=["samples"],
            output_names=list(outputs),
            dynamic_shapes=({0: torch.export.Dim.DYNAMIC},),
        )


def _describe_in_file(detector: SlipDetector, path: Path) -> None:
    """Put what a host must know of the input into the file's metadata."""
    model = onnx.load(path)
    facts = {
        "tactslip_torch": tactslip_torch.__version__,
        "channels": ",".join(detector.pool.hand.names),
        "unit": "V",
        "sample_rate_hz": f"{detector.pool.sample_rate_hz:g}",
        "bin_samples": str(detector.pool.bin_samples),
        "context_before_samples": str(detector.context_before),
        "context_after_samples": str(detector.context_after),
        "look_ahead_samples": str(detector.look_ahead),
        "simulated": str(bool(detector.info.get("simulated", False))).lower(),
        "slip_if_score_at_least": "0",
        "valid": "false: a channel in use is dead, or held a NaN or Inf and was left out",
    }
    onnx.helper.set_model_props(model, facts)
    onnx.save(model, path)


def _input_shape(detector: SlipDetector) -> tuple[int, int]:
    pool = detector.pool
    context = detector.context_before + detector.context_after
    return len(pool.hand), pool.bin_samples + context


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keep the exporter's libraries from logging every rewrite."""
    loggers = [logging.getLogger(name) for name in ("torch.onnx", "onnxscript", "onnx_ir")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


@hydra.main(version_base="1.3", config_path=str(conf_dir()), config_name="export")
def main(config: DictConfig) -> None:
    """Entry point."""
    with errors_in_one_line():
        output = Path(config.output or Path(config.model).with_name("model.onnx"))
        detector = SlipDetector.load(config.model)
        worst = export_onnx(detector, output)
        cost = float32_error(detector)
        print(
            f"{output}: {output.stat().st_size} bytes, within {worst:.1e} score deviations of "
            f"float32 torch; float32 itself costs {cost['float32_median']:.1e} (median), "
            f"{cost['float32_p95']:.1e} (95 %), and flips {cost['float32_flips']:.2%} of decisions "
            "on generated bins"
        )


if __name__ == "__main__":
    run_entry_point(main)

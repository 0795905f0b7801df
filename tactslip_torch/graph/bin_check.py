"""A bin graph against the detector in float64: scores, validity, probabilities, broken bins too."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import pad

from tactslip_torch.features.extractor import FeatureExtractor
from tactslip_torch.graph.form import Form, Window
from tactslip_torch.graph.runs import Run
from tactslip_torch.graph.trials import (
    KINDS,
    dead_masks,
    degenerate_bins,
    noise_bins,
    simulated_bins,
    unit_of,
)
from tactslip_torch.model.calibration import probability
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.missing_channels import widened_llr
from tactslip_torch.model.prediction import Prediction
from tactslip_torch.onset.settings import calibration_of

BATCHES = (1, 7, 0, 56)
WORST_SD = {"float32": 1e-3, "float64": 1e-9}
"""Largest score error allowed on noise and on simulated bins, in standard deviations of the score
on simulated bins."""
WORST_DEGENERATE_SD = {"float32": 1e-2, "float64": 1e-6}
"""The same on degenerate bins, but for those that rounding decides (``Judged.is_rounding``)."""
WORST_PROBABILITY = {"float32": 1e-5, "float64": 1e-9}
"""By which a probability may differ from that of the score beside it."""
_SIMULATED, _EACH = 256, 16  # bins, and of each degenerate kind
_DRAWS = 4  # of moves by which rounding is told, each taken both ways


@dataclass(frozen=True)
class Compared:
    """What a graph said of bins, beside what the detector says.

    Attributes:
        error: ``[N]``, size of the difference of scores.
        unstated: ``[N]``, how far the probability is off that of its score; 0 if there is none.
        flips: ``[N]``, bool: it decides otherwise.
        exact: ``[N]``, scores in float64.
        is_valid: ``[N]``, bool, as the detector has it.
    """

    error: NDArray[np.float64]
    unstated: NDArray[np.float64]
    flips: NDArray[np.bool_]
    exact: NDArray[np.float64]
    is_valid: NDArray[np.bool_]

    def of(self, some: slice | NDArray[np.bool_]) -> Compared:
        """Some of the bins."""
        return Compared(
            self.error[some],
            self.unstated[some],
            self.flips[some],
            self.exact[some],
            self.is_valid[some],
        )


def check_bins(run: Run, detector: SlipDetector, form: Form) -> dict[str, Any]:
    """Hold a bin graph against its detector.

    Args:
        run: the graph.
        detector: that it was made of; judged by in float64, on the samples that the graph is given.
        form: of the graph.

    Returns:
        What was measured, in JSON types.

    Raises:
        ValueError: for the first thing that is wrong, in one line.
    """
    judged = Judged(run, detector, form)
    hand, rate = detector.pool.hand, detector.pool.sample_rate_hz
    length, dtype = judged.window.length, judged.dtype
    pooling = detector.pooling
    unit = unit_of(None if pooling is None else pooling.least_range)
    simulated = unit * simulated_bins(hand, rate, _SIMULATED, length, dtype)
    slip = judged.compare([simulated], "simulated bins")
    drawn = [
        unit * noise_bins(hand, batch, length, seed, dtype) for seed, batch in enumerate(BATCHES)
    ]
    noise = judged.compare(drawn, "noise")
    # the latter of a detector for which nothing happens in a simulation
    sd = float(slip.exact.std()) or float(noise.exact.std()) or 1.0
    worst, loose = WORST_SD[form.precision], WORST_DEGENERATE_SD[form.precision]
    facts: dict[str, Any] = {"score_sd": sd, "simulated": True}
    for name, compared in (("noise", noise), ("simulated_slip", slip)):
        facts[name] = _set_facts(compared, sd)
        judged.refuse_errors(compared, sd, worst, name)
    facts["degenerate"] = {}
    first = []
    for kind in KINDS:
        bins = degenerate_bins(hand, kind, _EACH, length, dtype)
        compared = judged.compare([bins], f"degenerate bins ({kind})")
        facts["degenerate"][kind] = _set_facts(compared, sd)
        firm = ~judged.is_rounding(bins, compared.exact, loose * sd)
        judged.refuse_errors(compared.of(firm), sd, loose, kind)
        facts["degenerate"][kind] |= {
            "decided_by_rounding": int((~firm).sum()),
            "worst_sd_of_others": float(compared.error[firm].max(initial=0.0)) / sd,
        }
        first.append(bins[:1])
    # in one batch with whole ones, where a graph may go another way
    mixed = torch.cat([*first, simulated])
    behind = judged.compare([mixed], "degenerate among simulated bins").of(slice(len(first), None))
    judged.refuse_errors(behind, sd, worst, "simulated bins behind degenerate ones")
    facts["dead"] = {}
    for name, dead in dead_masks(hand, detector.needed_index).items():
        judged.masked_channels = dead
        without = judged.compare([simulated], f"simulated bins without {name}")
        facts["dead"][name] = _set_facts(without, sd)
        judged.refuse_errors(without, sd, loose, f"simulated bins without {name}")
    return facts


class Judged:
    """Bins as the graph and as the detector in float64 judge them."""

    def __init__(self, run: Run, detector: SlipDetector, form: Form) -> None:
        self.run = run
        self.detector = copy.deepcopy(detector).double()
        self.window = Window.of(detector)
        self.form = form
        self.dtype = torch.float32 if form.precision == "float32" else torch.float64
        self.calibrated = calibration_of(detector)
        self.unstated = WORST_PROBABILITY[form.precision]
        self.masked_channels: Tensor | None = None
        other = copy.copy(self.detector)
        other.extractor = FeatureExtractor(other.pool, other.selected, "torch")
        self.others = [other]

    def judge(self, samples: Tensor) -> Prediction:
        """By torch, scores in float64."""
        with torch.no_grad():
            # a sensor is trusted by what its samples resolve in the precision they come in
            trusted = self.detector.predict_raw(
                self._padded(samples), masked_channels=self.masked_channels
            )
        return self.exact(samples)._replace(is_valid=trusted.is_valid)

    def exact(self, samples: Tensor, detector: SlipDetector | None = None) -> Prediction:
        """In float64, by the detector or one of ``others``, whose features other backends make."""
        detector = detector or self.detector
        with torch.no_grad():
            return detector.predict_raw(
                self._padded(samples.double()), masked_channels=self.masked_channels
            )

    def _padded(self, samples: Tensor) -> Tensor:
        """With the context of all channels: what no filter in use takes in is 0."""
        before = self.detector.context_before - self.window.before
        after = self.detector.context_after - self.window.after
        return pad(samples, (before, after))

    def is_rounding(
        self, samples: Tensor, exact: NDArray[np.float64], most: float
    ) -> NDArray[np.bool_]:
        """Bins ``[N]`` whose score another rounding changes by more than ``most``.

        Such as the sign of a mean of 0, by which the coefficient of variation takes its own, or a
        step between values of few digits. Rounding is another in another backend, and where samples
        are moved by 4 eps of the largest magnitude of their channel in float64, together and each
        by itself, up and down: a constant stays one.
        """
        x = samples.double()
        size = (
            4 * torch.finfo(x.dtype).eps * x.nan_to_num(0.0, 0.0, 0.0).abs().amax(-1, keepdim=True)
        )
        generator = torch.Generator().manual_seed(0)
        drawn = 2 * torch.rand((_DRAWS, *x.shape), generator=generator, dtype=x.dtype) - 1
        moves = [size, -size, *(size * drawn), *(-size * drawn)]
        others = [self.exact(x, other).score for other in self.others]
        moved = self.exact(torch.cat([x + move for move in moves])).score
        moved = moved.unflatten(0, (-1, len(x)))
        scores = torch.cat([torch.stack(others), moved]).numpy()
        return np.asarray((np.abs(scores - exact) > most).any(0))

    def compare(self, batches: Sequence[Tensor], what: str) -> Compared:
        """Errors, where shapes and validity are right and scores finite.

        Raises:
            ValueError: where one is not.
        """
        expected = [self.judge(samples) for samples in batches]
        try:
            asked = (
                {}
                if self.masked_channels is None
                else {"masked_channels": self.masked_channels.numpy()}
            )
            runs = [self.run({"samples": samples.numpy(), **asked}) for samples in batches]
        except ValueError as error:
            raise ValueError(f"{what}: {error}") from error
        for samples, given in zip(batches, runs, strict=True):
            self._check_form(given, len(samples), what)
        got = {name: np.concatenate([given[name] for given in runs]) for name in runs[0]}
        score = got["score"].astype(np.float64)
        exact = torch.cat([judged.score for judged in expected]).numpy()
        is_valid = torch.cat([judged.is_valid for judged in expected]).numpy()
        if not np.isfinite(score).all():
            raise ValueError(f"{what}: {(~np.isfinite(score)).sum()} scores are not finite")
        if wrong := int((got["valid"] != is_valid).sum()):
            raise ValueError(f"{what}: valid differs from torch on {wrong} of {len(score)} bins")
        unstated = np.zeros(len(score))
        if self.calibrated is not None:
            calibration, slip_share = self.calibrated
            variance = torch.cat([judged.variance for judged in expected]).double()
            llr = widened_llr(calibration, torch.from_numpy(score), variance)
            stated = probability(llr, slip_share).numpy()
            unstated = np.abs(got["probability"] - stated)
        flips = (score >= 0) != (exact >= 0)
        return Compared(np.abs(score - exact), unstated, flips, exact, is_valid)

    def refuse_errors(self, compared: Compared, sd: float, worst: float, what: str) -> None:
        """Raise if a score is further off than it may be, or a probability than that allows."""
        if not (found := float(compared.error.max(initial=0.0)) / sd) <= worst:
            raise ValueError(
                f"{what}: scores differ from torch in float64 by {found:.1e} of their standard "
                f"deviation, more than {worst:g}"
            )
        if not (found := compared.unstated.max(initial=0.0)) <= self.unstated:
            raise ValueError(
                f"{what}: probability is {found:.1e} off that of its score, more than "
                f"{self.unstated:g}"
            )

    def _check_form(self, got: dict[str, NDArray[Any]], num: int, what: str) -> None:
        wanted = {"score": self.form.dtype, "valid": np.dtype(bool)}
        if self.calibrated is not None:
            wanted["probability"] = self.form.dtype
        found = {name: f"{array.dtype}{list(array.shape)}" for name, array in got.items()}
        expected = {name: f"{dtype}[{num}]" for name, dtype in wanted.items()}
        if found != expected:
            raise ValueError(f"{what}: it gives {_listed(found)}, expected {_listed(expected)}")


def _listed(arrays: dict[str, str]) -> str:
    return ", ".join(f"{name} {arrays[name]}" for name in sorted(arrays))


def _set_facts(compared: Compared, sd: float) -> dict[str, Any]:
    return {
        "bins": len(compared.error),
        "valid": int(compared.is_valid.sum()),
        "worst_sd": float(compared.error.max(initial=0.0)) / sd,
        "flips": int(compared.flips.sum()),
    }

"""How far rounding reaches: ``python -m benchmarks.numerics``.

The same bins, plain and damaged, by every backend; the change of the last digit of samples that
moves scores most, found by gradients; and the solver beside a solution of 80 digits.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, ClassVar

import mpmath
import numpy as np
import torch
from torch import Tensor

from benchmarks.deployment import bin_outputs
from benchmarks.harness import Benchmark, Job, say
from benchmarks.subjects import Array, loaded, raw_bins
from benchmarks.tables import Table, number
from benchmarks.timing import on_threads
from benchmarks.trainings import main_job_detector
from tactslip_torch import SlipDetector
from tactslip_torch.deploy.export import export_detector
from tactslip_torch.model.fit import TrainingBins, fit_machine

_CASES: dict[str, Callable[[Tensor], Tensor]] = {
    "as recorded": lambda x: x,
    "gain 1/1000": lambda x: x / 1000,
    "gain 1000": lambda x: x * 1000,
    "offset of 100 V": lambda x: x + 100,
    "8 mV steps": lambda x: (x / 0.008).round() * 0.008,
    "clipped at 50 mV": lambda x: x.clamp(-0.05, 0.05),
    "three channels lost": lambda x: x.index_fill(1, torch.tensor([1, 9, 20]), torch.nan),
    "half of the channels zero": lambda x: x.index_fill(1, torch.arange(0, x.shape[1], 2), 0.0),
    "one sample lost": lambda x: x.index_fill(2, torch.tensor([x.shape[2] // 2]), torch.nan),
    "all zero": torch.zeros_like,
}


@dataclass(frozen=True)
class Numerics(Benchmark):
    """Backends, last digits and the solver.

    Args:
        bins: of each case.
        recordings: simulated, of which they are.
        attacked: bins of the smallest scores, whose last digits are moved.
        steps: of the search.
        systems: random ones of each kind and penalty.
    """

    title = "How far rounding reaches"
    about = "the detector of the main job (`+exp=unseen4`, the default recipe) on simulated bins"
    page = "docs/numerics.md"
    quick = "bins=8 recordings=1 attacked=2 steps=1 systems=1"
    charts: ClassVar = {"": [("Backends", ("native, float32", "onnxruntime, float32"))]}
    bins: int = 1000
    recordings: int = 12
    attacked: int = 200
    steps: int = 5
    systems: int = 3

    def measure(self, job: Job) -> dict[str, Any]:
        """Three tables."""
        path = main_job_detector(job)
        with on_threads(1):
            tables = {
                "Backends": self._backends(path),
                "Last digits": self._last_digits(path),
                "The solver beside 80 digits": self._solver(),
            }
        return {"tables": tables}

    @torch.no_grad()
    def _backends(self, path: Path) -> Table:
        exact = loaded(path, backend="torch")
        ways = {
            "native, float64": _scores_of(loaded(path), torch.float64),
            "native, float32": _scores_of(loaded(path, torch.float32), torch.float32),
        }
        rows = []
        samples = raw_bins(self.bins, self.recordings).double()
        with TemporaryDirectory(prefix="tactslip-bench-") as folder:
            for precision in ("float32", "float64"):
                place = Path(folder) / precision
                place.mkdir()
                (graph,) = export_detector(exact, place, ("bin",), precision)
                ways[f"onnxruntime, {precision}"] = bin_outputs(graph)
            for case, change in _CASES.items():
                say(f"numerics: {case}")
                given = change(samples).float().double()
                reference, is_valid = _scores_of(exact, torch.float64)(given)
                sd = float(np.std(reference[is_valid])) if is_valid.any() else 1.0
                row: dict[str, Any] = {"bins": case, "valid %": f"{100 * is_valid.mean():.1f}"}
                flips = 0
                for name, way in ways.items():
                    scores, valid = way(given)
                    both = valid & is_valid
                    flips += int((valid != is_valid).sum())
                    flips += int(((scores >= 0) != (reference >= 0))[both].sum())
                    off = np.abs(scores - reference)[both].max(initial=0.0) / (sd or 1.0)
                    row[name] = float(off)
                rows.append(row | {"other decision": flips})
        note = (
            "Largest difference to the scores of torch in float64, in standard deviations of these "
            f"scores; {self.bins} bins of each kind, rounded to float32. *Other decision*: bins "
            "with another sign or validity, all backends together."
        )
        return Table(rows, note)

    def _last_digits(self, path: Path) -> Table:
        exact = loaded(path, backend="torch")
        samples = raw_bins(self.bins, self.recordings).double()
        with torch.no_grad():
            scores = exact.score_raw(samples)
        nearest = scores.abs().argsort()[: self.attacked]
        start, before = samples[nearest], scores[nearest]
        digit = torch.from_numpy(np.spacing(np.abs(start.float().numpy()))).double()
        drawn = torch.from_numpy(np.random.default_rng(0).choice((-1.0, 1.0), start.shape))
        ways = {"in any direction": drawn}
        moved = torch.zeros_like(start)
        for _ in range(self.steps):  # each sample by one digit, where the gradient says
            x = (start + moved).requires_grad_()
            (slope,) = torch.autograd.grad(exact.score_raw(x).sum(), x)
            moved = torch.sign(slope) * digit * -torch.sign(before)[:, None, None]
        ways["where the gradient says"] = moved / digit
        rows = []
        for name, signs in ways.items():
            with torch.no_grad():
                after = exact.score_raw(start + signs * digit)
            off = (after - before).abs() / scores.std()
            rows.append(
                {
                    "each sample moved by its last float32 digit": name,
                    "median change": float(off.median()),
                    "largest change": float(off.max()),
                    "other decision": int(((after >= 0) != (before >= 0)).sum()),
                }
            )
        note = (
            f"The {len(nearest)} bins whose scores are nearest to 0, of {self.bins}. Changes are "
            "in standard deviations of the scores."
        )
        return Table(rows, note)

    def _solver(self) -> Table:
        rows = []
        for kind, penalty in ((k, p) for k in _SYSTEMS for p in (1e-3, 1e3, 1e9, 1e15)):
            wrong, stated, refused = list[float](), list[float](), 0
            for z, targets in (_SYSTEMS[kind](seed) for seed in range(self.systems)):
                bins = TrainingBins(torch.from_numpy(z), torch.from_numpy(targets > 0))
                try:
                    machine = fit_machine(bins, penalty)
                except ValueError:
                    refused += 1
                    continue
                assert machine.solved is not None
                off = machine(bins.features).numpy() - _exact(z, targets, penalty)
                wrong.append(float(np.sqrt(np.mean(off**2))))
                stated.append(machine.solved.error)
            rows.append(
                {
                    "features": kind,
                    "C": f"{penalty:g}",
                    "largest error": number(max(wrong)) if wrong else "-",
                    "largest stated": number(max(stated)) if stated else "-",
                    "errors above stated": sum(
                        w > s + 1e-14 for w, s in zip(wrong, stated, strict=True)
                    ),
                    "fits refused": refused,
                }
            )
        note = (
            "Root mean square error of the scores of training bins, against a solution with 80 "
            f"digits; {self.systems} systems for each row. *Stated*: the error that the fit "
            "reports."
        )
        return Table(rows, note)


def _scores_of(
    detector: SlipDetector, dtype: torch.dtype
) -> Callable[[Tensor], tuple[Array, Array]]:
    def scores(samples: Tensor) -> tuple[Array, Array]:
        found = detector.predict_raw(samples.to(dtype))
        return found.score.double().numpy(), found.is_valid.numpy()

    return scores


def _draw(seed: int) -> Array:
    return np.random.default_rng(seed).uniform(-1, 1, (14, 4))


def _duplicates(seed: int) -> tuple[Array, Array]:
    z = _draw(seed)
    z[:, 1] = z[:, 0] * (1 + 1e-9)
    return z, np.where(z[:, 2] > 0, 1.0, -1.0)


def _plain(seed: int) -> tuple[Array, Array]:
    z = _draw(seed)
    return z, np.where(z[:, 0] * z[:, 1] > 0, 1.0, -1.0)


_SYSTEMS = {"independent columns": _plain, "columns nearly equal in pairs": _duplicates}


def _exact(z: Array, targets: Array, penalty: float) -> Array:
    """Scores of the training bins, with 80 digits."""
    with mpmath.workdps(80):
        rows = [[mpmath.mpf(float(x)) for x in row] for row in z]
        gram = mpmath.matrix([[(mpmath.fdot(u, v) + 0.5) ** 2 for v in rows] for u in rows])
        system = gram + mpmath.eye(len(rows)) / mpmath.mpf(penalty)
        beta = mpmath.lu_solve(system, mpmath.matrix([mpmath.mpf(float(t)) for t in targets]))
        return np.array([float(x) for x in gram * beta])


if __name__ == "__main__":
    raise SystemExit(Numerics().run())

"""Deadline in, detector out: trains and times real candidates, recipes x sizes x hops x precision.

Each is trained as ``tactslip train`` does it, timed in a fresh process, and compared by the
balanced accuracy of its own validation, on training recordings alone. Leaves ``pareto.json``,
``pareto.png``, the candidates in folders, and ``detector.pt``; exit status 1 if none keeps the
limits.
"""

from __future__ import annotations

import io
import itertools
import json
import sys
from collections.abc import Sequence
from contextlib import redirect_stdout, suppress
from pathlib import Path
from typing import Any

from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from tactslip_torch.commands.entry import entry_point, save_config
from tactslip_torch.commands.train import train
from tactslip_torch.data.labels import whole_samples
from tactslip_torch.data.recording import RecordingSource
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.pareto import (
    Candidate,
    choose,
    decision_cost,
    nondominated,
    pareto_figure,
    pareto_table,
    time_in_fresh_process,
)
from tactslip_torch.runtime import bar, check_number, write_json


def pareto(config: DictConfig, folder: Path) -> dict[str, Any]:
    """Train and time the candidates, choose one, and write the results.

    Args:
        config: composed from ``conf/pareto.yaml``.
        folder: where results go.

    Returns:
        The content of ``pareto.json``; ``chosen`` is ``None`` if no detector keeps the limits.

    Raises:
        ValueError: for bad input, in one line.
    """
    check_number("deadline_us", config.deadline_us)
    if config.latency_ms is not None:
        check_number("latency_ms", config.latency_ms)
    check_number("calls", config.calls, least=2, whole=True)
    for name in ("recipes", "sizes", "hops_ms", "precisions"):
        if not config[name]:
            raise ValueError(f"{name} is empty, expected at least one value")
    for hop_ms in config.hops_ms:
        check_number("hops_ms", hop_ms)
    source: RecordingSource = instantiate(config.data, _convert_="all")
    config.hops_ms = _whole_hops(config.hops_ms, source.sample_rate_hz)
    if len(instantiate(config.split, _convert_="all")(source.ids)) > 1:  # validation is enough
        config.split = {"_target_": "tactslip_torch.data.splits.everything", "_partial_": True}
        config.split.role = "train"
    save_config(config, folder)
    candidates: list[Candidate] = []
    made = list(itertools.product(config.recipes, config.sizes, config.precisions))
    for recipe, size, precision in bar(made, "candidates", "detector"):
        place = folder / "candidates" / f"{recipe}-{size or 'own'}-{precision}"
        place.mkdir(parents=True, exist_ok=True)
        candidates += _trained(config, recipe, size, precision, place)
    for name in ("pareto.json", "pareto.png", "detector.pt"):
        (folder / name).unlink(missing_ok=True)  # of an earlier run
    limits = {"deadline_us": config.deadline_us, "latency_ms": config.latency_ms}
    chosen = choose(candidates, **limits)
    points = [(c.worst_ms, c.timing.p99_us, -c.accuracy) for c in candidates]
    on_m7 = [(c.hop_ms, c.m7_instructions, -c.accuracy) for c in candidates]
    content = {
        "simulated": "simulation" in str(config.data._target_),
        **limits,
        "candidates": [each.row() for each in candidates],
        "front": nondominated(points),
        "m7_front": nondominated(on_m7),
        "chosen": chosen and chosen.row(),
    }
    write_json(folder / "pareto.json", content)
    pareto_figure(content, folder / "pareto.png")
    print(f"\n{pareto_table(content)}\n\nresults in {folder}")
    if chosen:
        detector = SlipDetector.load(Path(chosen.folder) / "detector.pt")
        if detector.calibration is not None and config.onset:
            instantiate(config.onset, hop_ms=chosen.hop_ms, _convert_="all")(detector)
        detector.save(folder / "detector.pt")
        return content
    closest = min(candidates, key=lambda each: each.timing.p99_us)
    why = " and ".join(closest.misses(**limits))
    print(f"no detector keeps the limits: the fastest has {why}", file=sys.stderr)
    return content


def _whole_hops(hops_ms: Sequence[float], rate_hz: float) -> list[float]:
    """The hops that are whole numbers of samples; says which are not.

    Raises:
        ValueError: if none is.
    """
    whole = []
    for hop in hops_ms:
        with suppress(ValueError):
            whole_samples(hop, rate_hz, "hops_ms")
            whole.append(hop)
    if left := [f"{hop:g}" for hop in hops_ms if hop not in whole]:
        what = f"hops_ms {', '.join(left)}: no whole number of samples at {rate_hz:g} Hz"
        if not whole:
            raise ValueError(f"{what}; give hops_ms=[{2000 / rate_hz:g}] or the like")
        print(f"left out: {what}")
    return whole


def _trained(
    config: DictConfig, recipe: str, size: int | None, precision: str, folder: Path
) -> list[Candidate]:
    """A detector, trained and timed, with each hop."""
    own: Any = OmegaConf.create(OmegaConf.to_container(config, resolve=True))
    own.recipe = own.recipes[recipe]
    own.features.dtype = precision
    own.export = own.baselines = False
    if size is not None:
        own.recipe.num_features = size
    with redirect_stdout(io.StringIO()):
        train(own, folder)
    metrics = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
    if metrics.get("validated") is None:
        raise ValueError(
            f"recipe {recipe} has one choice and no validation; give several penalties"
        )
    detector = SlipDetector.load(folder / "detector.pt")
    rate, bin_samples = detector.pool.sample_rate_hz, detector.pool.bin_samples
    timing = time_in_fresh_process(folder / "detector.pt", config.calls)
    return [
        Candidate(
            recipe,
            len(metrics["selected"]),
            precision,
            float(hop_ms),
            float(metrics["validated"]),
            1000 * detector.look_ahead / rate,
            1000 * bin_samples / rate,
            timing,
            decision_cost(detector, "m7"),
            str(folder),
        )
        for hop_ms in config.hops_ms
    ]


def _pareto_or_exit(config: DictConfig, folder: Path) -> None:
    if pareto(config, folder)["chosen"] is None:
        raise SystemExit(1)


main = entry_point("pareto", _pareto_or_exit)

"""What float32 does to a detector, measured against float64, with a margin for its decisions.

The float32 pipeline is ``copy.deepcopy(detector).float()``, the float64 one the detector as
fitted; both score the same bins, with digits that float32 does not hold. The margin is made of
errors on calibration bins, a rigorous bound of the head, and what features can jump by whose value
rounding decides (``JUMPING``). Held-out bins only check it, as do bins between those of either
decision, at the edge where float32 turns; generated extremes show what becomes of broken sensors.
What lies outside the inputs that the calibration bins cover was never tried.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from tactslip_torch.deploy.check import EXTREMES, extreme_bins
from tactslip_torch.features.groups import JUMPING
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.kernels import QuadraticForm
from tactslip_torch.model.rounding import error_facts, gradient_facts, head_facts, score_sd
from tactslip_torch.runtime import bar
from tactslip_torch.signals.filtering import refuse_nonfinite

_COVERED = ("low_v", "high_v", "span_v", "relative_span")


def coverage(samples: Tensor, filtered: Tensor) -> Tensor:
    """What each bin covers of the input.

    Returns the least raw sample and minus the greatest, in volts, the span of the filtered bin, and
    that over its magnitude (0 for a zero one): bins reach beyond others where one of them is less.

    Shape:
        - samples: ``[*, C, T]``, raw, volts; filtered: ``[*, C, n]``
        - output: ``[*, C, 4]``, dtype of ``filtered``
    """
    span, magnitude = filtered.amax(-1) - filtered.amin(-1), filtered.abs().amax(-1)
    relative = torch.where(magnitude == 0, 0.0, span / magnitude)
    low, high = samples.amin(-1).to(relative), samples.amax(-1).to(relative)
    return torch.stack([low, -high, span, relative], -1)


def _least_by_kind(covers: Tensor, detector: SlipDetector) -> Tensor:
    """What bins ``[N, C, 4]`` cover together, ``[C, 4]``; channels of a kind share a range."""
    kinds = [channel.kind for channel in detector.pool.hand.channels]
    least = covers.amin(0)
    for kind in set(kinds):
        alike = torch.tensor([own == kind for own in kinds])
        least[alike] = least[alike].amin(0)
    return least


def _ranges(covers: Tensor, detector: SlipDetector) -> dict[str, Any]:
    """Least and greatest samples and least spans, by kind and by channel."""
    channels = detector.pool.hand.channels

    def named(least: Tensor) -> dict[str, float]:
        return dict(zip(_COVERED, (least * torch.tensor([1, -1, 1, 1])).tolist(), strict=True))

    by_kind, by_channel = _least_by_kind(covers, detector), covers.amin(0)
    kinds = zip(channels, by_kind, strict=True)
    return {
        "kinds": {channel.kind: named(least) for channel, least in kinds},
        "channels": {c.name: named(own) for c, own in zip(channels, by_channel, strict=True)},
        "validity": "enough channels are alive",
    }


FACTOR = 4
MOST_MARGIN_SD = 1e-2  # in standard deviations of the score
REMEDY = (
    "features that jump decide: train without mode, cv and entropy, as recipe=general does "
    "(recipe.descriptors)"
)
WORST_SD = 1e-3  # largest score error allowed on recordings, in standard deviations of the score
INSIDE_SHARE = 0.01  # fewer of the held-out bins may lie inside the margin
LARGEST_RATIO = 1e4  # a bound further above the worst error seen says too little
_RULE = (
    f"{FACTOR} x the worst error on calibration bins, plus the bound of the head if it has one, "
    f"plus what its columns of {', '.join(JUMPING)} can jump by"
)
_HALVINGS = 60  # of a line between two bins, in volts of float64
_CHUNK_BINS, _GRADIENT_BINS = 16, 128


@dataclass(frozen=True, eq=False)
class Comparison:
    """Bins scored in float32 and in float64.

    Args:
        exact: ``[N]``, scores in float64 of the channels that float32 resolves, NaN: not valid.
        rounded: ``[N]``, scores in float32, likewise.
        stages: ``[N]`` each, what the score changed by the rounding in ``features`` (filter and
            descriptors), ``scaler`` and ``head``; their sum is ``rounded - exact``, 0 where
            not valid.
        scaled: ``[N, K]``, scaled features in float64.
        scaled_error: ``[N, K]``, how far those in float32 are off.
        is_valid: ``[N]``, bool, as the float32 pipeline flags it, and the same channels are lost
            in float64.
        is_enough: ``[N]``, bool, whether enough channels are alive; else neither score is valid.
        covers: ``[N, C, 4]``, what each bin covers of the input (``coverage``).
    """

    exact: Tensor
    rounded: Tensor
    stages: Mapping[str, Tensor]
    scaled: Tensor
    scaled_error: Tensor
    is_valid: Tensor
    is_enough: Tensor
    covers: Tensor

    @property
    def error(self) -> Tensor:
        """``[N]``, size of the score error; infinite where one is not valid, 0 where none is."""
        off = (self.rounded - self.exact).abs().nan_to_num(nan=math.inf, posinf=math.inf)
        return off.masked_fill(~self.is_enough, 0.0)

    @property
    def flips(self) -> Tensor:
        """``[N]``, bool: float32 decides otherwise than float64."""
        return (self.rounded >= 0) != (self.exact >= 0)


def pipelines(detector: SlipDetector) -> tuple[SlipDetector, SlipDetector]:
    """Copies of a detector in float64 and in float32."""
    return copy.deepcopy(detector).double(), copy.deepcopy(detector).float()


def compare(
    double: SlipDetector, single: SlipDetector, samples: Tensor, what: str = "bins"
) -> Comparison:
    """Score bins in float32 and in float64, stage by stage; takes ``*pipelines(detector)``.

    Shape:
        - samples: ``[N, C, n + 2 * context]``, volts, finite

    Raises:
        ValueError: if there is no bin, or a sample is not finite.
    """
    if samples.ndim != 3 or not len(samples):
        raise ValueError(f"expected {what} [N, C, n], at least one, got {tuple(samples.shape)}")
    refuse_nonfinite(samples, double.pool.hand.names, "leave the recording out, or repair it")
    chunks = bar(samples.split(_CHUNK_BINS), what, f"x{_CHUNK_BINS} bins")
    with torch.no_grad():
        parts = [_compared(double, single, chunk) for chunk in chunks]
    whole = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
    stages = {name: whole.pop(name) for name in ("features", "scaler", "head")}
    return Comparison(stages=stages, **whole)


def _compared(double: SlipDetector, single: SlipDetector, samples: Tensor) -> dict[str, Tensor]:
    rounded, is_valid, *_ = single.predict_raw(samples.float())  # as a program calls it
    # channels are lost in both that float32 does not resolve
    features, scaled, lost = _tapped(double, samples.double())
    features32, scaled32, lost32 = _tapped(single, samples.float())
    is_valid &= (lost32 == lost).all(-1)
    plain, by_scaler = double.predict_raw(samples.double()), double.head(scaled32.double())
    is_same = (plain.channels_lost == lost).all(-1)
    is_enough = (~lost).double() @ double.counted >= double.sensing.min_alive
    by_features, of_features = (
        double.head(double.imputed(double.scaler(x.double()), lost)) for x in (features32, features)
    )
    stages = {
        "features": by_features - of_features,
        "scaler": by_scaler - by_features,
        "head": rounded.double() - by_scaler,
    }
    exact = torch.where(is_same, plain.score, double.head(scaled))
    return {
        "exact": torch.where(is_enough, exact, torch.nan),
        "rounded": rounded.double(),
        **{name: torch.where(is_valid, x, 0.0) for name, x in stages.items()},
        "scaled": scaled,
        "scaled_error": (scaled32.double() - scaled).abs(),
        "is_valid": is_valid,
        "is_enough": is_enough,
        "covers": coverage(samples, double.channel_filter.valid(samples.double())),
    }


def _tapped(detector: SlipDetector, samples: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """What the scaler was given, what the head was given, and which channels were lost."""
    taken: list[Tensor] = []
    stages = (detector.scaler, detector.head)
    hooks = [m.register_forward_pre_hook(lambda _, given: taken.extend(given)) for m in stages]
    try:
        found = detector.predict_raw(samples, given=torch.float32)
    finally:
        for hook in hooks:
            hook.remove()
    return taken[0], taken[1], found.channels_lost


class Certificate(NamedTuple):
    """What ``certify`` found.

    Attributes:
        content: everything that was found, as plain values; infinite where the head overflows.
            ``holds`` says whether no condition failed.
        sets: ``calibration``, the held-out ones and the kinds of extremes, bin by bin.
    """

    content: dict[str, Any]
    sets: Mapping[str, Comparison]


def certify(
    detector: SlipDetector,
    calibration: Tensor,
    held_out: Mapping[str, Tensor] | None = None,
    *,
    simulated: bool,
    extremes: int = 100,
    boundary: int = 1000,
    seed: int = 0,
) -> Certificate:
    """Measure what float32 does to a detector, and within which margin its decisions stand.

    Args:
        detector: as fitted.
        calibration: raw training bins with their context; they set the margin and the range.
        held_out: others by name; they check the certificate and set nothing.
        simulated: whether the bins come from a simulation.
        extremes: generated bins of each kind of ``EXTREMES``.
        boundary: bins at which float32 is about to turn, made of calibration bins in pairs.
        seed: of digits, extremes, pairs, and of the search for the worst error of the head.

    Shape:
        - calibration, held_out: ``[N, C, n + 2 * context]``, volts, finite

    Raises:
        ValueError: if a set is empty or not finite, has a name that the certificate uses itself, or
            calibration scores are not finite or all the same.
    """
    given = {"calibration": calibration} | dict(held_out or {})
    if taken := sorted({"calibration", *EXTREMES} & {*(held_out or {})}):
        raise ValueError(f"a held-out set may not be named {taken[0]!r}, a name of our own; rename")
    double, single = pipelines(detector)
    generator = torch.Generator().manual_seed(seed)
    given = {name: _with_digits(bins, generator) for name, bins in given.items()}
    sets = {name: compare(double, single, bins, name) for name, bins in given.items()}
    base = sets["calibration"]
    sd = score_sd(base.exact[base.is_enough])
    size = (extremes, *calibration.shape[1:])
    kinds = {
        kind: compare(double, single, extreme_bins(kind, size, generator, torch.float32), kind)
        for kind in EXTREMES
    }
    head = head_facts(detector.head, base.scaled, seed)
    worst = float(base.error.max())
    jump, jumping = _jumps(double, base)
    margin = (head["bound"] or 0.0) + FACTOR * worst + jump
    known = _least_by_kind(base.covers, detector)
    edge = _at_boundary(single, given["calibration"], base, boundary, generator)
    turning = None if edge is None else compare(double, single, edge, "boundary")
    thinned = calibration[:: -(-len(calibration) // _GRADIENT_BINS)].double()
    content: dict[str, Any] = {
        "simulated": simulated,
        "seed": seed,
        "threads": torch.get_num_threads(),
        "dtype": {"tested": "float32", "reference": "float64", "inside": detector.pool.arithmetic},
        "score_sd": sd,
        "margin": {
            "score": margin,
            "sd": margin / sd,
            "rule": _RULE,
            "worst_calibration_error": worst,
            "jump": jump,
            "jumping_columns": jumping,
        },
        "boundary": turning and _boundary_facts(turning, detector, margin, known),
        "head": head,
        "sets": {name: _set_facts(c, detector, margin, sd, known) for name, c in sets.items()},
        "extremes": {k: _set_facts(c, detector, margin, sd, known) for k, c in kinds.items()},
        "condition_numbers": {
            "solve": detector.info.get("solve", "not recorded"),
            "score": {
                "per_scaled_feature": gradient_facts(double.head, base.scaled),
                "per_volt": gradient_facts(double.score_raw, thinned),
            },
        },
        "range": _ranges(base.covers, detector),
    }
    content["conditions"] = _conditions(content)
    content["holds"] = all(row["holds"] is not False for row in content["conditions"])
    return Certificate(content, sets | kinds)


def _with_digits(samples: Tensor, generator: torch.Generator) -> Tensor:
    """Samples in float64, with digits that float32 does not hold if they had none.

    Samples of a converter, and of any float32 file, are exact in float32, so its error would be 0.
    Up to half the least step between two samples of a channel is added, but at least a rounding.
    """
    samples = samples.double()
    if not samples.numel() or not torch.equal(samples, samples.float().double()):
        return samples
    steps = samples.movedim(-2, 0).flatten(1).sort(-1).values.diff(dim=-1)
    step = torch.where(steps > 0, steps, math.inf).amin(-1).nan_to_num(posinf=0.0)  # [C]
    step = torch.maximum(step[:, None], torch.finfo(torch.float32).eps * samples.abs())
    digits = torch.rand(samples.shape, generator=generator, dtype=torch.float64) - 0.5
    return samples + digits * step


def _jumps(double: SlipDetector, base: Comparison) -> tuple[float, list[str]]:
    """What columns that jump can add to or take from a score of a calibration bin, and which.

    Columns of ``mode`` and ``cv`` may go anywhere in their range; those of ``entropy`` by one value
    in another cell, or by the worst seen. Of a quadratic form pairs of them count as well.
    """
    lines = double.pool.maps.num_lines  # the shortest rows
    bits = (math.log2(lines) + 1 / math.log(2)) / lines
    width = (double.scaler.maximum - double.scaler.minimum).clamp(min=1e-300)
    jumping = {i: n for i, n in enumerate(double.selected_names) if n.descriptor in JUMPING}
    total, sizes = torch.zeros_like(base.exact), torch.zeros(len(width), dtype=torch.float64)
    plain = double.head(base.scaled)
    for i, name in jumping.items():
        size = 2.0
        if name.descriptor == "entropy":
            seen = float(base.scaled_error[:, i].max())
            size = min(2.0, FACTOR * max(seen, 2 * bits / float(width[i])))
        sizes[i] = size
        moves = []
        for sign in (-1, 1):
            z = base.scaled.clone()
            z[:, i] = (z[:, i] + sign * size).clamp(-1.0, 1.0)
            moves.append((double.head(z) - plain).abs())
        total += torch.maximum(*moves)
    pairs = 0.0
    if isinstance(double.head, QuadraticForm):
        bend = double.head.dense_quadratic.abs()
        pairs = float(sizes @ (bend - bend.diag().diag()) @ sizes)
    return float(total.max()) + pairs, [str(name) for name in jumping.values()]


def _at_boundary(
    single: SlipDetector,
    samples: Tensor,
    base: Comparison,
    number: int,
    generator: torch.Generator,
) -> Tensor | None:
    """Bins on lines between calibration bins of either decision, where float32 is about to turn.

    Shape:
        - samples: ``[N, C, T]``; output: ``[number, C, T]``, float64; None without both decisions
    """
    is_slip = base.rounded >= 0
    if not 0 < int(is_slip.sum()) < len(samples) or not number:
        return None

    def drawn(mask: Tensor) -> Tensor:
        rows = mask.nonzero()[:, 0]
        return samples[rows[torch.randint(len(rows), (number,), generator=generator)]]

    low, high = drawn(~is_slip), drawn(is_slip)
    for _ in range(_HALVINGS):
        middle = low + (high - low) / 2
        parts = [single.predict_raw(x.float()).score for x in middle.split(_CHUNK_BINS * 16)]
        is_high = (torch.cat(parts) >= 0)[:, None, None]
        low, high = torch.where(is_high, low, middle), torch.where(is_high, middle, high)
    return torch.where((torch.arange(number) % 2 == 0)[:, None, None], low, high)


def _boundary_facts(
    turning: Comparison, detector: SlipDetector, margin: float, known: Tensor
) -> dict[str, Any]:
    """How many bins at the edge turn outside the margin, of those that are valid and in range."""
    is_known = turning.is_valid & ~_is_outside(turning.covers, detector, known)
    turned = turning.flips & is_known
    worst = turning.exact.abs()[turned]
    return {
        "bins": len(is_known),
        "valid_in_range": int(is_known.sum()),
        "flips": int(turned.sum()),
        "outside_margin": int((worst > margin).sum()),
        "worst_margins": float(worst.max()) / margin if len(worst) else 0.0,
    }


def _is_outside(covers: Tensor, detector: SlipDetector, known: Tensor) -> Tensor:
    """Which bins reach beyond what calibration bins cover, in a channel in use, ``[N]``."""
    used = {name.channel for name in detector.extractor.names}
    is_used = torch.tensor([name in used for name in detector.pool.hand.names])
    return (covers < known)[:, is_used].flatten(1).any(1)


def _set_facts(
    compared: Comparison, detector: SlipDetector, margin: float, sd: float, known: Tensor
) -> dict[str, Any]:
    inside = compared.exact.abs() <= margin
    flips, outside = compared.flips & inside, compared.flips & ~inside
    by_feature = compared.scaled_error.amax(0)
    worst = by_feature.argmax()
    return {
        "bins": len(inside),
        "invalid": int((~compared.is_valid).sum()),
        "outside_range": int(_is_outside(compared.covers, detector, known).sum()),
        "not_finite": int((compared.is_enough & ~compared.rounded.isfinite()).sum()),
        "error": error_facts(compared.error, sd),
        "error_of_valid": error_facts(compared.error[compared.is_valid], sd),
        "stages": {name: error_facts(x.abs(), sd) for name, x in compared.stages.items()},
        "worst_feature": {
            "name": str(detector.selected_names[int(worst)]),
            "scaled_error": float(by_feature[worst]),
        },
        "inside_margin": {"bins": int(inside.sum()), "share": float(inside.double().mean())},
        "flips": {
            "inside_margin": int(flips.sum()),
            "outside_margin": int(outside.sum()),
            "outside_margin_valid": int((outside & compared.is_valid).sum()),
        },
    }


def _conditions(content: Mapping[str, Any]) -> list[dict[str, Any]]:
    """What was checked, ``holds`` being ``None`` where it is open; a held-out set may refute."""
    rows: list[dict[str, Any]] = []

    def check(name: str, found: float | None, wanted: str, holds: bool | None) -> None:
        rows.append({"name": name, "found": found, "wanted": wanted, "holds": holds})

    def at_most(name: str, found: float | None, most: float, remedy: str = "") -> None:
        check(name, found, f"<= {most:g}{remedy}", None if found is None else found <= most)

    def none(name: str, count: int) -> None:
        check(name, count, "0", count == 0)

    head, margin, edge = content["head"], content["margin"], content["boundary"]
    seen, bound = head["worst_seen"], head["bound"]
    wanted = "a bound: this head has none" if bound is None else f"<= {bound:.2e}, its bound"
    within = None
    if bound is not None:  # what it is compared with is rounded as well
        within = seen <= bound + head["reference_bound"] and not head["overflows"]
    check("error of the head, worst seen", seen, wanted, within)
    at_most("bound of the head / worst seen", head["ratio"], LARGEST_RATIO)
    at_most("margin, sd", margin["sd"], MOST_MARGIN_SD, f" ({REMEDY})" * (margin["jump"] > 0))
    if edge is not None:
        none("bins where float32 turns: flips outside the margin", edge["outside_margin"])
    for name, facts in content["sets"].items():
        at_most(f"{name}: worst error, sd", facts["error"]["worst_sd"], WORST_SD)
        none(f"{name}: flips outside the margin", facts["flips"]["outside_margin"])
        if name != "calibration":
            share = facts["inside_margin"]["share"]
            wanted = f"< {INSIDE_SHARE:g}"
            check(f"{name}: share inside the margin", share, wanted, share < INSIDE_SHARE)
    kinds = content["extremes"].values()
    flips = sum(facts["flips"]["outside_margin_valid"] for facts in kinds)
    none("valid extremes: flips outside the margin", flips)
    none("extremes: scores that are not finite", sum(facts["not_finite"] for facts in kinds))
    return rows

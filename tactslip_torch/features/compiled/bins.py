"""The kernel that walks over a chunk of bins: film by film, branch by branch."""

from __future__ import annotations

from tactslip_torch.features.compiled.jit import Array, inner, kernel
from tactslip_torch.features.compiled.rows import NOISE, Desk, extent, lines_row, scaled, time_row
from tactslip_torch.features.compiled.steps import ADD, LINES, OWN, TIME, Steps


@kernel
def describe_bins(
    x: Array,
    y: Array,
    scale: Array,
    unit: Array,
    branches: Array,
    spectra: Array,
    steps: Steps,
    desk: Desk,
    samples: Array,
    sample_facts: Array,
    lines: Array,
    line_facts: Array,
    out: Array,
    limit: float,
) -> None:
    """Everything but what needs sorted values, for which it leaves rows and facts.

    Args:
        x: bins of the plan's channels.
        y: those of films, less their first sample.
        scale: largest magnitudes.
        unit: one over the magnitudes of films.
        branches: those formed by products.
        spectra: lines formed by products, in the unit of their film.
        steps: what is to be done.
        desk: where to work.
        samples: deviations of rows of samples, written.
        sample_facts: what turns those into values, and how near two count as one, written.
        lines: spectra over their largest line, written.
        line_facts: the same of those, written.
        out: written.
        limit: largest magnitude written.

    Shape:
        - x: ``[M, C, n]``; y: ``[M, F, n]``; scale: ``[M, C]``; unit: ``[M, F]``;
          samples: ``[M, S, n]``; sample_facts: ``[M, S, 3]``;
          lines: ``[M, S', L]``; line_facts: ``[M, S', 3]``; out: ``[M, K]``
    """
    n = x.shape[2]
    is_constant, centre, energies = desk.is_constant, desk.centre, desk.energies
    for m in range(x.shape[0]):
        for g in range(steps.gauge_row.size):
            channel = steps.gauge_channel[g]
            row = x[m, channel]
            first = row[0]
            for i in range(n):
                desk.shifted[i] = row[i] - first
            for i in range(n):
                desk.raw[i] = 0
            time_row(
                desk.shifted,
                first,
                True,
                scale[m, channel],
                0.0,
                steps.gauge_row[g],
                steps,
                desk,
                samples[m],
                sample_facts[m],
                out[m],
                limit,
            )
        for f in range(steps.film_channel.size):
            channel = steps.film_channel[f]
            for b in range(is_constant.size):
                is_constant[b] = -1
            _in_time(
                m,
                f,
                x[m, channel, 0],
                scale[m, channel],
                y[m, f],
                branches,
                steps,
                desk,
                is_constant,
                centre,
                samples[m],
                sample_facts[m],
                out[m],
                limit,
            )
            _in_frequency(
                m,
                f,
                x[m, channel, 0],
                scale[m, channel],
                unit[m, f],
                y[m, f],
                spectra,
                steps,
                desk,
                is_constant,
                centre,
                energies,
                lines[m],
                line_facts[m],
                out[m],
                limit,
            )
            _shares(f, energies, steps, out[m])


@inner
def _at(m: int, kind: int, f: int, b: int, steps: Steps) -> int:
    """Where a formed row begins."""
    return int(steps.base[kind, f, b] + m * steps.stride[kind, b])


@inner
def _approximate(
    m: int, what: int, f: int, level: int, formed: Array, steps: Steps, total: Array
) -> None:
    """Bring ``total`` from the next coarser approximation of a film to the one of this level."""
    how, width = steps.chain[what, f, level], total.size
    if how == OWN:
        at = _at(m, what, f, 2 * level, steps)
        own = formed[at : at + width]
        for i in range(width):
            total[i] = own[i]
    elif how == ADD:
        at = _at(m, what, f, 2 * level + 3, steps)
        detail = formed[at : at + width]
        for i in range(width):
            total[i] += detail[i]


@inner
def _in_time(
    m: int,
    f: int,
    first: float,
    scale: float,
    y: Array,
    formed: Array,
    steps: Steps,
    desk: Desk,
    is_constant: Array,
    centre: Array,
    ordered: Array,
    facts: Array,
    out: Array,
    limit: float,
) -> None:
    """A film's branches, coarsest first; which of them are constant, and at what."""
    n = y.size
    low, high, mean = extent(y)
    span = high - low
    if span * (1 / NOISE) < scale:
        span = 0.0
    scaled(y, mean, span, desk.raw)
    square = 0.0
    for i in range(n):
        square += desk.raw[i] * desk.raw[i]
    total = desk.shifted
    for level in range(steps.chain.shape[2] - 1, -1, -1):
        _approximate(m, TIME, f, level, formed, steps, total)
        for kind in range(2):
            b = 2 * level + kind
            row = steps.row[TIME, f, b]
            if row < 0:
                continue
            at = _at(m, TIME, f, b, steps)
            branch = formed[at : at + n] if kind else total
            flat, value = time_row(
                branch,
                first,
                kind == 0,
                scale,
                square,
                row,
                steps,
                desk,
                ordered,
                facts,
                out,
                limit,
            )
            is_constant[b], centre[b] = flat, value


@inner
def _in_frequency(
    m: int,
    f: int,
    first: float,
    scale: float,
    unit: float,
    y: Array,
    formed: Array,
    steps: Steps,
    desk: Desk,
    is_constant: Array,
    centre: Array,
    energies: Array,
    ordered: Array,
    facts: Array,
    out: Array,
    limit: float,
) -> None:
    """A film's spectra, coarsest first, and their energies."""
    width = desk.sums.size
    has_shares = steps.share_start[f + 1] > steps.share_start[f]
    total = desk.sums
    low, high, _ = extent(y)
    for level in range(steps.chain.shape[2] - 1, -1, -1):
        _approximate(m, LINES, f, level, formed, steps, total)
        for kind in range(2):
            b = 2 * level + kind
            row = steps.row[LINES, f, b]
            if row < 0 and not has_shares:
                continue
            at = _at(m, LINES, f, b, steps)
            spectrum = formed[at : at + width] if kind else total
            if is_constant[b] < 0:
                is_constant[b] = False
                if not _is_alive(spectrum, steps):
                    flat = high - low <= NOISE * scale / steps.gain[b]  # 0 of 0 too: a dead film
                    value = spectrum[0] / steps.ones[0] * scale
                    if not flat:
                        flat, value = _constant(y, steps.dense[b], scale, desk.shifted)
                    is_constant[b], centre[b] = flat, value + first if kind == 0 else 0.0
            gain, offset = 1.0, first * unit if kind == 0 else 0.0
            if is_constant[b]:
                gain, offset = 0.0, centre[b] * unit
            energies[b] = lines_row(
                spectrum, gain, offset, scale, row, steps, desk, ordered, facts, out, limit
            )


@inner
def _shares(f: int, energies: Array, steps: Steps, out: Array) -> None:
    """A film's band energy ratios; 0 if there is no energy."""
    start, stop = steps.share_start[f], steps.share_start[f + 1]
    if start == stop:
        return
    total = 0.0
    for b in range(energies.size):
        total += energies[b]
    for k in range(start, stop):
        share = energies[steps.share_branch[k]]
        out[steps.share_place[k]] = share / total if total > 0 else 0.0


@inner
def _is_alive(lines: Array, steps: Steps) -> bool:
    """Whether the span of a branch is beyond doubt, by its spectrum in the unit of its film."""
    n = lines.size // 2
    level = lines[0] / steps.ones[0]
    away = 0.0
    for i in range(2 * n):
        v = lines[i] - level * steps.ones[i]
        away += v * v
    least = 4 * NOISE * steps.reach
    return bool(away > n * least * least)


@inner
def _constant(shifted: Array, dense: Array, scale: float, branch: Array) -> tuple[bool, float]:
    """Whether a branch that was not formed is constant, and its mean."""
    n = shifted.size
    for i in range(n):
        total = 0.0
        for j in range(n):
            total += dense[i, j] * shifted[j]
        branch[i] = total
    low, high, mean = extent(branch)
    return (high - low) * (1 / NOISE) < scale, mean

"""Every cell of the page's table of invariances: that it holds, and that "neither" is neither.

Of definitions by the slow oracle, on signals in whole numbers so that changes round nothing; of all
columns by the pool.
"""

from pathlib import Path

import numpy as np
import oracles
import pytest
import torch

from tactslip_torch import FeaturePool, HandLayout
from tactslip_torch.features.descriptors import SPECTRUM_DESCRIPTORS, TIME_DESCRIPTORS

PAGE = Path(__file__).parents[1] / "docs" / "numerics.md"
ANSWERS = {"same": "same", "g": 1, "g^2": 2, "+ c": "shifts"}
KEYS = ("gain", "offset", "detail_offset", "polarity", "reversal", "permutation")


def table():
    """By domain and descriptor the answers that the page's table states."""
    text = PAGE.read_text(encoding="utf-8").split("<!-- invariances -->")[1]
    rows = {}
    for line in text.splitlines()[3:33]:
        name, domain, *cells = (cell.strip() for cell in line.strip("|").split("|"))
        answers = dict(zip(KEYS, (ANSWERS.get(c, c) for c in cells), strict=False))
        answers["gain"] = 0 if answers["gain"] == "same" else answers["gain"]
        rows[{"signal": "time", "spectrum": "freq"}[domain], name.replace(" ", "_")] = answers
    return rows


ROWS = table()


def answer_of(name, change):
    """That of a feature of the pool: an offset of the bin is none of a detail's."""
    row = ROWS[name.domain, name.descriptor]
    is_detail = change == "offset" and name.component.startswith("D")
    return row["detail_offset" if is_detail else change]


RNG = np.random.default_rng(3)
SHUFFLE = RNG.permutation(24)
SIGNALS = np.concatenate([RNG.integers(-4, 9, (6, 24)), RNG.integers(-99, 300, (6, 24))]) / 4.0
CHANGES = {
    "gain": lambda x: 8 * x,
    "offset": lambda x: x + 16,
    "polarity": lambda x: -x,
    "reversal": lambda x: x[..., ::-1].copy(),
    "permutation": lambda x: x[..., SHUFFLE],
}
FORMS = {"gain": (0, 1, 2), "offset": ("same", "shifts"), "polarity": ("even", "odd")}
"""What an answer may be, beside "neither"; of the rest "same"."""


def measure(x, domain, descriptor):
    """Values of one descriptor of signals; correlation is with the one before."""
    if domain == "time":
        pairs = zip(x, np.roll(x, 1, 0), strict=True)
        return [oracles.describe_one(one, descriptor, reference=other) for one, other in pairs]
    spectra = [oracles.amplitude_spectrum(one) for one in x]
    if descriptor == "band_energy_ratio":
        return oracles.band_energy_ratio(np.stack(spectra))
    scales, hz = np.abs(x).max(-1), oracles.frequency_axis_hz(24, 2000.0)
    options = [{"scale": scale, "frequency_hz": hz} for scale in scales]
    return [
        oracles.describe_one(one, descriptor, **each)
        for one, each in zip(spectra, options, strict=True)
    ]


def by_table(before, answer):
    """What an answer says of values after the change."""
    if answer in (0, 1, 2):
        return before * 8.0**answer
    return {"shifts": before + 16, "odd": -before}.get(answer, before)


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize(("domain", "descriptor"), ROWS)
def test_a_definition_answers_as_the_table_says(domain, descriptor, change):
    """As it says, or by one signal at least otherwise than in every form of an answer."""
    before = np.array(measure(SIGNALS, domain, descriptor), np.float64)
    after = np.array(measure(CHANGES[change](SIGNALS), domain, descriptor), np.float64)
    forms = FORMS.get(change, ("same",))
    away = {form: np.abs(after - by_table(before, form)).max() for form in forms}
    size, answer = np.abs(before).max(), ROWS[domain, descriptor][change]
    if answer == "neither":
        assert min(away.values()) > 1e-3 * size
    else:
        assert away[answer] <= 1e-12 * max(np.abs(after).max(), 1)


@pytest.mark.parametrize("change", ["gain", "offset", "polarity"])
def test_every_column_of_the_pool_answers_as_the_table_says(change):
    kinds = {"SG1": "SG", "PVDF1": "PVDF"}
    hand = HandLayout.from_rows(
        {"name": n, "kind": k, "finger": "thumb", "segment": "distal"} for n, k in kinds.items()
    )
    pool, bins = FeaturePool(hand), np.random.default_rng(0).standard_normal((40, 2, 100))
    before, after = (pool(torch.from_numpy(x)).numpy() for x in (bins, CHANGES[change](bins)))
    for column, name in enumerate(pool.names):
        answer = answer_of(name, change)
        forms = FORMS[change] if answer == "neither" else (answer,)
        values, found = before[:, column], after[:, column]
        if name.descriptor == "cv":  # as mean by deviation, which has the rounding of the mean
            values, found = 1 / values, 1 / found
        size = max(np.abs(values).max(), np.abs(found).max(), 1e-3)
        away = min(np.abs(found - by_table(values, form)).max() for form in forms)
        holds = away < 1e-10 * size
        assert holds != (answer == "neither"), str(name)


def test_the_table_has_every_descriptor_once():
    of_spectra = [*SPECTRUM_DESCRIPTORS, "band_energy_ratio"]
    wanted = [("time", name) for name in TIME_DESCRIPTORS] + [("freq", n) for n in of_spectra]
    assert list(ROWS) == wanted

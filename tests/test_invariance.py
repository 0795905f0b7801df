"""Every cell of the page's table of invariances: that it holds, and that "neither" is neither."""

from pathlib import Path

import numpy as np
import pytest
import torch

from tactslip_torch import FeaturePool, HandLayout
from tactslip_torch.features.descriptors import (
    SIMPLE_STATISTICS,
    SPECTRUM_DESCRIPTORS,
    TIME_DESCRIPTORS,
)

PAGE = Path(__file__).parents[1] / "docs" / "numerics.md"
ANSWERS = {"same": "same", "g": 1, "g^2": 2, "+ c": "shifts"}
KEYS = ("gain", "offset", "detail_offset", "polarity", "reversal", "permutation")


def table():
    """By domain and descriptor the answers that the page's table states."""
    text = PAGE.read_text(encoding="utf-8").split("<!-- invariances -->")[1]
    rows = {}
    for line in text.splitlines()[3:35]:
        name, domain, *cells = (cell.strip() for cell in line.strip("|").split("|"))
        answers = dict(zip(KEYS, (ANSWERS.get(c, c) for c in cells), strict=False))
        answers["gain"] = 0 if answers["gain"] == "same" else answers["gain"]
        rows[{"signal": "time", "spectrum": "freq"}[domain], name.replace(" ", "_")] = answers
    return rows


ROWS = table()
HAND = HandLayout.from_rows(
    {"name": f"{kind}1", "kind": kind, "finger": "thumb", "segment": "distal"}
    for kind in ("SG", "PVDF")
)
SHUFFLE = np.random.default_rng(3).permutation(100)
CHANGES = {
    "gain": lambda x: 8 * x,
    "offset": lambda x: x + 16,
    "polarity": lambda x: -x,
    "reversal": lambda x: x[..., ::-1].copy(),
    "permutation": lambda x: x[..., SHUFFLE],
}
FORMS = {"gain": (0, 1, 2), "offset": ("same", "shifts"), "polarity": ("even", "odd")}
"""What an answer may be, beside "neither"; of the rest "same"."""
ORDER = ("reversal", "permutation")
"""Changes that branches of a bin do not follow: of these the bin itself answers."""


def answer_of(name, change):
    """That of a feature of the pool: an offset of the bin is none of a detail's."""
    row = ROWS[name.domain, name.descriptor]
    is_detail = change == "offset" and name.component.startswith("D")
    return row["detail_offset" if is_detail else change]


def by_table(before, answer):
    """What an answer says of values after the change."""
    if answer in (0, 1, 2):
        return before * 8.0**answer
    return {"shifts": before + 16, "odd": -before}.get(answer, before)


@pytest.mark.parametrize("change", CHANGES)
def test_every_column_of_the_pool_answers_as_the_table_says(change):
    pool, bins = FeaturePool(HAND), np.random.default_rng(0).standard_normal((40, 2, 100))
    before, after = (pool(torch.from_numpy(x)).numpy() for x in (bins, CHANGES[change](bins)))
    for column, name in enumerate(pool.names):
        if change in ORDER and name.component != "raw":
            continue
        answer = answer_of(name, change)
        forms = FORMS.get(change, ("same",)) if answer == "neither" else (answer,)
        values, found = before[:, column], after[:, column]
        if name.descriptor == "cv":  # as mean by deviation, which has the rounding of the mean
            values, found = 1 / values, 1 / found
        size = max(np.abs(values).max(), np.abs(found).max(), 1e-3)
        away = min(np.abs(found - by_table(values, form)).max() for form in forms)
        holds = away < 1e-10 * size
        assert holds != (answer == "neither"), str(name)


def test_the_table_has_every_descriptor_once():
    of_spectra = [*SPECTRUM_DESCRIPTORS, "band_energy_ratio"]
    of_signals = dict.fromkeys((*TIME_DESCRIPTORS, *SIMPLE_STATISTICS))
    wanted = [("time", name) for name in of_signals] + [("freq", name) for name in of_spectra]
    assert list(ROWS) == wanted

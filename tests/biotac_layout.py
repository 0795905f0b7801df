"""A folder laid out as the BioTac SP set is, of a few made-up counts."""

from pathlib import Path

import numpy as np


def write_biotac(root: Path) -> list[str]:
    """Two objects, slip and touch of each; what an experiment must be told of it."""
    for seed, name in enumerate(("n/pen1", "t/pen2", "cw/strippes3", "t/striped4")):
        path = root / "csvs" / f"{name}.csv"
        path.parent.mkdir(parents=True, exist_ok=True)
        header = ",".join(f"ff_e{number}" for number in range(1, 25))
        size = 5 if name.startswith("t/") else 50
        counts = np.random.default_rng(seed).normal(2800, size, (280, 24)).astype(int)
        np.savetxt(path, counts, fmt="%d", delimiter=",", header=header, comments="")
    return [f"data.root={root}"]

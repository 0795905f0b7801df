"""The seed of everything that tests generate; the head of a run says which it has."""

from __future__ import annotations

import os

SEED = int(os.environ.get("TACTSLIP_SEED", "1"))

"""What is timed and compared, one file a subject; run from a checkout, not installed."""

from pathlib import Path

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"

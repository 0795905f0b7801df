"""What is timed and compared, one file a subject; run from a checkout, not installed."""

from benchmarks.sources import RESULTS as RESULTS
from benchmarks.sources import ROOT as ROOT

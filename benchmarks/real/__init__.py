"""The benchmark on real recordings: ours and baselines, each object left out in turn."""

"""The benchmark on real recordings: ours and rivals, each object left out in turn."""

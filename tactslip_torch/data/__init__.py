"""Where recordings come from: what one is, its labels, and how a set of them is split."""

"""From a deadline to a detector: what a decision takes here, and which detectors are worth it."""

"""From scores to alarms: sequential rules, thresholds, streams, and the evaluation of events."""

"""From scores to alarms: sequential rules, their threshold, streams, and how events are judged."""

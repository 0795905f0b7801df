"""Answers that may be unsure: what they were asked to cover, and what they cover."""

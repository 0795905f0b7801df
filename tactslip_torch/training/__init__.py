"""Stages of training: the alarm of a detector, settings by gradient."""

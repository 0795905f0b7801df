"""Stages of training, from recordings to a detector with its alarm."""

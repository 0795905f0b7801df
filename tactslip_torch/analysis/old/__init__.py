"""Machinery of pareto, importance and crossval until they use ``training.recipe``."""

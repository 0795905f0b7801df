"""Slip detection for robot hands that feel, in PyTorch (He et al. 2026, and beyond)."""

__version__ = "0.1.0"

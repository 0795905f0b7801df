"""Slip detection for robot hands that feel, in PyTorch (He et al. 2026, and beyond)."""

from tactslip_torch.features.pool import FeatureName, FeaturePool
from tactslip_torch.hand import Channel, HandLayout

__version__ = "0.1.0"

__all__ = ["Channel", "FeatureName", "FeaturePool", "HandLayout"]

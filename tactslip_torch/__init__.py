"""Slip detection for robot hands that feel, in PyTorch (He et al. 2026, and beyond)."""

from tactslip_torch.data.recording import Recording
from tactslip_torch.features.names import FeatureName
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.hand import Channel, HandLayout
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.missing_channels import Prediction
from tactslip_torch.model.moments import SufficientStats
from tactslip_torch.onset.decisions import AlarmSettings
from tactslip_torch.onset.streaming import StreamingDetector
from tactslip_torch.runtime import __version__ as __version__
from tactslip_torch.simulation import Scene, simulate

__all__ = [
    "AlarmSettings",
    "Channel",
    "FeatureName",
    "FeaturePool",
    "HandLayout",
    "Prediction",
    "Recording",
    "Scene",
    "SlipDetector",
    "StreamingDetector",
    "SufficientStats",
    "simulate",
]

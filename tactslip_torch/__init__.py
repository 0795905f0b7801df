"""Slip detection for robot hands that feel, in PyTorch (He et al. 2026, and beyond)."""

from tactslip_torch.data.recording import Recording
from tactslip_torch.features.extractor import FeatureExtractor
from tactslip_torch.features.names import FeatureName
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.hand import Channel, HandLayout
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.moments import SufficientStats
from tactslip_torch.model.prediction import Prediction
from tactslip_torch.onset.settings import AlarmSettings
from tactslip_torch.onset.streaming import StreamingDetector
from tactslip_torch.simulation import Scene, simulate

__version__ = "0.1.0"

__all__ = [
    "AlarmSettings",
    "Channel",
    "FeatureExtractor",
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

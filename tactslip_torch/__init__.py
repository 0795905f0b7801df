"""Slip detection from tactile sensors, in PyTorch (He et al. 2026, and beyond)."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

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

if TYPE_CHECKING:
    from tactslip_torch.simulation.scene import Scene
    from tactslip_torch.simulation.simulate import simulate

_LATER = {"Scene": "simulation", "simulate": "simulation"}
"""Names that are imported when first asked for, so that the import takes little more than torch."""

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


def __getattr__(name: str) -> Any:
    if name not in _LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_LATER[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})

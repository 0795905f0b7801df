"""Slip detection from tactile sensors, in PyTorch (He et al. 2026, and beyond)."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tactslip_torch.data.recording import Recording as Recording
    from tactslip_torch.estimators import SlipClassifier as SlipClassifier
    from tactslip_torch.estimators import TactileFeatures as TactileFeatures
    from tactslip_torch.features.descriptors import FeatureName as FeatureName
    from tactslip_torch.features.pool import FeaturePool as FeaturePool
    from tactslip_torch.hand import Channel as Channel
    from tactslip_torch.hand import HandLayout as HandLayout
    from tactslip_torch.model.detector import SlipDetector as SlipDetector
    from tactslip_torch.model.moments import SufficientStats as SufficientStats
    from tactslip_torch.model.prediction import Prediction as Prediction
    from tactslip_torch.onset.decisions import AlarmSettings as AlarmSettings
    from tactslip_torch.onset.streaming import StreamingDetector as StreamingDetector
    from tactslip_torch.pretrained import sample_recording as sample_recording
    from tactslip_torch.runtime import __version__ as __version__
    from tactslip_torch.simulation.scene import Scene as Scene
    from tactslip_torch.simulation.simulate import simulate as simulate

_MODULES = {
    "AlarmSettings": "onset.decisions",
    "Channel": "hand",
    "FeatureName": "features.descriptors",
    "FeaturePool": "features.pool",
    "HandLayout": "hand",
    "Prediction": "model.prediction",
    "Recording": "data.recording",
    "Scene": "simulation",
    "SlipClassifier": "estimators",
    "SlipDetector": "model.detector",
    "StreamingDetector": "onset.streaming",
    "SufficientStats": "model.moments",
    "TactileFeatures": "estimators",
    "__version__": "runtime",
    "sample_recording": "pretrained",
    "simulate": "simulation",
}
"""Where each name is imported from when it is first asked for: ``--help`` needs no torch."""

__all__ = sorted(_MODULES.keys() - {"__version__"})


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})

"""What comes with the package: a small detector, and a recording to try it on. Both are simulated.

``python -m tactslip_torch.pretrained.make`` makes them anew.
"""

from tactslip_torch.data.formats import named_format
from tactslip_torch.data.recording import Recording
from tactslip_torch.runtime import PACKAGE

NAME = "paper24-sim"
RECORDING = PACKAGE / "pretrained" / f"{NAME}.npz"


def sample_recording() -> Recording:
    """A simulated recording of the paper's hand with one slip, on a material held out in training.

    Example:
        >>> sample_recording()
        Recording(24 channels, 2.68 s at 2000 Hz, in V, material wood, 1 slip, simulated)
    """
    return named_format("npz").load(RECORDING).recording

"""What stands at the top of the package: what importing it loads."""

from __future__ import annotations

import subprocess
import sys

import pytest

import tactslip_torch

HEAVY = "lightning hydra omegaconf matplotlib onnx onnxruntime sklearn scipy tensorboard pandas"


def test_importing_the_package_loads_little() -> None:
    code = (
        "import sys, tactslip_torch as t; assert 'torch' not in sys.modules; "
        "t.FeaturePool, t.SlipDetector, t.StreamingDetector, t.SufficientStats; "
        f"print(*set('{HEAVY}'.split()) & set(sys.modules))"
    )
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (loaded.returncode, loaded.stdout, loaded.stderr) == (0, "\n", "")


@pytest.mark.parametrize("name", tactslip_torch.__all__)
def test_every_public_name_is_there(name: str) -> None:
    assert getattr(tactslip_torch, name).__doc__
    assert name in dir(tactslip_torch)

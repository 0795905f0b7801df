"""``python -m tactslip_torch.train``: the command ``tactslip train``."""

import sys

from tactslip_torch.__main__ import run

if __name__ == "__main__":
    run("train", sys.argv[1:])

"""``python -m tactslip_torch.train``: the command ``tactslip train``."""

import sys

from tactslip_torch.__main__ import main

if __name__ == "__main__":
    sys.argv.insert(1, "train")
    main()

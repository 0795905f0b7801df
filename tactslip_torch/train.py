"""``python -m tactslip_torch.train``: the command ``tactslip train``."""

from tactslip_torch.commands.entry import run_entry_point
from tactslip_torch.commands.train import main

if __name__ == "__main__":
    run_entry_point(main)

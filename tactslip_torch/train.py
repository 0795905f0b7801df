"""``python -m tactslip_torch.train``: the command ``tactslip train``."""

from tactslip_torch.commands.train import main

if __name__ == "__main__":
    main()

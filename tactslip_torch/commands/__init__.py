"""One module for each command; they alone know Hydra."""

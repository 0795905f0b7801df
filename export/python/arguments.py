"""Arguments of the command line, refused in one line."""

import argparse
import math

LARGEST_CHUNK = 2000


class Parser(argparse.ArgumentParser):
    """Says what is wrong in one line and exits with status 2."""

    def __init__(self):
        super().__init__(allow_abbrev=False)

    def error(self, message):
        """Instead of usage and error on lines of their own."""
        usage = " ".join(self.format_usage().split())
        self.exit(2, f"error: {message}; {usage}\n")


def number(text):
    """A finite number."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"expected a number, got {text}")
    return value


def chunk(text):
    """How many samples are pushed at a time."""
    if not (text.isdecimal() and 1 <= int(text) <= LARGEST_CHUNK):
        raise argparse.ArgumentTypeError(f"expected 1 to {LARGEST_CHUNK} samples, got {text}")
    return int(text)

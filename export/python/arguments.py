"""Arguments of the command line, refused in one line."""

import argparse
import math
import re
import sys

LARGEST_CHUNK = 2000
VALUED = ("--rate", "--chunk", "--threshold")
NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")


class Parser(argparse.ArgumentParser):
    """Says what is wrong in one line and exits with status 2."""

    def __init__(self):
        super().__init__(allow_abbrev=False)

    def parse_args(self):
        """Of the command line; argparse by itself takes a value of -1e-3 for an option."""
        words, given = [], iter(sys.argv[1:])
        for word in given:
            value = next(given, None) if word in VALUED else None
            words.append(word if value is None else f"{word}={value}")
        return super().parse_args(words)

    def error(self, message):
        """Instead of usage and error on lines of their own."""
        usage = " ".join(self.format_usage().split())
        self.exit(2, f"error: {message}; {usage}\n")


def number(text):
    """A finite decimal number; ``float`` alone takes spaces and 2_000 as well."""
    if not NUMBER.fullmatch(text) or not math.isfinite(float(text)):
        raise argparse.ArgumentTypeError(f"expected a finite decimal number, got {text}")
    return float(text)


def chunk(text):
    """How many samples are pushed at a time."""
    if not re.fullmatch(r"0*[0-9]{1,4}", text) or not 1 <= int(text) <= LARGEST_CHUNK:
        raise argparse.ArgumentTypeError(f"expected 1 to {LARGEST_CHUNK} samples, got {text}")
    return int(text)

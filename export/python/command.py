"""How a command ends: what is wrong is one line on stderr and status 1."""

import contextlib
import json
import math
import os
import sys

NONE = -0.99e30  # a statistic of too few decisions is below


def run(main, *arguments):
    """Call ``main``, and see to it that what it said was written."""
    try:
        main(*arguments)
        say(end="", flush=True)
    except BrokenPipeError:  # whoever reads has seen enough
        leave(0)
    except Exception as error:  # onnxruntime's errors share no other base
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        leave(1)


def json_line(row):
    """A dict as one line of JSON; null for NaN, and for a statistic of too few decisions."""
    plain = {
        key: None if isinstance(value, float) and not NONE < value < math.inf else value
        for key, value in row.items()
    }
    return json.dumps(plain, allow_nan=False)


def say(*line, end="\n", flush=False):
    """Print a line; an ``OSError`` says that nothing can be written there."""
    try:
        print(*line, end=end, flush=flush)
    except BrokenPipeError:
        raise
    except OSError as error:
        reason = f"the output cannot be written ({error.strerror}); is the disk full?"
        raise OSError(reason) from None


def leave(status):
    """End here: Python's own end would write what is left again, and fail in lines of its own."""
    with contextlib.suppress(OSError):
        sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)

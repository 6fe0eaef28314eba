"""A task for worker processes, which import this module alone."""

import os
import signal
import time
from pathlib import Path


def end_or_return(index: int) -> int:
    """Return the square; the third task ends its process."""
    if index == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return index * index


def wait_and_return(seconds: float) -> float:
    """Return the seconds, after so many of them."""
    time.sleep(seconds)
    return seconds


def fail_at_first(folder: str, times: int) -> int:
    """Fail so many times in a way that may pass; return how often it was tried."""
    tries = len(list(Path(folder).glob("*.try")))
    (Path(folder) / f"{tries}.try").touch()
    if tries < times:
        raise ConnectionError("busy")
    return tries + 1

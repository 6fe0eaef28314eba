"""A task for worker processes, which import this module alone."""

import os
import signal
import time


def end_or_return(index: int) -> int:
    """Return the square; the third task ends its process."""
    if index == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return index * index


def wait_and_return(seconds: float) -> float:
    """Return the seconds, after so many of them."""
    time.sleep(seconds)
    return seconds

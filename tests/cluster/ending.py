"""A task for worker processes, which import this module alone."""

import os
import signal


def end_or_return(index: int) -> int:
    """Return the square; the third task ends its process."""
    if index == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return index * index

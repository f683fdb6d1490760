"""What the zoo's commands say beside rl_zoo3's own output."""

import sys


def say(line: str) -> None:
    """Write a line at once, so that it is the last one where it is written last."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()

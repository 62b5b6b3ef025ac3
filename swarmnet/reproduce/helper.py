"""A job beside `swarmnet reproduce`: the same command, which ends with the one that started it, however that ends."""

import os
import signal
import sys
import threading

from swarmnet.cli import main


def end_with_parent() -> None:
    """Ends this process when its standard input closes: the other end is held by the process that started it."""

    def wait() -> None:
        while os.read(0, 1):  # not sys.stdin, whose lock would be held when this process ends first
            pass
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=wait, daemon=True).start()


if __name__ == "__main__":
    end_with_parent()
    sys.exit(main())

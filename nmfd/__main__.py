"""The command `nmfd`, also `python -m nmfd`; cosim.__main__ takes `start` from here."""

import os
import signal
from importlib import import_module
from typing import NoReturn


def start(program: str) -> None:
    """Run a command line, whose imports end in a line after Ctrl-C, too."""

    def end(*_: object) -> NoReturn:
        os.write(2, f"{program}: interrupted\n".encode())
        os._exit(130)

    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # else Ctrl-C is for others
        signal.signal(signal.SIGINT, end)
    try:
        import_module(f"{program}.cli").main()
    except SystemExit as ended:
        if ended.code == 130:  # after Ctrl-C in a text that it executed, Python would return -2
            os._exit(130)
        raise


def main() -> None:
    """Run the command `nmfd`."""
    start("nmfd")


if __name__ == "__main__":
    main()

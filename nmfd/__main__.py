"""The command `nmfd`, also `python -m nmfd`."""

import os
import signal
from importlib import import_module


def main(program: str = "nmfd") -> None:
    """Run a command line, whose imports end in a line after Ctrl-C, too."""

    def end(*_: object) -> None:
        os.write(2, f"{program}: interrupted\n".encode())
        os._exit(130)

    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # else Ctrl-C is for others
        signal.signal(signal.SIGINT, end)
    try:
        import_module(f"{program}.cli").main()
    except SystemExit as ended:
        if ended.code == 130:  # Python itself may return -2
            os._exit(130)
        raise


if __name__ == "__main__":
    main()

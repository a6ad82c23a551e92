"""The command `cosim`, also `python -m cosim`."""

from nmfd.__main__ import start


def main() -> None:
    """Run the command `cosim`."""
    start("cosim")


if __name__ == "__main__":
    main()

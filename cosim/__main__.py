"""The command `cosim`, also `python -m cosim`."""

from functools import partial

from nmfd.__main__ import main as run

main = partial(run, "cosim")

if __name__ == "__main__":
    main()

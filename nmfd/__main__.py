"""`python -m nmfd` is the command `nmfd`."""

from nmfd.cli import main

if __name__ == "__main__":
    main()

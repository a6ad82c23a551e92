"""Tables as text, for the terminal."""

from collections.abc import Collection, Sequence


def aligned(lines: Sequence[Sequence[str]], left: Collection[int] = (0,)) -> list[str]:
    """The cells of every line in columns of equal width, those in `left` to the left and the others to the right."""
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return [
        "  ".join(cell.ljust(width) if n in left else cell.rjust(width)
                  for n, (cell, width) in enumerate(zip(line, widths, strict=True))).rstrip()
        for line in lines]

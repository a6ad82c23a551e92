"""Scenarios and networks of the package.

They are found by name from any folder and never written to.

In a checkout they are its folders scenarios and networks, in an installed package those in
nmfd/data; the same relative paths lead from one to another in both.
"""

import itertools
import os
from importlib import resources
from pathlib import Path

from nmfd.errors import InputError, did_you_mean

# Kinds of folders: they lie in folders of that name + "s", with NAME.toml in each.
SCENARIO = "scenario"
NETWORK = "network"
_HERE = Path(str(resources.files("nmfd")))
_DATA = _HERE / "data"  # as pyproject.toml maps it


def root() -> Path:
    """Return the folder with the folders scenarios and networks."""
    return _DATA if _DATA.is_dir() else _HERE.parent


def folders(kind: str) -> list[Path]:
    """Return the folders of a kind, by name."""
    return sorted(file.parent for file in (root() / f"{kind}s").glob(f"[!.]*/{kind}.toml"))


def found(name: Path | str, *kinds: str, beside: Path | None = None) -> Path:
    """Return the folder of one of these kinds, or the file, `name`.

    name: a path, from `beside` if given; or the name of a folder, with or without networks/ or
        scenarios/ before it, of the package or of this folder or one above; or a path below it
        (grid7_peak/dpc-pc.pt). A path to nothing is returned unchanged
    Raises: InputError for a single word that names nothing
    """
    word = Path(name)
    path = word if beside is None else beside / word
    if os.path.isfile(path) or any(os.path.exists(path / f"{kind}.toml") for kind in kinds):
        return path
    if word.is_absolute() or ".." in word.parts:
        return path
    places = [root()]
    if beside is None:
        here = Path.cwd()
        places += [here, *here.parents]
    for place, kind in itertools.product(places, kinds):
        short = word
        if word.parts[:1] == (f"{kind}s",):
            short = word.relative_to(f"{kind}s")
        folder = place / f"{kind}s" / short
        mark = folder / f"{kind}.toml" if len(short.parts) == 1 else folder
        if short.parts and os.path.exists(mark):
            return folder
    single_word = len(word.parts) == 1 and not word.suffix
    if beside is not None or not kinds or not single_word or os.path.exists(path):
        return path
    near = []
    for kind in kinds:
        for place in (root() / f"{kind}s", Path()):
            near += [file.parent.name for file in place.glob(f"*/{kind}.toml")]
    raise InputError(
        f"{name}: no such folder here, and no {' or '.join(kinds)} of that name comes with the "
        f"package{did_you_mean(str(name), near)}; `nmfd show` lists them"
    )


def installed(path: Path) -> bool:
    """Return True if `path` lies in an installed package.

    The user may not write there.
    """
    return path.resolve().is_relative_to(_DATA.resolve())


def beside(folder: Path, file: str, option: str, *, scenario: bool = False) -> Path:
    """Return the path of `file` in `folder`.

    option: names another place
    scenario: True if the user's own scenario may be based on `folder` instead
    Raises: InputError if the folder cannot be written to, or is of the installed package
    """
    remedy = f"give {option}"
    if scenario:
        content = f'name = "..." and base = "{folder.name}"'
        remedy += f", or make a folder of your own whose scenario.toml has {content}"
    if installed(folder):
        raise InputError(
            f"{folder.name}: came with the package, where nothing is written; {remedy}"
        )
    if folder.is_dir() and not os.access(folder, os.W_OK):
        raise InputError(f"{folder}: cannot be written to; {remedy}")
    return folder / file

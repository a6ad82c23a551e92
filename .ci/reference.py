"""Reference of the Python interface as HTML.

    python .ci/reference.py [FOLDER]      default: runs/reference

It has the public names of nmfd and cosim, the environments of nmfd.rl, and a controller as it is
written. What pdoc warns of is an error. It needs the extras test and rl.
"""

import importlib
import re
import sys
import warnings
from pathlib import Path

import jinja2
import pdoc
from pdoc.render import env

MODULES = ("nmfd", "nmfd.rl", "nmfd.controllers.template", "cosim")


def build(folder: Path) -> None:
    """Write the pages to `folder`; its index.html is where to begin."""
    for name in MODULES:
        module = importlib.import_module(name)
        # pdoc sees only names that are there, and many are imported when they are first used.
        for public in getattr(module, "__all__", ()):
            vars(module)[public] = getattr(module, public)
    env.filters["to_markdown"] = _with_lists(env.filters["to_markdown"])
    with warnings.catch_warnings(action="error", category=UserWarning):
        pdoc.pdoc(*MODULES, output_directory=folder)


def _with_lists(to_markdown):
    """Return the filter, with lines such as "seed: of the noise" as a list."""

    @jinja2.pass_context
    def filtered(context: jinja2.runtime.Context, text: str) -> str:
        listed = re.sub(r"^(\w+(?:, \w+)*): ", r"* **\1**: ", text, flags=re.MULTILINE)
        return to_markdown(context, listed)

    return filtered


if __name__ == "__main__":
    out = Path(sys.argv[1] if len(sys.argv) > 1 else "runs/reference")
    build(out)
    print(f"Written to {out / 'index.html'}")

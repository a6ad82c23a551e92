"""Parts of a self-contained HTML page: everything that is text is escaped, every picture is in the page."""

import base64
import math
import re
import struct
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path

PIXELS = 150.0  # per inch, of the pictures (nmfd.studies.plots.save)
STYLE = """
:root { color-scheme: light; --ink: #1d2733; --soft: #5b6876; --line: #d9dfe6; --tint: #f4f6f9; --accent: #0059a8; }
* { box-sizing: border-box; }
body { margin: 0; background: #fff; color: var(--ink); font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto,
  "Helvetica Neue", Arial, sans-serif; overflow-wrap: break-word; }
main, header, footer { max-width: 1180px; margin: 0 auto; padding: 0 20px; }
header { padding-top: 28px; } footer { padding-bottom: 40px; color: var(--soft); font-size: .875rem; }
h1 { font-size: 1.7rem; line-height: 1.25; margin: 0 0 .3em; } h2 { font-size: 1.35rem; margin: 2.2em 0 .4em;
  padding-top: .6em; border-top: 2px solid var(--accent); } h3 { font-size: 1.12rem; margin: 1.8em 0 .4em; }
h4 { font-size: 1rem; margin: 1.6em 0 .3em; color: var(--soft); }
p, ul { max-width: 78ch; margin: .5em 0; } ul { padding-left: 1.2em; } li { margin: .25em 0; }
.story { background: var(--tint); border-left: 4px solid var(--accent); padding: .7em 1.1em; border-radius: 4px;
  margin: 1em 0; }
.note { color: var(--soft); font-size: .875rem; }
a { color: var(--accent); }
nav ul { list-style: none; padding: 0; display: flex; flex-wrap: wrap; gap: .2em 1.2em; max-width: none; }
.scroll { overflow-x: auto; max-width: 100%; margin: .8em 0 .4em; border: 1px solid var(--line); border-radius: 6px; }
.scroll:focus-visible { outline: 2px solid var(--accent); }
table { border-collapse: collapse; font-size: .875rem; font-variant-numeric: tabular-nums; min-width: 100%; }
th, td { padding: .38em .75em; text-align: right; white-space: nowrap; border-bottom: 1px solid var(--line); }
thead th { background: var(--tint); font-weight: 600; }
tbody tr:last-child > * { border-bottom: 0; }
tbody th, thead th:first-child { text-align: left; position: sticky; left: 0; background: #fff; font-weight: 600; }
thead th:first-child { background: var(--tint); }
table.words th { text-align: left; }
table.words td { text-align: left; white-space: normal; overflow-wrap: anywhere; min-width: 12em; }
table.words tbody th { white-space: normal; vertical-align: top; }
figure { margin: .4em 0 1.6em; } figure img { display: block; height: auto; margin: 0 auto; }
figcaption, .caption { color: var(--soft); font-size: .875rem; margin-top: .4em; max-width: 95ch; }
details { margin: .9em 0; } summary { cursor: pointer; color: var(--accent); }
@media (max-width: 600px) {
  body { font-size: 15px; } main, header, footer { padding-left: 14px; padding-right: 14px; } }
@media print { .scroll { overflow: visible; } }
"""


def tag(name: str, *children: str, **attributes: str | int) -> str:
    """An element; `children` are markup. `class_` is the attribute class."""
    head = "".join(f' {key.rstrip("_")}="{escape(str(value))}"' for key, value in attributes.items())
    return f"<{name}{head}>{''.join(children)}</{name}>"


def text(name: str, content: object, **attributes: str | int) -> str:
    """An element with plain text."""
    return tag(name, escape(str(content)), **attributes)


def items(sentences: Iterable[str]) -> str:
    return tag("ul", *(text("li", typeset(sentence)) for sentence in sentences))


def typeset(sentence: str) -> str:
    """With true minus signs, and units that stay on the line of their number."""
    return re.sub(r"(?<![\w.])-(?=\d)", "\N{MINUS SIGN}", sentence).replace(" %", "\N{NO-BREAK SPACE}%")


def fold(summary: str, *children: str) -> str:
    """What is seen after a click."""
    return tag("details", text("summary", summary), *children)


def scroller(label: str, *children: str) -> str:
    """A box of its own for what may be wider than the page."""
    return tag("div", *children, class_="scroll", tabindex=0, role="region", aria_label=label).replace(
        "aria_label", "aria-label", 1)


def table(label: str, columns: Sequence[str], rows: Iterable[Sequence[object]], *, words: bool = False) -> str:
    """The first column names the row. words: of text that wraps, not of numbers."""
    head = tag("thead", tag("tr", *(text("th", column, scope="col") for column in columns)))
    body = tag("tbody", *(
        tag("tr", text("th", cell(row[0]), scope="row"), *(text("td", cell(value)) for value in row[1:]))
        for row in rows))
    inner = tag("table", head, body, **({"class_": "words"} if words else {}))
    return scroller(label, inner)


def cell(value: object) -> str:
    """A value as text: seven digits, a dash where there is none."""
    if isinstance(value, float):
        return "–" if math.isnan(value) else f"{value:.7g}"
    return "–" if value is None or value == "" or "nan" in str(value).split() else str(value)


def picture(path: Path, caption: str) -> str:
    """A png file inside the page, in a box that scrolls where the screen is narrower than it can be read."""
    content = path.read_bytes()
    width = 96.0 * struct.unpack(">I", content[16:20])[0] / PIXELS  # at the size it was drawn for
    image = (f'<img src="data:image/png;base64,{base64.b64encode(content).decode()}" alt="{escape(caption)}" '
             f'style="width:100%;min-width:{0.68 * width:.0f}px;max-width:{width:.0f}px">')
    return tag("figure", scroller(caption, image), text("figcaption", caption))


def page(title: str, header: str, main: str, footer: str) -> str:
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        # no icon is asked for, and nothing outside the page can be
        '<link rel="icon" href="data:,">'
        "<meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; img-src data:; "
        "style-src 'unsafe-inline'\">"
        f"{text('title', title)}<style>{STYLE}</style></head>\n"
        f"<body>{tag('header', header)}\n{tag('main', main)}\n{tag('footer', footer)}</body></html>\n")

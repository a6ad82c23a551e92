"""The page: the maps, the curves and the numbers of some runs, and their place; no server, and nothing that is done."""

from collections.abc import Sequence
from html import escape
from pathlib import Path

from bokeh.document import Document
from bokeh.models import Div, Model
from jinja2 import Environment, PackageLoader

from cosim.view import colours
from cosim.view.city_map import DENSITY, CityMap
from cosim.view.curves import HOUR, MINUTE, Curves, Load
from cosim.view.picture import CityPicture, Frame

HERE = Path(__file__).parent
WIDE = ".bk-clearfix { display: block !important; }"  # of a Div, which else is no wider than its words
TEMPLATES = Environment(loader=PackageLoader("cosim.view", "."), autoescape=True, trim_blocks=True, lstrip_blocks=True)


class Page:
    """The runs `names` side by side."""

    def __init__(self, picture: CityPicture, names: Sequence[str]):
        """A region in the middle to begin with: that with the most boundaries."""
        self.picture, self.names = picture, names
        self.maps = [CityMap(picture, name) for name in names]
        self.loads = [Load(picture, f"{name}: how full the regions are") for name in names]
        self.curves = Curves(picture, names)
        self.numbers = Div(text="", sizing_mode="stretch_width", stylesheets=[WIDE])
        ends = [region for gate in picture.gates for region in (gate.source, gate.target)]
        self.street: int | None = None
        self.region = max(range(picture.regions), key=ends.count)
        self.gate = self.gate_of(self.region)
        self.choose(self.region, self.gate)

    def gate_of(self, region: int) -> tuple[int, int] | None:
        """The first gate into a region, or out of it; None where there is none with a signal."""
        gates = self.picture.boundaries
        return next(
            (gate for gate in gates if gate[1] == region), next((gate for gate in gates if gate[0] == region), None)
        )

    def choose(self, region: int, gate: tuple[int, int] | None) -> None:
        """The region and the gate whose curves are shown, from the next `curves` on."""
        self.region, self.gate = region, gate
        for one in self.maps:
            one.choose(region)
        self.curves.choose(region, gate)

    def choose_street(self, street: int) -> None:
        """The street whose curves are shown, from the next `curves` on."""
        self.street = street
        for one in self.maps:
            one.choose_street(street)
        self.curves.choose_street(street)

    def show(
        self,
        frames: Sequence[Frame | None],
        time: float,
        by: str = DENSITY,
        held: Sequence[frozenset[tuple[int, int]]] = (),
    ) -> None:
        """The runs at `time` [s]: a frame of each, None where there is none yet; by: the colour of streets; held: of
        each, the gates that were switched by hand."""
        for n, (one, frame) in enumerate(zip(self.maps, frames, strict=True)):
            if frame is not None:
                one.show(frame, by, held[n] if held else frozenset())
        for load in self.loads:
            load.now.location = time / MINUTE
        self.curves.mark(time)
        self.numbers.text = numbers(self.names, frames, time)

    def trace(self, runs: Sequence[Sequence[Frame]], time: float) -> None:
        """The curves: the frames at the ends of control intervals of every run, and the time [s] that is looked at."""
        for load, whole in zip(self.loads, runs, strict=True):
            load.show(whole)
        self.curves.show(runs, time)

    def layout(
        self, bar: Sequence[Model], choices: Sequence[Model], *, streets: bool = False
    ) -> tuple[dict[str, Model], dict[str, list[str]]]:
        """What stands on the page: models by name, and which of them is where (`body.html.j2`). bar, choices: what one
        can press, with names; streets: whether one can be chosen."""
        curves, street = self.curves, {"street_curve": self.curves.street} if streets else {}
        roots = {
            "numbers": self.numbers,
            **{f"map{n}": one.plot for n, one in enumerate(self.maps)},
            **{f"load{n}": one.plot for n, one in enumerate(self.loads)},
            "region_curve": curves.region,
            "plane": curves.plane,
            "gate_curve": curves.gate,
            "trips": curves.trips,
            "spent": curves.spent,
            **street,
            **{str(model.name): model for model in (*bar, *choices)},
        }
        for name, model in roots.items():
            model.name = name
        return roots, {
            "bar": [str(model.name) for model in bar],
            "choices": [str(model.name) for model in choices],
            "maps": [name for name in roots if name.startswith("map")],
            "loads": [name for name in roots if name.startswith("load")],
            "curves": ["region_curve", "plane", "gate_curve", *street, "trips", "spent"],
        }

    def place(
        self,
        document: Document,
        subtitle: str,
        bar: Sequence[Model],
        choices: Sequence[Model],
        *,
        streets: bool = False,
    ) -> None:
        """Put it into a document; arguments as in `layout`."""
        roots, places = self.layout(bar, choices, streets=streets)
        with document.models.freeze():  # else all models are looked through anew with every root
            for model in roots.values():
                document.add_root(model)
        document.title = f"{self.picture.name}: {' against '.join(self.names)}"
        document.template = TEMPLATES.get_template("page.html.j2")
        document.template_variables.update(
            heading=document.title, subtitle=subtitle, css=style("page.css", "runs.css"), **places
        )


def style(*names: str) -> str:
    """Style sheets of the page, one after the other."""
    return "\n".join((HERE / name).read_text(encoding="utf-8") for name in names)


def numbers(names: Sequence[str], frames: Sequence[Frame | None], time: float) -> str:
    """What has come of the runs so far, in HTML."""
    lines = []
    for n, (name, frame) in enumerate(zip(names, frames, strict=True)):
        told = (
            ()
            if frame is None
            else (
                ("inside [veh]", frame.accumulation.sum()),
                ("waiting to enter [veh]", frame.waiting),
                ("completed trips [veh]", frame.completed),
                ("time spent [veh h]", frame.time_spent / HOUR),
                ("removed [veh]", frame.removed),
            )
        )
        cells = "".join(
            f"<div style='flex:0 0 138px'><div style='font-size:19px;font-variant-numeric:tabular-nums'>{value:,.0f}"
            f"</div><div style='font-size:12px;color:{colours.FAINT}'>{text}</div></div>"
            for text, value in told
        )
        note = (
            ""
            if frame is None or not frame.note
            else (f"<div style='flex-basis:100%;font-size:13px;color:{colours.QUEUE}'>{escape(frame.note[:200])}</div>")
        )
        colour, dash = colours.RUNS[n]
        lines.append(
            f"<div style='display:flex;flex-wrap:wrap;gap:2px 10px;align-items:center;border-left:4px {dash} {colour};"
            f"padding-left:12px;margin:5px 0'><div style='flex:1 1 140px;font-weight:650;color:{colour}'>{escape(name)}"
            f"</div>{cells}{note}</div>"
        )
    return (
        "<div style='display:flex;flex-wrap:wrap;gap:4px 36px;align-items:center'>"
        f"<div style='font-size:24px;font-weight:650;flex:0 0 130px;white-space:nowrap'>{time / MINUTE:.1f} min</div>"
        f"<div style='flex:1 1 280px;min-width:0'>{''.join(lines)}</div></div>"
    )

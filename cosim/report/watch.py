"""A closed loop to look at: sumo-gui with the regions in colour and every gateway in the colour of its command."""

import os
import sys
from collections.abc import Callable, Sequence
from xml.sax.saxutils import quoteattr

import numpy as np
from matplotlib.colors import to_rgb

from cosim.evaluation.simulate import Task, scenario_of
from cosim.importing.layers import colour as region_colour
from cosim.plant.plant import SumoPlant
from cosim.plant.record import settled
from cosim.plant.settings import settings
from cosim.plant.strategy import configured, parse, planning_of
from cosim.sumo.arrays import Points
from cosim.sumo.net import City, Gateway, edge_shapes
from cosim.sumo.session import LOST, Window
from nmfd import closed_loop
from nmfd.controllers import registry
from nmfd.errors import InputError
from nmfd.model.regional_model import RegionalModel
from nmfd.runs import run_folder
from nmfd.runs.scratch import Scratch
from nmfd.types import Controls, Observation, State, Trajectory

CLOSED, HALF, OPEN, LEFT_ALONE = np.array([(214, 39, 40), (240, 190, 40), (44, 160, 44), (150, 150, 150)])
MARK, BAND = 0.005, 0.012  # radius of a gateway's mark, half width of a region's band, as shares of the city's extent
POI_RADIUS = 1.3  # m, of a point of interest in sumo-gui
VIEW = """<viewsettings>
  <scheme name="regions and gateways">
    <background backgroundColor="white" showGrid="0"/>
    <edges laneEdgeMode="0" showBorders="0">
      <colorScheme name="uniform">
        <entry color="90,90,90" name="road"/><entry color="200,200,200" name="sidewalk"/>
      </colorScheme>
    </edges>
    <vehicles vehicleMode="8" vehicleQuality="0" showBlinker="0" vehicle_minSize="0" vehicle_exaggeration="{vehicles}">
      <colorScheme name="by speed" interpolated="1">
        <entry color="200,0,40" threshold="0"/><entry color="255,220,60" threshold="5"/>
        <entry color="60,220,120" threshold="13"/>
      </colorScheme>
    </vehicles>
    <pois poi_minSize="0" poi_exaggeration="{marks}"/>
    <polys poly_minSize="0"/>
  </scheme>
  <delay value="{delay}"/>
</viewsettings>
"""


class WindowClosed(Exception):
    """The user closed the window before the end."""


def watch(
    task: Task,
    *,
    delay: float = 20.0,
    program: str = "sumo-gui",
    options: tuple[str, ...] = (),
    progress: Callable[[int, int], None] | None = None,
) -> Trajectory:
    """Run `task` in a window and return its trajectory, the same as without one.

    delay: wall time per simulation step [ms], at least; program, options: for tests, another one of SUMO's
    Raises InputError, also where there is no screen; WindowClosed.
    """
    if program == "sumo-gui" and sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
        raise InputError(
            "DISPLAY is not set: there is no screen to open a window on; record the run with `cosim run` and make a "
            "film of it with `cosim video RUN`"
        )
    scenario, strategy = scenario_of(task), parse(task.controller)
    controller = registry.make(configured(task.controller, scenario.controller_options), scenario, policy=task.policy)
    with Scratch("cosim-") as scratch:
        drawn, view = scratch / "regions.add.xml", scratch / "view.xml"
        window = Window(
            options=(
                "--gui-settings-file",
                str(view),
                "--start",
                "true",
                "--quit-on-end",
                "true",
                "--window-size",
                "1200,900",
                *options,
            ),
            additional=(drawn,),
            program=program,
        )
        plant = SumoPlant(
            scenario,
            overrides=settings(scenario).changed(**strategy.overrides),
            window=window,
            planning=planning_of(scenario, task.controller),
        )
        shapes = edge_shapes(plant.city)
        drawn.write_text(layers_xml(plant.city, shapes), encoding="utf-8")
        view.write_text(view_xml(shapes, delay), encoding="utf-8")
        try:
            trajectory = run_folder.labelled(
                closed_loop.run(
                    Painted(plant, scenario.network), controller, scenario, seed=task.seed, progress=progress
                ),
                controller=task.controller,
                plant="sumo",
            )
            plant.trip_facts()
            return settled(trajectory, plant.record())
        except LOST:
            raise WindowClosed from None
        finally:
            plant.close()


class Painted:
    """A SUMO plant (nmfd.types.Plant) whose gateways are painted with every command."""

    def __init__(self, plant: SumoPlant, network: RegionalModel):
        """plant: started with a window that has the marks of `marked`; network: whose bounds u has"""
        self._plant, self._network = plant, network
        self._marked = marked(plant.city)

    def reset(self, seed: int) -> State:
        """As the plant does."""
        state = self._plant.reset(seed)
        leaks = set(self._plant.leaks())
        self._controlled = {mark: gateway for mark, gateway in self._marked.items() if gateway not in leaks}
        return state

    def step(self, controls: Controls) -> State:
        """Paint the gateways that a command reaches, then simulate a control interval."""
        low, high = self._network.u_min, self._network.u_max
        self._plant.session.paint(
            {
                mark: colour((controls.perimeter[g.source, g.target] - low) / (high - low))
                for mark, g in self._controlled.items()
            }
        )
        return self._plant.step(controls)

    def observe(self) -> Observation | None:
        """As the plant does."""
        return self._plant.observe()

    def close(self) -> None:
        """As the plant does."""
        self._plant.close()


def colour(share: float) -> tuple[int, int, int]:
    """Of a gateway: red at 0, its least green; green at 1, its original programme."""
    share = min(max(float(share), 0.0), 1.0)
    low, high, part = (CLOSED, HALF, 2 * share) if share < 0.5 else (HALF, OPEN, 2 * share - 1)
    red, green, blue = (low + part * (high - low)).round().astype(int).tolist()
    return red, green, blue


def marked(city: City) -> dict[str, Gateway]:
    """Mark -> gateway, one for every edge and neighbour behind it."""
    first: dict[tuple[str, int], Gateway] = {}
    for gateway in city.gateways:
        first.setdefault((gateway.from_edge, gateway.target), gateway)
    return {f"gateway{n}": gateway for n, gateway in enumerate(first.values())}


def extent(shapes: Sequence[Points]) -> float:
    """Of the map, the longer side [m]."""
    return float(np.ptp(np.concatenate(shapes), axis=0).max())


def view_xml(shapes: Sequence[Points], delay: float) -> str:
    """sumo-gui's settings: vehicles in the colour of their speed, larger than they are in a large city."""
    size = extent(shapes)
    return VIEW.format(delay=delay, vehicles=min(max(size / 500.0, 1.0), 10.0), marks=MARK * size / POI_RADIUS)


def layers_xml(city: City, shapes: Sequence[Points]) -> str:
    """An additional file: a band under every edge in the colour of its region, and a grey mark where an edge ends at a
    boundary. shapes: of the edges, (n, 2) [m]."""
    width, lines_of = BAND * extent(shapes), dict(zip(city.edges, shapes, strict=True))
    lines = [
        f'  <poly id={quoteattr("region-" + edge)} color="{_rgb(city.region_of[edge])}" fill="0" layer="-1" '
        f'lineWidth="{width:.1f}" shape="{" ".join(f"{x:.1f},{y:.1f}" for x, y in shape)}"/>\n'
        for edge, shape in lines_of.items()
    ]
    grey = ",".join(map(str, LEFT_ALONE))
    for mark, gateway in marked(city).items():
        x, y = lines_of[gateway.from_edge][-1]
        lines.append(
            f'  <poi id="{mark}" type="{gateway.source} &gt; {gateway.target}" color="{grey}" layer="5" x="{x:.1f}" '
            f'y="{y:.1f}"/>\n'
        )
    return f"<additional>\n{''.join(lines)}</additional>\n"


def _rgb(region: int) -> str:
    """The region's colour, half as strong as on the map of an import: vehicles and marks lie on it."""
    return ",".join(str(round(255 * (1.0 + part) / 2)) for part in to_rgb(region_colour(region)))

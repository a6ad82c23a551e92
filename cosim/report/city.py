"""A city to look at before anything runs: its regions, gateways and flows as tables and on a map."""

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from cosim.importing import maps, quality
from cosim.importing.streets import Streets, read_streets
from cosim.plant.launch import own_files
from cosim.plant.settings import settings
from cosim.report import figures
from cosim.sumo import net
from cosim.sumo.build import ensure_built
from nmfd.api import load_scenario
from nmfd.arrays import Positions
from nmfd.errors import InputError
from nmfd.model.regional_model import RegionalModel, load_network
from nmfd.model.scenario import Scenario

OF_REGIONS = ("region", "name", "edges", "lane_km", "signals", "pieces", "gateways", "controlled_gateways")


class City:
    """The SUMO city of a network or scenario; nothing is simulated.

        city = cosim.City("scenarios/grid7_peak")
        city.plot()
        city.regions, city.gateways, city.flows

    name; network: its RegionalModel; scenario: nmfd.Scenario, None of a network alone
    """

    def __init__(self, city: Path | str | Scenario | RegionalModel):
        """city: the folder of a network or a scenario, or what was loaded from one. InputError without a SUMO city."""
        if not isinstance(city, Scenario | RegionalModel):
            city = _loaded(city)
        self.scenario = city if isinstance(city, Scenario) else None
        self.network = city.network if isinstance(city, Scenario) else city
        self.name = city.name
        self._files = ensure_built(self.network)

    @cached_property
    def regions(self) -> pd.DataFrame:
        """A row per region: name, edges and lane_km for cars, signals, pieces (1 is connected), gateways that touch it
        and those under control, x_m and y_m of its middle, and of its MFD critical_veh, jam_veh, max_outflow_veh_s."""
        rows = pd.DataFrame(self._tables.quality[:-1], columns=OF_REGIONS).astype({"region": int})
        rows["x_m"], rows["y_m"] = self._places.round(1).T
        for column, what in (("critical_veh", "critical"), ("jam_veh", "jam"), ("max_outflow_veh_s", "capacity")):
            rows[column] = [getattr(mfd, what) for mfd in self.network.mfds]
        return rows

    @cached_property
    def gateways(self) -> pd.DataFrame:
        """A row per movement over a boundary, from region source to target: edges, lanes, signal with its links, and
        control: "controlled", "no signal", or why perimeter control leaves the signal alone."""
        return pd.DataFrame(self._tables.gateways).drop(columns="flow_veh")

    @cached_property
    def flows(self) -> pd.DataFrame:
        """A row per pair of regions with demand: origin, destination, trips_veh in all, peak_veh_s.

        InputError of a network alone, which has none.
        """
        if self.scenario is None:
            raise InputError(f"{self.name}: is a network, without demand; give the folder of a scenario on it")
        demand = self.scenario.demand
        trips = self.scenario.step * demand.sum(axis=0)
        pairs = np.argwhere(trips > 0)
        return pd.DataFrame(
            {
                "origin": pairs[:, 0],
                "destination": pairs[:, 1],
                "trips_veh": trips[trips > 0],
                "peak_veh_s": demand.max(axis=0)[trips > 0],
            }
        )

    def plot(self, ax: Axes | None = None, *, flows: bool = True) -> Axes:
        """The map: streets in the colour of their region, gateways with and without control, and with `flows` arrows
        for the demand between regions, if there is a scenario. ax: None for a new figure of pyplot. Returns `ax`."""
        if ax is None:
            from matplotlib import pyplot  # only where it is wanted: it brings global state

            _, ax = pyplot.subplots(figsize=(6.5, 6.0), layout="constrained")
        maps.region_map(ax, self._streets, self._regions, self.network.region_names, self._places)
        maps.gateway_marks(ax, self._streets, self._tables)
        if flows and self.scenario is not None:
            figures.flow_arrows(ax, self._places, self.scenario.step * self.scenario.demand.sum(axis=0))
        return ax

    def __repr__(self) -> str:
        """Name and numbers."""
        return f"<City {self.name}: {len(self.regions)} regions, {len(self.gateways)} gateways>"

    def _repr_html_(self) -> str:
        return self.regions.to_html(index=False)

    @cached_property
    def _city(self) -> net.City:
        return net.city_of(self.network)

    @cached_property
    def _streets(self) -> Streets:
        own = own_files(self.scenario, settings(self.scenario).additional) if self.scenario else ()
        return read_streets(self._files.net_file, own)

    @cached_property
    def _regions(self) -> np.ndarray:
        return np.array([self._city.region_of.get(edge, -1) for edge in self._streets.edges])

    @cached_property
    def _places(self) -> Positions:
        streets = self._streets
        return np.stack(
            [streets.centre[streets.drivable & (self._regions == r)].mean(axis=0) for r in range(self.network.regions)]
        )

    @cached_property
    def _tables(self) -> quality.Tables:
        alone: Mapping[str, str] = quality.left_alone(self._streets)
        if self.scenario is not None:
            alone = {**alone, **dict.fromkeys(settings(self.scenario).leave_signals, "left alone by the scenario")}
        return quality.tables(self._streets, self._regions, self.network.region_names, self._city, None, alone)


def _loaded(where: Path | str) -> Scenario | RegionalModel:
    """The scenario or network in a folder, or of that name. InputError."""
    folder = Path(where)
    if (folder / "scenario.toml").is_file():
        return load_scenario(where)
    try:
        return load_network(where)
    except InputError:
        if any(folder.parent.glob("*/network.toml")):  # meant, but misspelt or broken
            raise
    return load_scenario(where)

"""A city before anything runs: regions and gateways in tables and a map."""

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from cosim.importing import maps, quality
from cosim.importing.streets import read_streets
from cosim.plant.settings import own_files, settings
from cosim.sumo import net
from cosim.sumo.signals import read_files, without_effect
from nmfd.api import load_scenario
from nmfd.model.regional_model import RegionalModel, load_network
from nmfd.model.scenario import Scenario
from nmfd.runs import shipped
from nmfd.studies import plots

REGION_COLUMNS = [
    "region",
    "name",
    "edges",
    "lane_km",
    "signals",
    "gateways",
    "controlled_gateways",
]


class City:
    """The SUMO city of a network or scenario; nothing is simulated.

        >>> city = cosim.City("demo")
        >>> axes = city.plot()
        >>> len(city.regions), city.gateways.columns.tolist()[:4]
        (5, ['source', 'target', 'from_edge', 'to_edge'])

    network: the regional model
    scenario: None for a network alone
    """

    def __init__(self, city: Path | str | Scenario | RegionalModel):
        """Read the city.

        city: a loaded scenario or network, its folder or its name
        Raises: InputError without a SUMO city
        """
        if not isinstance(city, Scenario | RegionalModel):
            folder = shipped.found(city, shipped.SCENARIO, shipped.NETWORK)
            if (folder / "network.toml").is_file():
                city = load_network(folder)
            else:
                city = load_scenario(folder)
        self.name = city.name
        self.scenario: Scenario | None = None
        additional: Sequence[Path] = ()
        left: Sequence[str] = ()
        switched_off = ""
        if isinstance(city, Scenario):
            self.scenario = city
            self.network = city.network
            setup = settings(city)
            additional = own_files(city, setup.additional)
            left = setup.leave_signals
            switched_off = without_effect(setup.options, bool(setup.mesoscopic))
        else:
            self.network = city
        built = net.city_of(self.network)
        streets = read_streets(built.net_file, additional)
        regions = np.array([built.region_of.get(edge, -1) for edge in streets.edges])
        places = []
        for region in range(self.network.regions):
            members = streets.drivable & (regions == region)
            places.append(streets.centre[members].mean(axis=0))
        reasons = dict.fromkeys(left, "left alone by the scenario")
        timetables = read_files(built.net_file, additional).timetabled
        reasons |= quality.left_alone(streets, timetables, switched_off)
        names = self.network.region_names
        self._streets = streets
        self._regions = regions
        self._places = np.stack(places)
        self._tables = quality.tables(streets, regions, names, built, None, reasons)

    @cached_property
    def regions(self) -> pd.DataFrame:
        """Table with a row per region.

        Its columns are name, edges and lane_km for cars, signals, gateways and controlled ones,
        centre x_m and y_m, and critical_veh, jam_veh and max_outflow_veh_s of its MFD.
        """
        rows = pd.DataFrame(self._tables.quality[:-1])[REGION_COLUMNS].astype({"region": int})
        rows["x_m"], rows["y_m"] = self._places.round(1).T
        rows["critical_veh"] = self.network.seen_critical
        rows["jam_veh"] = [mfd.jam for mfd in self.network.mfds]
        rows["max_outflow_veh_s"] = [mfd.capacity for mfd in self.network.mfds]
        return rows

    @cached_property
    def gateways(self) -> pd.DataFrame:
        """Table with a row per movement over a boundary.

        It shows edges, lanes, signal with its links, and control.
        """
        return pd.DataFrame(self._tables.gateways).drop(columns="flow_veh")

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw gateways, and streets in the colour of their region.

        ax: axes of a new figure if None
        """
        if ax is None:
            ax = plots.figure(6.5, 6.0).subplots()
        names = self.network.region_names
        return maps.region_map(ax, self._streets, self._regions, names, self._places, self._tables)

    def __repr__(self) -> str:
        return f"<City {self.name}: {len(self.regions)} regions, {len(self.gateways)} gateways>"

    def _repr_html_(self) -> str:
        return self.regions.to_html(index=False)

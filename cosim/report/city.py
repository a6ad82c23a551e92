"""A city before anything runs: its regions and gateways as tables and on a map."""

from functools import cached_property
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from cosim.importing import maps, quality
from cosim.importing.streets import read_streets
from cosim.plant.settings import own_files, settings
from cosim.sumo import net
from cosim.sumo.signals import timetabled, without_effect
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

    network: the regional model; scenario: None for a network alone
    """

    def __init__(self, city: Path | str | Scenario | RegionalModel):
        """city: a loaded scenario or network, its folder or its name. Raises InputError without a
        SUMO city."""
        if not isinstance(city, Scenario | RegionalModel):
            folder = shipped.found(city, shipped.SCENARIO, shipped.NETWORK)
            city = (
                load_network(folder)
                if (folder / "network.toml").is_file()
                else load_scenario(folder)
            )
        self.scenario = city if isinstance(city, Scenario) else None
        self.network = city.network if isinstance(city, Scenario) else city
        self.name = city.name
        setup = None if self.scenario is None else settings(self.scenario)
        additional = own_files(self.scenario, setup.additional) if self.scenario and setup else ()
        left = setup.leave_signals if setup else ()
        net_file = net.city_files(self.network).net_file
        self._streets = read_streets(net_file, additional)
        built = net.city_of(self.network)
        self._regions = np.array([built.region_of.get(edge, -1) for edge in self._streets.edges])
        of_region = [
            self._streets.drivable & (self._regions == r) for r in range(self.network.regions)
        ]
        self._places = np.stack(
            [self._streets.centre[members].mean(axis=0) for members in of_region]
        )
        reasons = dict.fromkeys(left, "left alone by the scenario") | quality.left_alone(
            self._streets,
            timetabled(net_file, additional),
            without_effect(setup.options, setup.mesoscopic) if setup else "",
        )
        names = self.network.region_names
        self._tables = quality.tables(self._streets, self._regions, names, built, None, reasons)

    @cached_property
    def regions(self) -> pd.DataFrame:
        """One row per region.

        name, edges and lane_km for cars, signals, gateways and controlled ones, centre x_m and
        y_m, and critical_veh, jam_veh and max_outflow_veh_s of its MFD
        """
        rows = pd.DataFrame(self._tables.quality[:-1])[REGION_COLUMNS].astype({"region": int})
        rows["x_m"], rows["y_m"] = self._places.round(1).T
        rows["critical_veh"] = self.network.seen_critical
        for column, attribute in (("jam_veh", "jam"), ("max_outflow_veh_s", "capacity")):
            rows[column] = [getattr(mfd, attribute) for mfd in self.network.mfds]
        return rows

    @cached_property
    def gateways(self) -> pd.DataFrame:
        """One row per movement over a boundary: edges, lanes, signal with its links, and its
        control."""
        return pd.DataFrame(self._tables.gateways).drop(columns="flow_veh")

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw streets in the colour of their region, and gateways, into `ax` or a new figure."""
        ax = plots.figure(6.5, 6.0).subplots() if ax is None else ax
        names = self.network.region_names
        return maps.region_map(ax, self._streets, self._regions, names, self._places, self._tables)

    def __repr__(self) -> str:
        return f"<City {self.name}: {len(self.regions)} regions, {len(self.gateways)} gateways>"

    def _repr_html_(self) -> str:
        return self.regions.to_html(index=False)

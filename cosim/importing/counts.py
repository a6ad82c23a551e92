"""Trips that give the counts of streets, by SUMO's routeSampler.py.

Routes of generated morning peaks are the candidates. The sampler takes as many vehicles on each as
fit the counts best, interval by interval. Traffic that passes no counted street is not there.
"""

from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float, Int

from cosim.importing.baseline import Baseline
from cosim.importing.case import Progress
from cosim.importing.demand import wrapped
from cosim.importing.generated import ANYWHERE, morning_peak
from cosim.importing.streets import Streets, numbers_of
from cosim.sumo.edge_data import read_edge_data
from cosim.sumo.programs import last_words, run_tool
from cosim.sumo.xml_files import attribute, read_xml
from nmfd.errors import InputError

ENTERED = "entered"  # attribute of edgeData that is taken for the count
GOOD_GEH = 5.0  # below it a count is met, as in the guidelines of road authorities
MET_SHARE = 0.85  # of the counts that these want to be met
Flows = Float[np.ndarray, " n"]


class Counted(NamedTuple):
    """Sampled trips, and the counts that they are made of.

    routes: file of the trips
    edges: the n streets with counts above 0
    measured, driven: vehicles an hour that were counted, and that the sampled routes give (n,)
    hours: of the counts
    """

    routes: Path
    edges: Int[np.ndarray, " n"]
    measured: Flows
    driven: Flows
    hours: float

    def text(self, streets: Streets, baseline: Baseline) -> str:
        """Return the shares of counts that are met, by the routes and in SUMO.

        baseline: the run without control
        """
        passed = np.zeros(len(streets.edges))
        for (way, _), vehicles in baseline.ways.items():
            np.add.at(passed, np.array(way, dtype=int), vehicles)
        by_routes = _met(self.measured, self.driven)
        in_sumo = _met(self.measured, passed[self.edges] / self.hours)
        line = (
            f"counts: {by_routes:.0%} of {len(self.edges):,} streets have a GEH below "
            f"{GOOD_GEH:g} by the sampled routes, {in_sumo:.0%} in the run without control"
        )
        if min(by_routes, in_sumo) < MET_SHARE:
            line += f"; WARNING: less than {MET_SHARE:.0%}, this is not the counted traffic"
        return line


def geh(one: Flows, other: Flows) -> Flows:
    """Return the GEH statistic of flows (veh/h)."""
    return np.sqrt(2.0 * (one - other) ** 2 / np.maximum(one + other, 1e-9))


def _met(measured: Flows, flows: Flows) -> float:
    return float((geh(measured, flows) < GOOD_GEH).mean())


def sampled(counts: Path, streets: Streets, folder: Path, seed: int, progress: Progress) -> Counted:
    """Write trips that give the counts best into a folder.

    counts: edgeData with ENTERED
    Raises: InputError
    """
    progress("trips from counts")
    rows = read_edge_data(counts, ENTERED)
    numbers_of(rows["edge"], streets, counts)
    if not rows[ENTERED].sum():
        raise InputError(f"{counts}: all counts ({ENTERED}) are 0; give counted vehicles")
    peak = morning_peak(streets, level=1.0, begin=0.0, seed=seed)
    candidates = folder / "candidates.rou.xml"
    ElementTree.ElementTree(wrapped(peak.vehicles, "routes")).write(candidates)
    routes = folder / "counted.rou.xml"
    mismatch = folder / "mismatch.xml"
    attributes = " ".join(f'{name}="{value}"' for name, value in ANYWHERE.items())
    files = ["--route-files", str(candidates), "--edgedata-files", str(counts.absolute())]
    files += ["--output-file", str(routes), "--mismatch-output", str(mismatch)]
    how = ["--edgedata-attribute", ENTERED, "--optimize", "full", "--seed", str(seed)]
    how += ["--prefix", "counted", "--attributes", attributes]
    done = run_tool("routeSampler.py", *files, *how, folder=folder)
    if done.returncode:
        reason = last_words(done)
        raise InputError(f"{counts}: routeSampler.py finds no trips: {reason}; correct the counts")
    measured = np.zeros(len(streets.edges))
    missing = np.zeros(len(streets.edges))
    for edge in read_xml(mismatch).iter("edge"):
        number = streets.number.get(attribute(edge, "id"))
        if number is None:
            continue  # on a junction
        measured[number] += float(attribute(edge, "measuredCount"))
        missing[number] += float(attribute(edge, "deficit"))
    intervals = rows.drop_duplicates("begin")
    hours = float((intervals["end"] - intervals["begin"]).sum()) / 3600.0
    edges = np.flatnonzero(measured)
    return Counted(
        routes=routes,
        edges=edges,
        measured=measured[edges] / hours,
        driven=(measured - missing)[edges] / hours,
        hours=hours,
    )

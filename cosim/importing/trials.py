"""Runs without control of a city that is being imported, at any multiple of its demand."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from xml.etree.ElementTree import Element, ElementTree

from cosim.importing import model
from cosim.importing.assignment import Assigned, Effort, assign
from cosim.importing.baseline import Baseline, Tell, averaged, run_baseline
from cosim.importing.case import SumoInput
from cosim.importing.demand import Traffic, wrapped
from cosim.importing.generated import morning_peak
from cosim.importing.streets import Streets
from cosim.sumo.recorded_trips import MESOSCOPIC, draw, read_recorded_trips, write_recorded_trips
from nmfd.runs.files import temporary_folder

MINUTE = 60.0
JITTER = 10.0  # s: what seeds differ in, as in the scenario that is written
TYPES = ("vType", "vTypeDistribution")


def routed(traffic: Traffic) -> list[Element]:
    """The vehicles of a generated demand with the types that they need, as cosim.importing.assignment wants them."""
    return [*(element for element in traffic.shared if element.tag in TYPES), *traffic.vehicles]


class Trials:
    """Runs of `traffic`, the city's own vehicles, left out or doubled; each level is run once for each seed."""

    def __init__(self, streets: Streets, case: SumoInput, clock: model.Clock, folder: Path, files: Mapping):
        """folder, files: where the vehicles are (cosim.importing.written)."""
        self._streets, self._clock = streets, clock
        self._routes, self._background, self._additional = (
            [folder / name for name in files[key]] for key in ("routes", "background", "additional")
        )
        self._options = [
            "--step-length",
            f"{model.step_length(case, clock):g}",
            "--time-to-teleport",
            f"{case.time_to_teleport:g}",
        ]
        self._known: dict[tuple[float, bool, int], Baseline] = {}

    def run(
        self,
        factor: float,
        mesoscopic: bool,
        seed: int = 0,
        look: Callable[[Path], None] = lambda edges: None,
        reached: Callable[[float], None] = lambda share: None,
    ) -> Baseline:
        """With the demand times `factor`. Of seed 0 everybody departs when they wish to. look: as of run_baseline;
        reached: is called now and then with the share that is done [-]."""
        begin, length = self._clock.begin, self._clock.end - self._clock.begin
        if (key := (factor, mesoscopic, seed)) not in self._known:
            with temporary_folder() as folder:
                routes, vehicles = self._vehicles(folder, factor, seed)
                self._known[key] = run_baseline(
                    self._streets,
                    routes=[*routes, *self._background],
                    additional=self._additional,
                    begin=self._clock.begin,
                    end=self._clock.end,
                    vehicles=vehicles,
                    seed=seed,
                    look=look,
                    reached=lambda time: reached(min((time - begin) / length, 1.0)),
                    options=[*self._options, *(MESOSCOPIC if mesoscopic else ())],
                )
        return self._known[key]

    def averaged(
        self, factor: float, mesoscopic: bool, seeds: int, tell: Tell, look: Callable[[Path], None]
    ) -> Baseline:
        """Of seeds 0 to seeds - 1. look: as of run_baseline, for the first."""
        runs = []
        for seed in range(seeds):

            def reached(share: float, seed: int = seed) -> None:
                length = (self._clock.end - self._clock.begin) / MINUTE
                tell(
                    f"simulating without control, {seed + 1} of {seeds}: {share * length:.0f} of {length:.0f} min",
                    (seed + share) / seeds,
                )

            reached(0.0)
            runs.append(self.run(factor, mesoscopic, seed, look if seed == 0 else lambda edges: None, reached))
        return averaged(runs)

    def _vehicles(self, folder: Path, factor: float, seed: int) -> tuple[list[Path], list[str]]:
        """(route files of the demand, the ids of its vehicles)"""
        original = read_recorded_trips(self._routes)
        if factor == 1.0 and seed == 0:
            return self._routes, [vehicle.get("id", "") for vehicle in original.elements]
        routes = folder / "vehicles.rou.xml"
        drawn = draw(original, seed=seed, factor=factor, jitter=JITTER if seed else 0.0, begin=self._clock.begin)
        write_recorded_trips(original, drawn, routes)
        return [routes], [name for _, _, name in drawn]


class Peaks:
    """Generated peaks at any level, their routes assigned; each level is made once."""

    def __init__(
        self,
        streets: Streets,
        case: SumoInput,
        beside: Traffic,
        *,
        seed: int,
        effort: Effort,
        mesoscopic: bool,
        tell: Tell,
    ):
        """beside: what else the city's files hold; effort, mesoscopic: of the assignment."""
        self._streets, self._case, self._beside, self._seed, self._effort, self._mesoscopic, self._tell = (
            streets,
            case,
            beside,
            seed,
            effort,
            mesoscopic,
            tell,
        )
        self._known: dict[float, tuple[Traffic, Assigned | None]] = {}

    def at(self, level: float) -> tuple[Traffic, Assigned | None]:
        """(the traffic, how its routes were assigned) at `level` times the usual peak."""
        if level not in self._known:
            traffic = self._generated(level)
            self._known[level] = traffic, None
            if self._effort.iterations:
                self._known[level] = self._assigned(traffic)
        return self._known[level]

    def _generated(self, level: float) -> Traffic:
        beside = self._beside
        peak = morning_peak(self._streets, level=level, begin=self._case.begin, seed=self._seed)
        known = {part.get("id") for element in beside.shared for part in element.iter("vType")}
        own = tuple(e for e in peak.shared if e.get("id") not in known)  # a type car of the city will do
        return replace(
            peak,
            background=beside.background,
            shared=beside.shared + own,
            switched=beside.switched,
            notes={**beside.notes, **peak.notes},
        )

    def _assigned(self, traffic: Traffic) -> tuple[Traffic, Assigned]:
        """Only cars drive in the assignment: what runs in the background is left out of it."""
        clock = model.clock(self._case, self._streets, traffic)
        others = [element for element in traffic.shared if element.tag not in TYPES]
        with temporary_folder() as folder:
            additional: list[Path] = []
            if others:
                additional = [folder / "city.add.xml"]
                ElementTree(wrapped(others, "additional")).write(additional[0])
            found = assign(
                self._streets.path.absolute(),
                routed(traffic),
                begin=clock.begin,
                end=clock.end,
                seed=self._seed,
                effort=self._effort,
                additional=additional,
                mesoscopic=self._mesoscopic,
                options=[f"--time-to-teleport={self._case.time_to_teleport:g}"],
                tell=self._tell,
            )
        for vehicle in traffic.vehicles:
            if (route := vehicle.find("route")) is not None and (name := vehicle.get("id", "")) in found.routes:
                route.set("edges", " ".join(found.routes[name]))
        return traffic, found

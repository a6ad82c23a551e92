"""A closed-loop run against the bare sumo binary on the same network, trips, signals, seed and options.

    python tests/benchmarks/sumo_overhead.py [--controllers no-control,pi-gating] [--intervals 20] [--repeats 3]

The binary shows the signals that the closed loop showed, as fixed programmes that last for the whole run, and both
must write the same trip file. Compared is all from the start of SUMO to its end; the making of the trips and the
imports of Python are outside. CPU times are compared besides wall times: on a busy machine only they mean something.
"""

import argparse
import cProfile
import pstats
import resource
import subprocess
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import sumo
import torch

from cosim.plant.plant import SumoPlant
from cosim.sumo.session import Session
from nmfd import closed_loop
from nmfd.api import controller as make_controller
from nmfd.api import load_scenario
from nmfd.model.scenario import Scenario

SCENARIO = Path(__file__).parents[2] / "scenarios" / "grid7_peak"
FIRST = 12  # control interval from which the demand is taken: it flows from the beginning


@dataclass(frozen=True, kw_only=True)
class Timed:
    """wall, cpu [s]; trips: what SUMO wrote of every trip, without the lines that name files and dates"""

    wall: float
    cpu: float
    trips: list[str]


def short(intervals: int) -> Scenario:
    loaded = load_scenario(SCENARIO)
    return replace(loaded, steps=intervals, demand=loaded.demand[FIRST : FIRST + intervals])


def closed(scenario: Scenario, controller: str, seed: int, folder: Path) -> tuple[Timed, list[str]]:
    """The closed loop, from the start of SUMO to its end; and the command line of the same run for the binary."""
    shown: dict[str, list[tuple[float, str]]] = {}
    command: list[str] = []
    original_start, original_show = Session.__init__, Session.set_signal_state
    begin = [0.0, 0.0]

    def start(self, net_file, route_files, **options):
        (route_file,) = route_files
        kept = folder / "trips.rou.xml"
        kept.write_bytes(Path(route_file).read_bytes())
        begin[:] = time.perf_counter(), _cpu(resource.RUSAGE_SELF)
        original_start(self, net_file, route_files, **options)
        command[:] = [part.replace(str(route_file), str(kept)) for part in self.command]

    def show(self, signal, state):
        shown.setdefault(signal, []).append((self.time, state))
        original_show(self, signal, state)

    plant = SumoPlant(scenario)
    Session.__init__, Session.set_signal_state = start, show
    try:
        closed_loop.run(plant, make_controller(controller, scenario), scenario, seed=seed)
        plant.session.close()
        wall, cpu = time.perf_counter() - begin[0], _cpu(resource.RUSAGE_SELF) - begin[1]
        written = Path(command[command.index("--tripinfo-output") + 1])
        trips = _trips(written)
    finally:
        Session.__init__, Session.set_signal_state = original_start, original_show
        plant.close()
    end = scenario.step * scenario.steps
    additional = folder / f"{controller}.add.xml"
    additional.write_text(_programmes(shown, end))
    command[command.index("--tripinfo-output") + 1] = str(folder / "bare.xml")
    return Timed(wall=wall, cpu=cpu, trips=trips), [*command, "--additional-files", str(additional), "--end", str(end)]


def bare(command: list[str]) -> Timed:
    """The sumo binary on `command`, whose first word is replaced by its path."""
    wall, cpu = time.perf_counter(), _cpu(resource.RUSAGE_CHILDREN)
    subprocess.run([Path(sumo.SUMO_HOME) / "bin" / "sumo", *command[1:]], check=True)
    wall, cpu = time.perf_counter() - wall, _cpu(resource.RUSAGE_CHILDREN) - cpu
    return Timed(wall=wall, cpu=cpu, trips=_trips(Path(command[command.index("--tripinfo-output") + 1])))


def _trips(path: Path) -> list[str]:
    lines = path.read_text(encoding="utf-8").splitlines()
    return sorted(line for line in lines if "<tripinfo " in line or "<emissions " in line)


def _programmes(shown: dict[str, list[tuple[float, str]]], end: float) -> str:
    """Fixed programmes that show the same from 0 to `end` [s]."""
    lines = ["<additional>"]
    for signal, changes in shown.items():
        lines.append(f'<tlLogic id="{signal}" type="static" programID="recorded" offset="0">')
        for (begin, state), (until, _) in zip(changes, [*changes[1:], (end + 1.0, "")], strict=True):
            if until > begin:
                lines.append(f'<phase duration="{until - begin:g}" state="{state}"/>')
        lines.append("</tlLogic>")
    return "\n".join([*lines, "</additional>"])


def _cpu(who: int) -> float:
    usage = resource.getrusage(who)
    return usage.ru_utime + usage.ru_stime


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--controllers", default="no-control,pi-gating")
    parser.add_argument("--intervals", type=int, default=20)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--profile", action="store_true", help="print where the closed loop spends its time")
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    scenario = short(chosen.intervals)
    for controller in chosen.controllers.split(","):
        pairs = []
        with tempfile.TemporaryDirectory() as folder:
            for _ in range(chosen.repeats):
                loop, command = closed(scenario, controller, 1, Path(folder))
                pairs.append((loop, bare(command)))
        same = all(loop.trips == alone.trips for loop, alone in pairs)
        wall, cpu = (
            [min(getattr(side, kind) for side in sides) for sides in zip(*pairs, strict=True)]
            for kind in ("wall", "cpu")
        )
        print(
            f"{controller}, {chosen.intervals} intervals, best of {chosen.repeats}: closed loop / bare binary: "
            f"wall {wall[0]:.2f} / {wall[1]:.2f} s = {wall[0] / wall[1]:.3f}, CPU {cpu[0]:.2f} / {cpu[1]:.2f} s = "
            f"{cpu[0] / cpu[1]:.3f}; trips {'the same' if same else 'DIFFERENT'}",
            flush=True,
        )
        if chosen.profile:
            profile = cProfile.Profile()
            with tempfile.TemporaryDirectory() as folder:
                profile.runcall(closed, scenario, controller, 1, Path(folder))
            pstats.Stats(profile).sort_stats("tottime").print_stats(22)


if __name__ == "__main__":
    main()

"""What sumo_overhead.py compares is the same: bare SUMO under the recorded signals moves every vehicle alike.

The ratio of the times: python tests/benchmarks/sumo_overhead.py
"""

from dataclasses import replace

import sumo_overhead


def test_bare_sumo_under_the_recorded_signals_runs_the_same_trips(tmp_path):
    scenario = replace(sumo_overhead.short(2), controller_options={"pi-gating": {"set_point": [10.0]}})
    loop, command = sumo_overhead.closed(scenario, "pi-gating", 1, tmp_path)
    programmes = (tmp_path / "pi-gating.add.xml").read_text()
    assert programmes.count("<tlLogic") > 20 and len(loop.trips) > 400
    assert sumo_overhead.bare(command).trips == loop.trips
    unchanged = command[: command.index("--additional-files")] + command[command.index("--end") :]
    assert sumo_overhead.bare(unchanged).trips != loop.trips

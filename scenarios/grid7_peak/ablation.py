"""Which part of the controls over max-pressure gains what: prices, gate and metering, one by one
and together.

    python scenarios/grid7_peak/ablation.py runs/ablation --demand 1.6,2 --first-seed 3400 --seeds 2

The pricing rule, DPC and the tuned PI gate can be written in the same numbers
(nmfd/controllers/dpc/compact.py), so that every combination is a rule with other numbers. Every row
of CELLS is one `cosim evaluate` with a run folder of its own; ablation.csv has the runs of all.
"""

import subprocess
import sys
from pathlib import Path

import click
import pandas as pd

import nmfd
from nmfd.controllers.dpc.numbers import Numbers

OVER = "+max-pressure+guidance-period-60"
SCENARIO, MODEL = nmfd.load_scenario("grid7_peak"), nmfd.load_network("grid7_max_pressure")
RULE = Numbers(
    *SCENARIO.controller_options[f"pricing-rule{OVER}+metering"]["numbers"]
)  # its gate is open
TRAINED = nmfd.controller(f"dpc-pcrg{OVER}+metering", SCENARIO).policy.numbers.tolist()
DPC = Numbers(*(round(number, 4) for number in TRAINED))._replace(
    **dict(zip(Numbers._fields[:3], RULE, strict=False))
)
TUNED, SPAN = SCENARIO.controller_options[f"pi-gating+guided{OVER}"], MODEL.u_max - MODEL.u_min
PI = {  # the same gate in units of a rule
    "set_point": round(TUNED["set_point"][0] / MODEL.mfds[SCENARIO.protected[0]].critical, 3),
    "gain": round(TUNED["kp"] / SPAN, 4),
    "relief": 0.0,
    "integral": round(TUNED["ki"] * SCENARIO.step / SPAN, 4),
}
CELLS = {  # name: (strategy, numbers or None)
    "metering": (f"route-guidance{OVER}+metering", None),
    "gate": (f"pi-gating+guided{OVER}", None),
    "gate-metering": (f"pi-gating+guided{OVER}+metering", None),
    "rule": (f"pricing-rule{OVER}", RULE),
    "rule-metering": (f"pricing-rule{OVER}+metering", None),
    "rule-gate-metering": (f"pricing-rule{OVER}+metering", RULE._replace(**PI)),
    "dpc": (f"pricing-rule{OVER}", DPC),
    "dpc-metering": (f"dpc-pcrg{OVER}+metering", None),
    "dpc-gate-metering": (f"pricing-rule{OVER}+metering", DPC._replace(**PI)),
    "no-guidance-metering": ("max-pressure+metering", None),
    "rerouting-metering": ("rerouting-30+max-pressure+metering", None),
    **{
        f"{name}-{word}": (f"{strategy}{OVER}+metering+{word}", None)
        for name, strategy in (("rule", "pricing-rule"), ("dpc", "dpc-pcrg"))
        for word in ("compliance-25", "compliance-50", "estimate")
    },
}


@click.command()
@click.argument("out", type=click.Path(path_type=Path))
@click.option("--cells", default=",".join(CELLS), help="Names in CELLS.")
@click.option("--demand", default="1.6,2")
@click.option("--first-seed", default=1100)
@click.option("--seeds", default=1)
@click.option("--workers", default=2)
def main(out: Path, cells: str, demand: str, first_seed: int, seeds: int, workers: int) -> None:
    """Run the cells CELLS, and write OUT/ablation.csv."""
    for cell in cells.split(","):
        strategy, numbers = CELLS[cell]
        command = [
            sys.executable,
            "-m",
            "cosim",
            "evaluate",
            "grid7_peak",
            "--controllers",
            strategy,
        ]
        command += ["--demand", demand, "--first-seed", str(first_seed), "--seeds", str(seeds)]
        command += ["--workers", str(workers), "--out", str(out / cell)]
        if numbers is not None:
            command += ["--set", f'controllers."{strategy}".numbers={list(numbers)}']
        subprocess.run(command, check=True)
    runs = [
        pd.read_csv(table).assign(cell=table.parent.name)
        for table in sorted(out.glob("*/runs.csv"))
    ]
    pd.concat(runs).to_csv(out / "ablation.csv", index=False)


if __name__ == "__main__":
    main()

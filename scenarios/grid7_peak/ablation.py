"""Which part of the controls over max-pressure gains what: prices, gate and metering, one by one and together.

    python scenarios/grid7_peak/ablation.py runs/ablation --demand 1.6,2 --first-seed 3400 --seeds 2

Prices and metering of the pricing rule and of DPC, and the tuned PI gate, are numbers of one form
(nmfd/controllers/dpc/compact.py), so that every combination is a rule with other numbers. Every row of CELLS is one
`cosim evaluate` with a run folder of its own; ablation.csv has the runs of all.
"""

import subprocess
import sys
from pathlib import Path

import click
import pandas as pd

OVER = "+max-pressure+guidance-period-60"
RULE, DPC = [7.63, 0.465, 0.67, 0.985], [2.2994, 0.1366, 0.3757, 0.6303]  # price, price_from, elsewhere, elsewhere_from
OPEN, PI = [9.0, 1.0, 0.0], [0.870, 1.375, 0.0]  # set_point, gain, relief; PI: 426 veh, kp 1.1 over u from 0.1 to 0.9
INTEGRAL = 0.4725  # ki 0.0042 in intervals of 90 s
LEVEL = 1.3  # critical accumulations above which trips wait
CELLS = {  # name: (strategy, numbers or None)
    "metering": (f"route-guidance{OVER}+metering", None),
    "gate": (f"pi-gating+guided{OVER}", None),
    "gate-metering": (f"pi-gating+guided{OVER}+metering", None),
    "rule": (f"pricing-rule{OVER}", [*OPEN, *RULE, LEVEL]),
    "rule-metering": (f"pricing-rule{OVER}+metering", [*OPEN, *RULE, LEVEL]),
    "rule-gate-metering": (f"pricing-rule{OVER}+metering", [*PI, *RULE, LEVEL, INTEGRAL]),
    "dpc": (f"pricing-rule{OVER}", [*OPEN, *DPC, 1.2]),
    "dpc-metering": (f"dpc-pcrg{OVER}+metering", None),
    "dpc-gate-metering": (f"pricing-rule{OVER}+metering", [*PI, *DPC, 1.2, INTEGRAL]),
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
        command = [sys.executable, "-m", "cosim", "evaluate", "grid7_peak", "--controllers", strategy]
        command += ["--demand", demand, "--first-seed", str(first_seed), "--seeds", str(seeds)]
        command += ["--workers", str(workers), "--out", str(out / cell)]
        if numbers is not None:
            command += ["--set", f'controllers."{strategy}".numbers={numbers}']
        subprocess.run(command, check=True)
    runs = [pd.read_csv(table).assign(cell=table.parent.name) for table in sorted(out.glob("*/runs.csv"))]
    pd.concat(runs).to_csv(out / "ablation.csv", index=False)


if __name__ == "__main__":
    main()

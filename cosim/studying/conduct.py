"""Conduct of a study, from a SUMO configuration to one page."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from cosim.studying import page, stages
from cosim.studying.page import Study
from cosim.studying.stages import AT_CRITICAL, EVERYWHERE, Level, Runner
from nmfd.api import load_scenario
from nmfd.errors import InputError
from nmfd.runs.files import file_name, write_text
from nmfd.runs.run_many import locked

ABOUT = "study.json"


def conducted(
    source: Path,
    *,
    regions: str,
    routes: Sequence[Path],
    counts: Path | None,
    most_seeds: int,
    out: Path | None,
    workers: int,
) -> Study:
    """Do what is not done, and write the page; see `cosim.api.study`."""
    own = source.is_file()
    name = source.name.partition(".")[0]
    folder = out or Path("runs") / f"{file_name(name)}-study"
    about = {
        "source": str(source.absolute()) if own else str(source),
        "regions": regions,
        "routes": ",".join(str(path.absolute()) for path in routes),
        "counts": "" if counts is None else str(counts.absolute()),
    }
    _check_folder(folder, about)
    if own:
        scenario = stages.imported(source, folder, regions, routes, counts)
    else:
        scenario = load_scenario(source)
    runner = Runner(scenario=scenario, out=folder / "runs", workers=workers)
    try:
        with locked(runner.out):
            write_text(folder / ABOUT, json.dumps(about, indent=1) + "\n")
            load = stages.loading(runner)
            found = stages.gates(runner, load, own=own)
            runner = replace(runner, scenario=found.scenario)
            demands = sorted({1.0, load.under})
            levels = judged_levels(runner, demands, found.reason, most_seeds, trained=own)
            place = str(source)
            if own:
                place = str(folder / "scenarios" / found.scenario.name)
            finished = Study(
                source=str(source),
                place=place,
                scenario=found.scenario,
                load=load,
                levels=tuple(levels),
                out=folder,
            )
            page.write(finished)
    except KeyboardInterrupt:
        remedy = f"the same command with --out {folder} goes on"
        raise KeyboardInterrupt(f"finished runs are in {folder}; {remedy}") from None
    return finished


def judged_levels(
    runner: Runner, demands: Sequence[float], no_gates: str, most_seeds: int, *, trained: bool
) -> list[Level]:
    """Judge the strategies at demand levels.

    demands: of finished loading runs
    no_gates: why gates are left out, "" if they are not
    trained: a policy for the gates is trained, if they may close
    """
    if trained and not no_gates:
        far = [stages.far_from_critical(runner, level) for level in demands]
        if not all(far):
            stages.train_gates(runner.scenario)
    skipped = runner.impossible()
    return [_level(runner, level, no_gates, skipped, most_seeds) for level in demands]


def _level(
    runner: Runner, level: float, no_gates: str, impossible: Mapping[str, str], most_seeds: int
) -> Level:
    """Judge the strategies that may change something at a demand level."""
    skipped = dict(impossible)
    reason = no_gates or stages.far_from_critical(runner, level)
    if reason:
        skipped |= dict.fromkeys(AT_CRITICAL, reason)
    names = [name for name in (*EVERYWHERE, *AT_CRITICAL) if name not in skipped]
    return stages.level_of(runner, level, names, skipped, most_seeds)


def _check_folder(folder: Path, about: Mapping[str, str]) -> None:
    """Raise InputError if a folder holds another study."""
    file = folder / ABOUT
    if not file.is_file():
        return
    kept = json.loads(file.read_text(encoding="utf-8"))
    changed = [key for key, value in about.items() if kept.get(key, "") != value]
    if changed:
        problem = f"holds another study ({', '.join(changed)} changed)"
        raise InputError(f"{folder}: {problem}; choose another folder with --out")

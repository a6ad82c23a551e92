"""Streets, signals and static routes of a city, and their file."""

from dataclasses import dataclass, fields
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from nmfd.errors import InputError
from nmfd.runs.files import atomic

LINKS = "links"  # name of the plant
FILE = "links.npz"  # in the folder of a scenario


@dataclass(frozen=True, kw_only=True)
class LinkNetwork:
    """A city of L links, sorted by length.

    A link is a group of lanes of one street that share movements. A movement leads from a link to
    another street, a turn to a link of that street. An entry is a link with a destination region, a
    cell is a turn with one: vehicles are counted by these. All numbers are places in other arrays.
    Shares are those of D draws of trips: each locks at another demand, and their mean later. As
    recorded trips begin elsewhere at other times, a draw has shares for each of K periods, the last
    without an end: row d K + k is draw d in period k.

    regions: number of regions
    periods, period: number K of periods, and their length (s)
    numbers: calibration (flows.Numbers, in their order)
    spacing, headway: of the average vehicle in a queue (m), and the least time it keeps (s)
    dawdling, acceleration: what it drives below the limit (m/s), and as it starts (m/s2)
    street: names of the links' streets (L,)
    length, behind: of each link, and of the ways over the junction behind it (m, (L,))
    limit: speed limit of each link (m/s, (L,))
    stopped: share of the time in which a bus that stops blocks a lane of each link (-, (L,))
    free_time: in free flow over both (s, (L,))
    region: of each link (L,)
    lane_link: link of each lane (N,)
    movement_link: link that each movement leaves (M,)
    speed: on the junction (m/s, (M,))
    turn_movement, turn_link: movement of each turn, and the link that it enters (T,)
    served, server: pairs of a turn and a lane that leads there (P,)
    first, last: mean share of each link that trips drive which begin, and end there (-, (L,))
    entry_link, destination: of each entry (E,), sorted by free_time
    ending: share of the vehicles of each entry whose trip ends in the link (D K, E)
    origin: share of the trips from the link's region to the destination that begin here (D K, E)
    cell_turn, cell_entry, cell_onward: turn of each cell, entry it leaves, entry it enters (C,)
    cell_share: share of the vehicles of its entry, of those whose trip goes on (D K, C)
    yielding, foe: pairs of a movement that gives way and the one that it gives way to (F,)
    cycle: length of each movement's programme (s) (M,)
    begin: place of its first second in `light` and `yields` (M,)
    light: capacity in each second of the programmes, as a share of the saturation flow
    yields: 1 if the movement must give way in that second, else 0
    gated: True for movements over boundaries whose green commands limit (M,)

    Of the S signals whose stages can be chosen, with at most n stages:

    signal: of each movement, -1 for one that keeps its programme (M,)
    stages: number of stages of each signal (S,)
    stage_light, stage_yields: of each movement in each stage of its signal (M, n)
    stage_loss: time between two stages (s, (S, n, n))
    stage_least: least green of each stage (s, (S, n))
    pressure_movement, pressure_link, pressure_weight: vehicles on the link press, times the
        weight, for the movement (any number of them)
    gain_stage, gain_movement, gain: share of this pressure that the stage serves, a place in
        (S, n) (any number of them)
    phases: number of phases of each signal (S,), with at most p phases
    phase_second: second of the programme in which each phase begins (S, p)
    phase_least, phase_most: limits of each phase where the signal is actuated (s, (S, p)); the
        signal keeps its programme if all of them are equal
    detector: distance from the detectors of each link to the stop line (m, (L,))
    detected, detecting: link on whose detectors a vehicle extends a phase, and the phase, a place
        in (S, p) (any number of them)
    """

    regions: int
    periods: int
    period: float
    numbers: np.ndarray
    spacing: float
    headway: float
    dawdling: float
    acceleration: float
    street: np.ndarray
    length: np.ndarray
    behind: np.ndarray
    limit: np.ndarray
    stopped: np.ndarray
    free_time: np.ndarray
    region: np.ndarray
    lane_link: np.ndarray
    movement_link: np.ndarray
    speed: np.ndarray
    served: np.ndarray
    server: np.ndarray
    turn_movement: np.ndarray
    turn_link: np.ndarray
    first: np.ndarray
    last: np.ndarray
    entry_link: np.ndarray
    destination: np.ndarray
    ending: np.ndarray
    origin: np.ndarray
    cell_turn: np.ndarray
    cell_entry: np.ndarray
    cell_onward: np.ndarray
    cell_share: np.ndarray
    yielding: np.ndarray
    foe: np.ndarray
    cycle: np.ndarray
    begin: np.ndarray
    light: np.ndarray
    yields: np.ndarray
    gated: np.ndarray
    signal: np.ndarray
    stages: np.ndarray
    stage_light: np.ndarray
    stage_yields: np.ndarray
    stage_loss: np.ndarray
    stage_least: np.ndarray
    pressure_movement: np.ndarray
    pressure_link: np.ndarray
    pressure_weight: np.ndarray
    gain_stage: np.ndarray
    gain_movement: np.ndarray
    gain: np.ndarray
    phases: np.ndarray
    phase_second: np.ndarray
    phase_least: np.ndarray
    phase_most: np.ndarray
    detector: np.ndarray
    detected: np.ndarray
    detecting: np.ndarray

    def write(self, path: Path) -> None:
        """Write the arrays to the .npz file `path`, whole or not at all."""
        arrays = {field.name: getattr(self, field.name) for field in fields(self)}
        with atomic(path) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, **arrays)


def read_links(path: Path) -> LinkNetwork:
    """Return the network in the file `path`.

    Raises: InputError if the file is missing or no network of this version
    """
    remedy = "write it with 'cosim links'"
    try:
        with np.load(path) as file:
            arrays = {field.name: file[field.name] for field in fields(LinkNetwork)}
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; {remedy}") from None
    except (OSError, KeyError, ValueError, BadZipFile) as error:
        raise InputError(f"{path}: is no network of links ({error}); {remedy}") from None
    for name in ("regions", "periods", "period", "spacing", "headway", "dawdling", "acceleration"):
        arrays[name] = arrays[name].item()
    return LinkNetwork(**arrays)

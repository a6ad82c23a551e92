"""Loops of SUMO as if they were those of a real city: tables as UTD19 has them, of a city whose truth is known.

python tests/sumo_loops.py FOLDER SEED ...    # a day of grid7_peak per seed; what `nmfd identify` makes of them
"""

import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd

import nmfd
from cosim.evaluation.run_metrics import regional_outflow
from cosim.evaluation.simulate import drive
from cosim.plant.settings import settings
from cosim.sumo.net import City, city_of, edge_shapes
from nmfd.api import controller
from nmfd.controllers.strategy import parse
from nmfd.model import mfd
from nmfd.model.scenario import Scenario
from nmfd.runs.tables import text_table

LENGTH = 5.0  # m, of SUMO's vehicles; its loops have none
STOP_LINE = 8.0  # m before the junction
MIDDLE, AT_STOP_LINE = "middle", "stop line"


@dataclass(frozen=True, kw_only=True)
class Truth:
    """By day and period: accumulation (D, K, R) [veh], production [veh m/s] and outflow [veh/s]; lane_km (R,)."""

    accumulation: np.ndarray
    production: np.ndarray
    outflow: np.ndarray
    lane_km: np.ndarray

    @property
    def trip_length(self) -> np.ndarray:
        """(R,) [m]"""
        return self.production.sum(axis=(0, 1)) / self.outflow.sum(axis=(0, 1))


def simulated(
    scenario: Scenario, folder: Path, seeds: Sequence[int], intervals: int
) -> tuple[pd.DataFrame, pd.DataFrame, Truth]:
    """(counts, detectors, the truth) of a day per seed without control; counts over so many control intervals.

    Two loops on every lane: somewhere along it (MIDDLE, drawn by lot), and at the stop line. Days are kept in `folder`.
    """
    city = city_of(scenario.network)
    detectors, period = _detectors(city, np.random.default_rng(0)), intervals * scenario.step
    days, truths = [], []
    for seed in seeds:
        kept = folder / f"day-{seed}.pkl"
        if kept.exists():
            counts, truth = pd.read_pickle(kept)
            days.append(counts)
            truths.append(truth)
            continue
        additional, output = folder / f"loops-{seed}.add.xml", folder / f"loops-{seed}.xml"
        additional.write_text(
            "<additional>\n"
            + "".join(
                f'  <inductionLoop id="{row.detid}" lane="{row.lane}" pos="{row.along:.2f}" period="{period:g}" '
                f'file="{output}"/>\n'
                for row in detectors.itertuples()
            )
            + "</additional>\n"
        )
        strategy = parse("no-control")
        strategy = replace(
            strategy, overrides={**strategy.overrides, "additional": (*settings(scenario).additional, str(additional))}
        )
        edges = folder / f"edges-{seed}.xml"
        result = drive(scenario, strategy, controller("no-control", scenario), seed=seed, outputs={"edgedata": edges})
        days.append(_counts(output, f"2026-06-{seed + 1:02d}", scenario.steps // intervals * period))
        truths.append(
            [
                np.asarray(values)[: scenario.steps // intervals * intervals]
                .reshape(-1, intervals, city.regions)
                .mean(axis=1)
                for values in (
                    result["mean_accumulation"],
                    _production(edges, city, scenario),
                    regional_outflow(result, scenario.step),
                )
            ]
        )
        pd.to_pickle((days[-1], truths[-1]), kept)
    region = np.array([city.region_of[edge] for edge in city.edges])
    lane_km = np.bincount(region, [city.length[edge] * city.lanes[edge] / 1000.0 for edge in city.edges], city.regions)
    accumulation, production, outflow = (np.stack(part) for part in zip(*truths, strict=True))
    return (
        pd.concat(days, ignore_index=True),
        detectors,
        Truth(accumulation=accumulation, production=production, outflow=outflow, lane_km=lane_km),
    )


def _detectors(city: City, random: np.random.Generator) -> pd.DataFrame:
    """One row per loop: the columns of UTD19, x and y, region, and place, lane and along [m] of SUMO."""
    rows = []
    for edge, shape in zip(city.edges, edge_shapes(city), strict=True):
        length = city.length[edge]
        places = {MIDDLE: random.uniform(0.1, 0.9) * length, AT_STOP_LINE: max(length - STOP_LINE, 0.5 * length)}
        for place, along in places.items():
            x, y = shape[0] + along / length * (shape[-1] - shape[0])
            for lane in city.lane_ids[edge]:
                rows.append(
                    {
                        "detid": f"{lane}-{place.split()[0]}",
                        "length": length / 1000.0,
                        "pos": (length - along) / 1000.0,
                        "lanes": 1,
                        "linkid": edge,
                        "x": round(x, 1),
                        "y": round(y, 1),
                        "region": city.region_of[edge],
                        "place": place,
                        "lane": lane,
                        "along": along,
                    }
                )
    return pd.DataFrame(rows)


def _production(output: Path, city: City, scenario: Scenario) -> np.ndarray:
    """(T, R) [veh m/s] of every control interval: what SUMO itself adds up of every vehicle (edgeData)."""
    found: list[np.ndarray] = []
    for event, element in ElementTree.iterparse(output, events=("start", "end")):
        if event == "start" and element.tag == "interval":
            found.append(np.zeros(city.regions))
        elif event == "end" and element.tag == "edge" and element.get("id") in city.length:
            found[-1][city.region_of[element.attrib["id"]]] += (
                float(element.get("sampledSeconds", 0.0)) * float(element.get("speed", 0.0)) / scenario.step
            )
    rows = np.zeros((scenario.steps, city.regions))
    rows[: len(found)] = found[: scenario.steps]  # SUMO ends where nothing moves any more
    return rows


def _counts(output: Path, day: str, end: float) -> pd.DataFrame:
    """The output of the loops as UTD19 has it."""
    rows = [dict(element.attrib) for _, element in ElementTree.iterparse(output) if element.tag == "interval"]
    table = pd.DataFrame(rows).astype({name: float for name in ("begin", "end", "flow", "occupancy")})
    table[["begin", "end"]] -= table["begin"].min()  # a city may begin at any time of the day
    table = table[table["end"] <= end]
    return pd.DataFrame(
        {
            "day": day,
            "interval": table["begin"],
            "detid": table["id"],
            "flow": table["flow"],
            "occ": (table["occupancy"] / 100.0).clip(upper=1.0),
            "error": 0,
            "city": "grid7",
        }
    )


def case(
    folder: Path,
    counts: pd.DataFrame,
    detectors: pd.DataFrame,
    truth: Truth,
    *,
    place: str = MIDDLE,
    share: float = 1.0,
    told: bool = True,
) -> nmfd.Identified:
    """What nmfd makes of the loops at one `place`, on a `share` of the links of every region. told: lane_km and trip
    length of the regions; else both are assumed."""
    folder.mkdir(parents=True, exist_ok=True)
    links = detectors.drop_duplicates("linkid")
    chosen = links.groupby("region")["linkid"].apply(lambda part: part.sample(frac=share, random_state=1))
    used = detectors[(detectors["place"] == place) & detectors["linkid"].isin(chosen)]
    counts[counts["detid"].isin(used["detid"])].to_csv(folder / "counts.csv", index=False)
    used.drop(columns=["place", "lane", "along"]).to_csv(folder / "detectors.csv", index=False)
    about = {"region": range(len(truth.lane_km)), "lane_km": truth.lane_km, "trip_length": truth.trip_length}
    pd.DataFrame(about).to_csv(folder / "about.csv", index=False)
    return nmfd.identify(
        folder / "counts.csv",
        detectors=folder / "detectors.csv",
        about=folder / "about.csv" if told else None,
        out=folder / "network",
        vehicle_length=LENGTH,
        force=True,
    )


def errors(found: nmfd.Identified, truth: Truth) -> dict[str, float]:
    """Means over the regions: RMSE and bias of the accumulation, bias of production, RMSE of the outflow; that of the
    curve, against one fitted to the true outflow, over the accumulations seen; of its critical accumulation and
    maximum. All as shares of the true mean, the last three of the true curve's own."""
    table = found.to_frame()
    shape = truth.accumulation.shape
    values = {
        name: np.stack(
            [
                table[table["region"] == region].sort_values(["day", "interval"])[name].to_numpy().reshape(shape[:2])
                for region in found.network.region_names
            ],
            axis=-1,
        )
        for name in ("accumulation_veh", "production_veh_km_h", "outflow_veh_s")
    }
    wrong = values["accumulation_veh"] - truth.accumulation
    mean, out = truth.accumulation.mean(axis=(0, 1)), truth.outflow.mean(axis=(0, 1))
    curves = [mfd.fit(truth.accumulation[..., r].ravel(), truth.outflow[..., r].ravel()) for r in range(shape[2])]
    grids = [np.linspace(1.0, truth.accumulation[..., r].max(), 200) for r in range(shape[2])]
    pairs = list(zip(found.network.mfds, curves, grids, strict=True))
    return {
        "accumulation RMSE": float((np.sqrt((wrong**2).mean(axis=(0, 1))) / mean).mean()),
        "accumulation bias": float((wrong.mean(axis=(0, 1)) / mean).mean()),
        "production bias": float(
            (values["production_veh_km_h"].sum((0, 1)) / 3.6 / truth.production.sum((0, 1)) - 1).mean()
        ),
        "outflow RMSE": float(
            (np.sqrt(((values["outflow_veh_s"] - truth.outflow) ** 2).mean(axis=(0, 1))) / out).mean()
        ),
        "curve RMSE": float(
            np.mean(
                [np.sqrt(((own.outflow(x) - true.outflow(x)) ** 2).mean()) / true.capacity for own, true, x in pairs]
            )
        ),
        "critical": float(np.mean([abs(own.critical / true.critical - 1.0) for own, true, _ in pairs])),
        "maximum": float(np.mean([abs(own.capacity / true.capacity - 1.0) for own, true, _ in pairs])),
    }


def main(folder: Path, *seeds: str) -> None:
    """Days of grid7_peak, counts every three minutes."""
    folder.mkdir(parents=True, exist_ok=True)
    counts, detectors, truth = simulated(
        nmfd.load_scenario("scenarios/grid7_peak"), folder, [int(seed) for seed in seeds], 2
    )
    lines = []
    for place, share, told in (
        (MIDDLE, 1.0, True),
        (MIDDLE, 0.3, True),
        (MIDDLE, 0.1, True),
        (AT_STOP_LINE, 1.0, True),
        (AT_STOP_LINE, 0.3, True),
        (MIDDLE, 1.0, False),
        (MIDDLE, 0.3, False),
    ):
        name = f"{place}, {100 * share:g} % of the links" + ("" if told else ", length of streets and trips assumed")
        found = case(folder / name.replace(" ", "-"), counts, detectors, truth, place=place, share=share, told=told)
        lines.append({"loops": name, **{key: f"{100 * value:.0f} %" for key, value in errors(found, truth).items()}})
    print(text_table(lines))


if __name__ == "__main__":
    main(Path(sys.argv[1]), *sys.argv[2:])

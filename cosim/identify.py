"""Loading runs -> MFD samples -> fitted MFDs and the drivers' own split ratios -> network.toml."""

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from cosim import experiment
from cosim.compare import HELD_UP, draw_mfds, outflow_samples
from cosim.simulate import Result, Task
from nmfd import mfd, runs, toml
from nmfd.errors import InputError
from nmfd.network import Network
from nmfd.scenario import load_scenario

FEWEST = 30.0  # vehicles that must have crossed before their split ratios count


def identify(
    scenario: Path, levels: Sequence[float], seeds: Sequence[int], *, out: Path, workers: int = 1,
    progress: Callable[[int, int, str], None] | None = None,
) -> str:
    """Load the city of `scenario` with `levels` times its demand under no control, fit, and write its network.toml.

    Samples, pictures and the loading runs go to `out`, one run folder per level. Returns the fit as a table. Raises
    InputError for a network that does not come from a folder, RunFailed if a loading run failed.
    """
    loaded = load_scenario(scenario)
    results: list[Result] = []
    for n, level in enumerate(levels):
        def tell(done, total, note, before=n, level=level):
            progress((before * total + done), len(levels) * total, f"{level:g} times the demand")

        folder = out / f"level-{level:g}"
        tasks = [
            Task(scenario=scenario, controller="no-control", seed=seed, demand_factor=level) for seed in seeds]
        experiment.experiment(tasks, out=folder, workers=workers, progress=tell if progress else None)
        results += [experiment.read_run(folder, "no-control", seed) for seed in seeds]
    network = loaded.network
    samples = [
        outflow_samples(
            [r.trajectory for r in results], [r.record for r in results], network.u_max, region, network.adjacency)
        for region in range(network.regions)]
    fitted = replace(
        network, mfds=tuple(_fit(cloud, loaded.step / loaded.substeps) for cloud in samples),
        own_splits=own_splits(network, [r.record for r in results]))
    _write_samples(out / "samples.csv", samples)
    draw_mfds(out / "mfd.png", fitted, samples)
    runs.write_text(
        network.folder / "network.toml", network_toml(
            fitted, network.folder / "network.toml",
            f"MFDs and own splits: written by cosim identify from {len(results)} loading runs of {loaded.name},\n"
            f"# demand times {', '.join(f'{level:g}' for level in levels)}, seeds {min(seeds)} to {max(seeds)}."))
    return fit_table(fitted, samples)


def _fit(cloud: dict[str, np.ndarray], step: float) -> mfd.Mfd:
    points = own_points(cloud)
    if len(points) < 10:
        raise InputError(
            "--levels: a region was nearly empty in all loading runs; give higher levels, or a scenario that uses it")
    return mfd.fit(points[:, 0], points[:, 1], max_rate=1.0 / step)


def own_points(cloud: dict[str, np.ndarray]) -> np.ndarray:
    """(n, 2): the samples that the region's own MFD explains."""
    return np.concatenate([points for label, points in cloud.items() if label != HELD_UP])


def own_splits(network: Network, records: Sequence[dict]) -> dict[tuple[int, int], dict[int, float]]:
    """(i, j) -> {h: share}: by which neighbour h the vehicles in i bound for j went on in fact."""
    crossings = sum(record["crossings"].sum(axis=0) for record in records) * network.split_mask
    found = {}
    for i, j in np.argwhere(crossings.sum(axis=1) >= FEWEST):
        shares = crossings[i, :, j] / crossings[i, :, j].sum()
        kept = {int(h): round(float(shares[h]), 4) for h in np.flatnonzero(shares >= 0.005)}
        found[int(i), int(j)] = {h: share / sum(kept.values()) for h, share in kept.items()}
    return found


def fit_table(network: Network, samples: Sequence[dict]) -> str:
    """Per region: critical and jam accumulation, maximum outflow, samples, and how well the curve explains them."""
    lines = [f"{'region':<16}{'critical':>10}{'jam':>8}{'max outflow':>13}{'samples':>9}{'R2':>7}   [veh, veh/s]"]
    for region, (curve, cloud) in enumerate(zip(network.mfds, samples, strict=True)):
        points = own_points(cloud)
        residual = points[:, 1] - curve.outflow(points[:, 0])
        explained = 1.0 - residual.var() / points[:, 1].var()
        name = f"{region} {network.region_names[region]}"
        lines.append(
            f"{name:<16}{curve.critical:>10.0f}{curve.jam:>8.0f}{curve.capacity:>13.3f}{len(points):>9}"
            f"{explained:>7.2f}")
    return "\n".join(lines)


def network_toml(network: Network, path: Path, comment: str) -> str:
    """network.toml of `network`, with the table [sumo] of the one at `path`."""
    return render_network(network, toml.read(path).raw_table("sumo"), comment)


def render_network(network: Network, sumo: Mapping[str, str], comment: str) -> str:
    """network.toml of `network`, with the table [sumo] given."""
    out = io.StringIO()
    out.write(f"# {comment}\nname = \"{network.name}\"\n\n")
    out.write(f"[perimeter]\nmin = {network.u_min:g}\nmax = {network.u_max:g}\n")
    if sumo:
        out.write("\n[sumo]\n" + "".join(f'{key} = "{value}"\n' for key, value in sumo.items()))
    for region in range(network.regions):
        x, y = network.positions[region]
        either = network.adjacency | network.adjacency.T
        neighbours = ", ".join(str(h) for h in np.flatnonzero(either[region]))
        one_way = ", ".join(str(h) for h in np.flatnonzero((either & ~network.adjacency)[region]))
        barred = f"no_way_to = [{one_way}]\n" if one_way else ""
        curve = network.mfds[region]
        out.write(
            f'\n[[regions]]\nname = "{network.region_names[region]}"\nposition = [{x:.6g}, {y:.6g}]\n'
            f"adjacent = [{neighbours}]\n{barred}\n[regions.mfd]\na = {curve.a:.6g}\nb = {curve.b:.6g}\n"
            f"c = {curve.c:.6g}\njam = {curve.jam:.6g}\n")
    for (i, j), shares in sorted(network.own_splits.items()):
        via = ", ".join(str(h) for h in shares)
        share = ", ".join(f"{value:.4f}" for value in shares.values())
        out.write(f"\n[[own_splits]]\nregion = {i}\ndestination = {j}\nnext = [{via}]\nshare = [{share}]\n")
    return out.getvalue()


def _write_samples(path: Path, samples: Sequence[dict]) -> None:
    with runs.atomic(path) as temporary, temporary.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["region", "branch", "accumulation_veh", "outflow_veh_s"])
        for region, cloud in enumerate(samples):
            for branch, points in cloud.items():
                writer.writerows([region, branch, f"{x:.1f}", f"{g:.5f}"] for x, g in points)

"""network.toml of a regional model, as text; `nmfd.model.regional_model.load_network` reads it."""

import io
import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from nmfd.model.regional_model import RegionalModel
from nmfd.runs.config import quoted


def schema_line(folder: Path) -> str:
    """The line by which editors find the JSON schema of a network.toml in `folder`; "" where there is none above it."""
    above = (parent / "network.schema.json" for parent in folder.absolute().parents)
    found = next((file for file in above if file.is_file()), None)
    return f"#:schema {Path(os.path.relpath(found, folder)).as_posix()}\n" if found else ""


def network_toml(network: RegionalModel, sumo: Mapping[str, str], comment: str) -> str:
    """network.toml of `network` with this table [sumo]."""
    out = io.StringIO()
    out.write(f"# {comment}\nname = {quoted(network.name)}\n")
    out.write("placeholder = true\n\n" if network.placeholder else "\n")
    out.write(f"[perimeter]\nmin = {network.u_min:g}\nmax = {network.u_max:g}\n")
    if network.disturbance is not None:
        law = network.disturbance._asdict().items()
        out.write("\n[disturbance]\n" + "".join(f"{key} = {value:.4g}\n" for key, value in law))
    if sumo:
        out.write("\n[sumo]\n" + "".join(f"{key} = {quoted(value)}\n" for key, value in sumo.items()))
    for region in range(network.regions):
        x, y = network.positions[region]
        adjacent = np.flatnonzero((network.adjacency | network.adjacency.T)[region])
        one_way = ", ".join(str(h) for h in adjacent if not network.adjacency[region, h])
        barred = f"no_way_to = [{one_way}]\n" if one_way else ""
        neighbours = ", ".join(str(h) for h in adjacent)
        curve = network.mfds[region]
        out.write(
            f"\n[[regions]]\nname = {quoted(network.region_names[region])}\nposition = [{x:.6g}, {y:.6g}]\n"
            f"adjacent = [{neighbours}]\n{barred}{_options(network, region)}\n"
            f"[regions.mfd]\na = {curve.a:.6g}\nb = {curve.b:.6g}\nc = {curve.c:.6g}\n"
            f"jam = {curve.jam:.6g}\n"
        )
    for (i, j), shares in sorted(network.observed_split_ratios.items()):
        via = ", ".join(str(h) for h in shares)
        share = ", ".join(f"{value:.4f}" for value in shares.values())
        out.write(f"\n[[observed_split_ratios]]\nregion = {i}\ndestination = {j}\nnext = [{via}]\nshare = [{share}]\n")
    return out.getvalue()


def _options(network: RegionalModel, region: int) -> str:
    """What the network has of one region beside its MFD."""
    lines = ""
    if network.exit_rates is not None:
        lines += f"exit_rates = [{', '.join(f'{value:.4g}' for value in network.exit_rates[region])}]\n"
    if network.capacity is not None and network.storage is not None:
        passing = network.capacity[region, network.adjacency[region]]
        lines += (
            f"capacity = [{', '.join(f'{value:.4g}' for value in passing)}]\nstorage = {network.storage[region]:.6g}\n"
        )
    if network.controllable is not None:
        shares = network.controllable[region, network.adjacency[region]]
        lines += f"controllable = [{', '.join(f'{value:.4g}' for value in shares)}]\n"
    if network.doubts and network.doubts[region]:
        lines += f"doubts = [{', '.join(map(quoted, network.doubts[region]))}]\n"
    return lines

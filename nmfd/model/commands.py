"""Check of the commands of a controller before a plant sees them."""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from nmfd.errors import InputError
from nmfd.model.regional_model import RegionalModel
from nmfd.types import Controls

TOLERANCE = 1e-6  # of bounds: rounding errors of float32, which are left as they are
SUM_TOLERANCE = 1e-3  # of the sums of splits
ROUNDING = 1e-12  # of sums in float64, which are left as they are
LARGEST_PRICE = 100.0  # -
LARGEST_RATE_VEH_S = 1e6  # of metering: as good as no limit


def admissible(controls: object, network: RegionalModel, where: str) -> Controls:
    """Return a copy of `controls` as float64, with splits that sum to 1.

    Bounds may be missed by rounding errors.

    controls: command of a controller, not yet checked
    where: begins the error, such as "pi-gating: interval 3"
    Raises: InputError for a wrong type, shape or value, with entry and bounds
    """
    if not isinstance(controls, Controls):
        got = type(controls).__name__
        raise InputError(
            f"{where}: expected nmfd.Controls, got {got} instead; return nmfd.Controls(perimeter=u)"
        )
    gates = network.adjacency
    low = np.where(gates, network.u_min, -np.inf)
    high = np.where(gates, network.u_max, np.inf)
    perimeter = within(controls.perimeter, low, high, f"{where}: perimeter")
    return replace(
        controls,
        perimeter=np.where(gates, perimeter, 0.0),
        splits=_splits(controls.splits, network, f"{where}: splits"),
        prices=_up_to(controls.prices, LARGEST_PRICE, network, f"{where}: prices"),
        metering=_up_to(controls.metering, LARGEST_RATE_VEH_S, network, f"{where}: metering"),
    )


def rounded(controls: object, network: RegionalModel, where: str) -> Controls:
    """Return `admissible` controls without rounding errors.

    Those of a user's own file may come from float32.
    """
    command = admissible(controls, network, where)
    within_bounds = np.clip(command.perimeter, network.u_min, network.u_max)
    perimeter = np.where(network.adjacency, within_bounds, 0.0)
    splits = command.splits
    if splits is not None:
        splits = np.clip(splits, 0.0, network.split_mask)
        sums = splits.sum(axis=1)
        splits = splits / np.where(sums > 0.0, sums, 1.0)[:, None, :]
    return replace(command, perimeter=perimeter, splits=splits)


def _splits(splits: ArrayLike | None, network: RegionalModel, where: str) -> np.ndarray | None:
    if splits is None:
        return None
    allowed = network.split_mask
    shares = within(splits, np.zeros(allowed.shape), allowed.astype(float), where)
    sums = shares.sum(axis=1)
    needed = allowed.any(axis=1)
    wrong = np.argwhere(needed & (abs(sums - 1.0) > SUM_TOLERANCE))
    if len(wrong):
        i, j = wrong[0].tolist()
        raise InputError(
            f"{where}: expected a sum of 1 over h, got {sums[i, j]:g} for [i, j] = [{i}, {j}] "
            "instead"
        )
    scale = np.where(needed & (abs(sums - 1.0) > ROUNDING), sums, 1.0)
    return shares / scale[:, None, :]


def _up_to(
    values: ArrayLike | None, most: float, network: RegionalModel, where: str
) -> np.ndarray | None:
    if values is None:
        return None
    zeros = np.zeros(network.regions)
    return np.clip(within(values, zeros, zeros + most, where), 0.0, most)


def within(values: ArrayLike, low: np.ndarray, high: np.ndarray, where: str) -> np.ndarray:
    """Return `values` as an array, which lies between `low` and `high`.

    Raises: InputError if the shape is another, or if bounds are missed by more than rounding errors
    """
    try:
        array = np.array(values, dtype=float)
    except (TypeError, ValueError, RuntimeError) as error:  # RuntimeError: a tensor with a gradient
        raise InputError(f"{where}: expected numbers of shape {low.shape} ({error})") from None
    if array.shape != low.shape:
        raise InputError(f"{where}: expected numbers of shape {low.shape}, got shape {array.shape}")
    finite = np.isfinite(array)
    inside = (array >= low - TOLERANCE) & (array <= high + TOLERANCE) & finite
    if not inside.all():
        entry = tuple(np.argwhere(~inside)[0].tolist())
        allowed = f"{low[entry]:g} to {high[entry]:g}" if finite[entry] else "a finite number"
        raise InputError(f"{where}{list(entry)}: expected {allowed}, got {array[entry]:g} instead")
    return array

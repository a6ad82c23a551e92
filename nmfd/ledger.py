"""Vehicle ledger: entered = ended + inside, checked in every plant at every step."""

import math

TOLERANCE_SHARE, TOLERANCE_VEH = 1e-9, 1e-6  # of the vehicles that entered, and absolute: rounding


class LedgerError(RuntimeError):
    """Vehicles appeared or vanished: the run stops."""


def check(
    step: int, time: float, *, entered: float, ended: float, inside: float, least: float = 0.0
) -> None:
    """Raise LedgerError unless entered = ended + inside [veh] and no accumulation is negative.

    step: control step; time: at its end (s); ended: an independent count; least: smallest
        accumulation of any region
    and destination [veh]
    """
    surplus, allowed = inside + ended - entered, TOLERANCE_VEH + TOLERANCE_SHARE * entered
    where = f"vehicle ledger broken at control step {step}, {time:g} s"
    if not (math.isfinite(surplus) and abs(surplus) <= allowed):
        raise LedgerError(
            f"{where}: {entered:.6f} vehicles entered, {ended:.6f} ended their trips and {inside:.6f} are inside, "
            f"{surplus:+.6g} of them from nowhere"
        )
    if not least >= -allowed:
        raise LedgerError(f"{where}: an accumulation is {least:.6g} vehicles")

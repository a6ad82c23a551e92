"""The vehicle ledger: who entered has ended their trip or is inside. Always on, in every plant, at every step."""

import math

RELATIVE, ABSOLUTE = 1e-9, 1e-6  # of the vehicles that entered, and veh: what rounding may cost


class LedgerError(RuntimeError):
    """Vehicles appeared or vanished: the figures of this run cannot be trusted, and it stops."""


def check(step: int, time: float, *, entered: float, ended: float, inside: float, least: float = 0.0) -> None:
    """LedgerError unless entered = ended + inside [veh] and no accumulation is negative.

    step: control step; time: at its end [s]; ended: counted on its own, not from the other two; least: the smallest
    accumulation of any region and destination [veh]
    """
    surplus, allowed = inside + ended - entered, ABSOLUTE + RELATIVE * entered
    where = f"vehicle ledger broken at control step {step}, {time:g} s"
    if not (math.isfinite(surplus) and abs(surplus) <= allowed):
        raise LedgerError(
            f"{where}: {entered:.6f} vehicles entered, {ended:.6f} ended their trips and {inside:.6f} are inside, "
            f"{surplus:+.6g} of them from nowhere"
        )
    if not least >= -allowed:
        raise LedgerError(f"{where}: an accumulation is {least:.6g} vehicles")

"""Vehicle ledger: entered = ended + inside.

Every plant checks it at every step.
"""

import math

# Rounding that the ledger allows: of the vehicles that entered [-], and absolute [veh].
TOLERANCE_SHARE = 1e-9
TOLERANCE_VEH = 1e-6


class LedgerError(RuntimeError):
    """Stop of a run in which vehicles appeared or vanished."""


def check(
    step: int, time: float, *, entered: float, ended: float, inside: float, least: float = 0.0
) -> None:
    """Check that no vehicle was lost and that none is negative.

    step: control step
    time: at the end of the step (s)
    entered, inside: vehicles that entered so far, and those inside (veh)
    ended: completed and removed trips, counted independently of the others (veh)
    least: smallest accumulation of any region and destination (veh)

    Raises: LedgerError unless entered = ended + inside and least >= 0, up to rounding
    """
    surplus = inside + ended - entered
    allowed = TOLERANCE_VEH + TOLERANCE_SHARE * entered
    where = f"vehicle ledger broken at control step {step}, {time:g} s"
    balanced = math.isfinite(surplus) and abs(surplus) <= allowed
    if not balanced:
        raise LedgerError(
            f"{where}: {entered:.6f} vehicles entered, {ended:.6f} ended their trips and "
            f"{inside:.6f} are inside, {surplus:+.6g} of them from nowhere"
        )
    if not least >= -allowed:  # NaN too
        raise LedgerError(f"{where}: an accumulation is {least:.6g} vehicles")

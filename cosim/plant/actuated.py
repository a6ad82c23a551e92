"""SUMO's gap-based actuated signals, made of the fixed-time programmes."""

from cosim.sumo.signals import Signal, programme_row

MIN_GREEN, MAX_GREEN = 5.0, 50.0  # s; netconvert's defaults for actuated signals


def actuated_row(signal: Signal) -> str:
    """The tlLogic: every stage ends when no vehicle has come for some seconds (SUMO's defaults), within limits.

    A stage may grow to half as much again as it has in the fixed-time programme: where it is crowded all stages reach
    their limits, and the shares of the green are those of the fixed-time programme.
    """
    limits = {}
    for n in signal.stages:
        fixed = signal.phases[n].duration
        limits[n] = min(MIN_GREEN, fixed), max(min(1.5 * fixed, MAX_GREEN), MIN_GREEN)
    return programme_row(signal, "actuated", limits=limits)

"""The demand level at which a city without control congests: `cosim import --level auto`.

Congested is where driving takes CONGESTED times as long as with LIGHT of the vehicles, which know the signals but no
queues. Levels are tried in SUMO's mesoscopic model, a tenth of the cost, then upwards in that of the scenario.
"""

from collections.abc import Callable

CONGESTED = 1.5  # times the pace of light traffic
LIGHT = 0.1      # of the demand
RATIO = 1.2      # between two levels that are tried: ..., 0.83, 1, 1.2, 1.44, ...
MOST = 6         # levels above and below 1

Pace = Callable[[float, bool], float]


def level(n: int) -> float:
    """The n-th level above 1 [-]; below it for a negative n."""
    return round(RATIO**n, 2)


def congesting(pace: Pace, *, mesoscopic: bool, tell: Callable[[str], None]) -> tuple[float, bool]:
    """(the lowest level tried that congests, True), or (the highest there is, False).

    pace(level, mesoscopic): time that vehicles spend, running and waiting to enter, over what free flow takes [-]
    """
    def congested(n: int, meso: bool, light: float) -> bool:
        tell(f"demand times {level(n):g}{', mesoscopic' if meso else ''}")
        return pace(level(n), meso) >= CONGESTED * light

    light = pace(LIGHT, True) or 1.0  # a tenth of a few vehicles is none
    n = 0
    if congested(n, True, light):
        while n > -MOST and congested(n - 1, True, light):
            n -= 1
    else:
        while n < MOST and not congested(n, True, light):
            n += 1
    if not mesoscopic:
        light = pace(LIGHT, False) or 1.0
    while not congested(n, mesoscopic, light):
        if n == MOST:
            return level(n), False
        n += 1
    return level(n), True

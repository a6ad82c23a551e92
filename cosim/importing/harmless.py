"""What elements of a city's files would do to us: write into its owner's folders, and die before a signal."""

from xml.etree.ElementTree import Element

WRITERS = ("Detector", "Loop", "calibrator", "routeProbe")  # the names of elements that write end so
WRITING = ("file", "has.ssm.device", "device.toc.file")  # parameters that only make SUMO write
PATIENT = ("max", "random", "0", "0.0", "0.00")  # speeds at the departure that can wait for a green


def silent(element: Element) -> Element:
    """The element; what it writes goes nowhere."""
    for part in element.iter():
        if part.tag.endswith(WRITERS):
            for key in {"file", "output"} & set(part.keys()):
                part.set(key, "NUL")
        for parameter in part.findall("param"):
            if parameter.get("key") in WRITING:
                part.remove(parameter)
    return element


def softened(element: Element) -> bool:
    """Whether the vehicle's speed at the departure was fixed, and is now the highest safe one.

    SUMO deletes a vehicle that could not stop from such a speed at a signal whose programme never gives it green, and
    one that is switched from outside, as by perimeter control, has none that does.
    """
    if element.get("departSpeed", "max") in PATIENT:
        return False
    element.set("departSpeed", "max")
    return True

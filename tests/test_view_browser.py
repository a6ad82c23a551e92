"""The page in a browser: slider and region of a report, pause and pace of live runs, names as
text."""

import re
import shutil
import subprocess
import sys
from contextlib import contextmanager

import pytest
import tiny_city
from commands import call, good

from nmfd.studies import plots

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
NAME = "no-control+guided+compliance-100+guidance-period-60"  # wider than a telephone
EVIL = "<script>alert(1)</script>"
DOLLARS = "ü <b>$$x^$$</b>"  # which Bokeh would take as mathematics
DENSITIES = """() => [0, 1].map(n => Array.from(Bokeh.documents[0].get_model_by_name(`map${n}`)
    .renderers.map(one => one.data_source.data).find(data => data.edge).density))"""
NUMBERS = "() => Bokeh.documents[0].get_model_by_name('numbers').text"
PLANE = "() => Bokeh.documents[0].get_model_by_name('plane').title.text.text"
LINES = """() => Bokeh.documents[0].get_model_by_name('trips')
    .renderers.map(one => one.glyph.line_color.value)"""
TIME = "() => Bokeh.documents[0].get_model_by_name('time').value"
RANGES = "() => [0, 1].map(n => Bokeh.documents[0].get_model_by_name(`map${n}`).x_range.end)"
NARROW = "() => document.documentElement.scrollWidth <= window.innerWidth + 1"
pytestmark = [pytest.mark.slow, pytest.mark.skipif(CHROMIUM is None, reason="no browser")]


@pytest.fixture(scope="module")
def scenario(tmp_path_factory):
    path = tiny_city.imported(tmp_path_factory.mktemp("browser")) / "scenario.toml"
    path.write_text(re.sub(r'(?m)^name = ".*"$', f'name = "{EVIL}"', path.read_text(), count=1))
    network = path.parents[2] / "networks" / "tiny" / "network.toml"
    toml = network.read_text()
    for name in re.findall(r'(?m)^name = "(.*)"$', toml)[1:]:
        toml = toml.replace(f'name = "{name}"', f'name = "{name} {DOLLARS}"')
    network.write_text(toml)
    return path.parent


@pytest.fixture(scope="module")
def report(scenario, tmp_path_factory):
    out = tmp_path_factory.mktemp("report") / "run"
    controllers = ("--controller", NAME, "--against no-control")
    good(call("cosim", "run", scenario, *controllers, "--seed 3 --set steps=6 --out", out))
    good(call("cosim", "report", out))
    return out / "report.html"


@contextmanager
def opened(address: str, origin: str, width: int):
    """A page without errors, warnings, dialogs and requests to elsewhere."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page, wrong = browser.new_page(viewport={"width": width, "height": 900}), []
        page.on(
            "console",
            lambda message: message.type in ("error", "warning") and wrong.append(message.text),
        )
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on("dialog", lambda dialog: wrong.append(dialog.message))
        page.on(
            "request",
            lambda one: one.url.startswith((origin, "data:", "blob:")) or wrong.append(one.url),
        )
        page.set_default_timeout(120_000)  # the machine may be busy
        page.goto(address)
        page.wait_for_function("() => window.Bokeh && Bokeh.documents.length")
        yield page
        assert wrong == []
        assert page.evaluate(NARROW)
        browser.close()


@pytest.mark.parametrize("width", [1280, 390])
def test_the_report(report, width):
    with opened(report.as_uri(), "file:", width) as page:
        assert page.locator("h1").inner_text() == f"Traffic control in SUMO: {EVIL}"
        page.locator(".noUi-handle").focus()
        page.keyboard.press("End")
        page.wait_for_timeout(300)
        at_the_end = page.evaluate(DENSITIES)
        for _ in range(3):
            page.keyboard.press("ArrowLeft")
        page.wait_for_timeout(500)
        before = page.evaluate(DENSITIES)
        assert before[0] != at_the_end[0]
        assert before[1] != at_the_end[1]
        page.locator("select").first.select_option(index=1)
        page.wait_for_timeout(300)
        assert page.evaluate(PLANE).startswith("Region 1")
        assert page.evaluate(PLANE).endswith(f"{DOLLARS}: MFD plane")
        page.get_by_role("button", name="Play").click()
        page.wait_for_timeout(2000)
        assert page.evaluate(DENSITIES) == at_the_end
        tones = plots.colours(["no-control", NAME])
        assert page.evaluate(LINES) == [tones["no-control"], tones[NAME]]
        page.locator(".bk-Figure").first.scroll_into_view_if_needed()
        box, before = page.locator(".bk-Figure").first.bounding_box(), page.evaluate(RANGES)
        page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 200)
        page.mouse.wheel(0, -100)
        page.wait_for_timeout(500)
        first, second = page.evaluate(RANGES)
        assert first == second < before[0], "both maps zoom together"
        heat = page.locator(".bk-Figure").nth(2)
        heat.scroll_into_view_if_needed()
        box = heat.bounding_box()
        page.mouse.click(box["x"] + 0.5 * box["width"], box["y"] + 60)
        page.wait_for_timeout(500)
        assert page.evaluate(TIME) == 4.5
        assert 0 <= page.locator(".noUi-handle").bounding_box()["y"] < 200, "the bar stays in view"
        assert page.evaluate("() => document.documentElement.scrollHeight") < (
            3000 if width > 1000 else 5000
        )
        page.locator("summary").first.click()
        assert page.locator("table").last.is_visible()
        assert page.evaluate("() => [...document.images].every(one => one.naturalWidth > 100)")


@pytest.mark.parametrize("width, host", [(1400, "localhost"), (390, "127.0.0.1")])
def test_the_live_page(width, host, tmp_path):
    """Two runs that take minutes, so that they are under way when the browser has started."""
    good(call("nmfd", "new-controller", tmp_path / "mine.py"))
    (tmp_path / "mine.py").rename(tmp_path / "$$a^$$.py")
    mine = "$$a^$$.py:MyController"
    command = [sys.executable, "-m", "cosim", "watch", "grid7_peak", "--controller", "no-control"]
    process = subprocess.Popen(
        [*command, "--against", mine], stderr=subprocess.PIPE, text=True, cwd=tmp_path
    )
    try:
        address = re.search(r"http://localhost:\d+/", process.stderr.readline())[0]
        address = address.replace("localhost", host)
        with opened(address, address, width) as page:
            assert mine in page.get_by_role("table").inner_text()
            assert page.locator("h1").inner_text() == f"grid7_peak: no-control against {mine}"

            def minutes():
                return float(re.search(r">([\d.]+) min<", page.evaluate(NUMBERS))[1])

            def press(name):
                page.get_by_role("button", name=name, exact=True).click()

            def wait_for_other_numbers():
                shown = page.evaluate(NUMBERS)
                page.wait_for_function(f"before => ({NUMBERS})() !== before", arg=shown)

            wait_for_other_numbers()
            press("Pause")
            page.get_by_role("button", name="Go on").wait_for()
            page.wait_for_timeout(3000)
            before = minutes()
            page.wait_for_timeout(2000)
            assert minutes() == before
            page.locator("select").last.select_option(index=1)
            page.wait_for_function(f"() => ({PLANE})().startsWith('Region 1')")
            page.locator("select").first.select_option("slow")
            press("Go on")
            wait_for_other_numbers()
            assert minutes() > before
    finally:
        process.terminate()
        process.wait()

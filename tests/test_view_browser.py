"""The live page in a real browser: numbers move, pausing stops SUMO, a gate that is closed is told, nothing comes from
elsewhere, and names stay names."""

import re
import shutil
import subprocess
import sys

import pytest
import tiny_city
from commands import call, good

from cosim.sumo.net import city_of
from nmfd.api import load_scenario

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
EVIL = "<script>alert(1)</script>"
EDGES = """() => Math.max(...Bokeh.documents[0].get_model_by_name("map0").renderers.map(
    one => (one.data_source.data.edge || []).length))"""
# Where the widest street of the first map is on the screen, and its name.
PLACE = """() => {
  const plot = Bokeh.documents[0].get_model_by_name("map0"), view = Bokeh.index.find_one(plot)
  view.el.scrollIntoView({block: "center"})
  const data = plot.renderers.map(one => one.data_source.data).find(data => data.edge)
  const ends = (name, n) => [data[name][n][0], data[name][n][data[name][n].length - 1]]
  const wide = n => Math.abs(ends("xs", n)[0] - ends("xs", n)[1])
  const n = data.xs.reduce((best, _, n) => wide(n) > wide(best) ? n : best, 0)
  const middle = name => (ends(name, n)[0] + ends(name, n)[1]) / 2
  const box = view.canvas_view.el.getBoundingClientRect(), frame = view.frame
  return [box.x + frame.x_scale.compute(middle("xs")), box.y + frame.y_scale.compute(middle("ys")), data.edge[n]]
}"""
STREET = "() => Bokeh.documents[0].get_model_by_name('street_curve').title.text"
TEXT = """() => Bokeh.documents[0].get_model_by_name("numbers").text"""
pytestmark = [pytest.mark.slow, pytest.mark.skipif(CHROMIUM is None, reason="no browser")]


@pytest.fixture(scope="module")
def scenario(tmp_path_factory):
    path = tiny_city.imported(tmp_path_factory.mktemp("browser")) / "scenario.toml"
    path.write_text(re.sub(r'(?m)^name = ".*"$', f'name = "{EVIL}"', path.read_text(), count=1))
    assert EVIL in path.read_text()
    return path.parent


@pytest.fixture
def browser():
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        found = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield found
        found.close()


@pytest.fixture(scope="module")
def report(scenario, tmp_path_factory):
    """The page of two runs."""
    out = tmp_path_factory.mktemp("report") / "run"
    for command in (
        (
            "run",
            scenario,
            "--controller",
            "no-control+guided",
            "--against",
            "no-control",
            "--seed",
            3,
            "--steps",
            6,
            "--out",
            out,
        ),
        ("report", out),
    ):
        good(call("cosim", *command))
    return out / "report.html"


@pytest.mark.parametrize("width", [1280, 390])
def test_the_page_of_finished_runs(report, browser, width):
    page, wrong = browser.new_page(viewport={"width": width, "height": 900}), []
    page.on("console", lambda said: said.type in ("error", "warning") and wrong.append(said.text))
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.on("dialog", lambda dialog: wrong.append(dialog.message))
    page.on("request", lambda asked: asked.url.startswith(("file:", "data:", "blob:")) or wrong.append(asked.url))
    page.goto(report.as_uri())
    page.wait_for_function("() => window.Bokeh && Bokeh.documents.length")
    assert page.locator("h1").inner_text() == f"Traffic control in SUMO: {EVIL}"

    def shown():
        return page.evaluate("""() => [0, 1].map(n => Array.from(Bokeh.documents[0].get_model_by_name(`map${n}`)
            .renderers.map(one => one.data_source.data).find(data => data.edge).value))""")

    page.locator(".noUi-handle").focus()
    page.keyboard.press("End")
    page.wait_for_timeout(300)
    at_the_end = shown()
    for _ in range(3):
        page.keyboard.press("ArrowLeft")
    page.wait_for_timeout(500)
    before = shown()
    assert before[0] != at_the_end[0] and before[1] != at_the_end[1]
    page.locator("select").select_option(index=1)
    page.wait_for_timeout(300)
    assert page.evaluate("() => Bokeh.documents[0].get_model_by_name('plane').title.text").startswith("Region 1")
    page.get_by_role("button", name="Play").click()
    page.wait_for_timeout(2000)
    assert shown() == at_the_end

    table = page.get_by_role("region", name="What came of it, demand times 1")
    heading = table.locator("thead th", has_text="TTS")

    def times():
        return [float(row.split()[0]) for row in table.locator("tbody td:nth-child(3)").all_inner_texts()]

    heading.get_by_role("button").click()
    assert times() == sorted(times()) and heading.get_attribute("aria-sort") == "ascending"
    page.keyboard.press("Enter")
    assert times() == sorted(times(), reverse=True) and times()[0] > times()[1]
    assert heading.get_attribute("aria-sort") == "descending"
    assert page.evaluate("() => document.documentElement.scrollWidth <= window.innerWidth")
    assert page.evaluate("() => [...document.images].every(one => one.naturalWidth > 100)") and wrong == []


@pytest.mark.parametrize("width", [1400, 390])
def test_the_page_lives(scenario, browser, width):
    command = [
        sys.executable,
        "-m",
        "cosim",
        "watch",
        str(scenario),
        "--controller",
        "no-control",
        "--against",
        "no-control+guided",
        "--seed",
        "3",
        "--no-open",
        "--delay",
        "20",
    ]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        address = re.search(r"http://127\.0\.0\.1:\d+/", process.stdout.readline())[0]
        page, wrong = browser.new_page(viewport={"width": width, "height": 900}), []
        page.on("console", lambda said: said.type in ("error", "warning") and wrong.append(said.text))
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on("dialog", lambda dialog: wrong.append(dialog.message))
        page.on("request", lambda asked: asked.url.startswith((address, "data:", "blob:")) or wrong.append(asked.url))
        page.goto(address)
        page.wait_for_function("() => window.Bokeh && Bokeh.documents.length && document.querySelector('h1')")
        assert page.locator("h1").inner_text().startswith(EVIL)

        def minutes():
            return float(re.search(r">([\d.]+) min<", page.evaluate(TEXT))[1])

        def press(name):
            page.get_by_role("button", name=name, exact=True).click()

        page.wait_for_function(f"before => ({TEXT})() !== before", arg=page.evaluate(TEXT), timeout=20_000)
        network = load_scenario(scenario).network
        assert page.evaluate(EDGES) == len(city_of(network).edges)
        press("Pause")
        page.get_by_role("button", name="Go on").wait_for()
        page.wait_for_timeout(1500)
        before = minutes()
        page.wait_for_timeout(1500)
        assert minutes() == before
        *place, street = page.evaluate(PLACE)
        page.mouse.click(*place)
        page.wait_for_function(f"() => ({STREET})() === 'Street {street}: density and speed'", timeout=20_000)
        press("Step")
        page.wait_for_function(f"before => ({TEXT})() !== before", arg=page.evaluate(TEXT), timeout=10_000)
        page.wait_for_timeout(1500)
        stepped = minutes()
        assert before < stepped <= before + 2 * load_scenario(scenario).step / 60
        press("Faster")  # while it waits: at the end these buttons are off
        press("Close gate")
        press("Go on")
        page.wait_for_function(f"() => ({TEXT})().includes('held at 0')", timeout=30_000)
        page.locator(".noUi-handle").focus()
        for _ in range(3):
            page.keyboard.press("ArrowLeft")
        back = -1.0
        for _ in range(20):  # until all keys have arrived: then it stays, whatever the run does
            if back == (back := minutes()):
                break
            page.wait_for_timeout(1500)
        assert back == minutes()
        press("Live")
        page.wait_for_function(f"back => !({TEXT})().includes(back)", arg=f">{back:.1f} min<", timeout=30_000)
        page.get_by_role("button", name="Speed").click()
        page.get_by_role("button", name="finished").wait_for(timeout=60_000)
        assert page.evaluate("() => document.documentElement.scrollWidth <= window.innerWidth + 1")
        page.close()
        told, errors = process.communicate(timeout=60)
        assert process.returncode == 0 and all(line.startswith("watch: ") for line in errors.splitlines()), errors
        assert re.search(r"--fault gate:\d-\d=0@\d+-999999", told) and told.count("total time spent") == 2
        assert wrong == []
    finally:
        process.kill()
        process.wait()

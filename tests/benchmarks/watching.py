"""What watching costs a run, and what a viewer gets: python tests/benchmarks/watching.py SCENARIO [--steps N]

Runs of `cosim watch`, in turn without a viewer; with one elsewhere, who takes what is sent and draws nothing; with
forty clients, one that reads slowly and one that sends garbage, all of these at the lowest priority, for they stand for
other machines; with one in Chromium on this machine; and without a viewer while something else keeps a core busy, for
virtual cores are often halves of one, and a browser that draws slows a run beside it for that alone. Ratios are of
runs that came one after another, so that they mean something on a busy machine.
"""

import argparse
import asyncio
import json
import multiprocessing
import os
import re
import shutil
import statistics
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import psutil
from tornado.httpclient import AsyncHTTPClient, HTTPClientError, HTTPRequest
from tornado.websocket import websocket_connect

CLIENTS = 40
IDLE = 5.0  # s without processor time: the run has ended (too little where it is starved of it)
PULL = [json.dumps(part) for part in ({"msgid": "1", "msgtype": "PULL-DOC-REQ"}, {}, {})]
THERE = """() => { try { return Bokeh.documents[0].is_idle && !!Bokeh.documents[0].get_model_by_name("map0") }
catch { return false } }"""
# As browsers count it: ms from the request to the first text on the screen.
PAINTED = "() => performance.getEntriesByName('first-contentful-paint')[0].startTime"
# Of the page: how many pictures came, told by the times that its sources changed.
COUNT = """() => { window.pictures = 0; window.times = []
const map = Bokeh.documents[0].get_model_by_name("map0")
const streets = map.renderers.map(one => one.data_source).find(one => (one.data.edge || []).length)
streets.patching.connect(() => { window.pictures += 1; window.times.push(performance.now()) }) }"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenario", type=Path)
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--pairs", type=int, default=2)
    parser.add_argument("--controller", default="no-control")
    chosen = parser.parse_args()
    kinds = {
        "nobody": None,
        "one elsewhere": elsewhere,
        "forty, slow, garbage": crowd,
        "one in Chromium": browser,
        "nobody, a busy core": busy,
    }
    rows: dict[str, list[dict]] = {kind: [] for kind in kinds}
    for _ in range(chosen.pairs):
        for kind, visitors in kinds.items():
            rows[kind].append(watched(chosen, visitors))
            print(kind, json.dumps(rows[kind][-1]), flush=True)
    for kind, found in rows.items():
        for name in ("wall_s", "cpu_s"):
            ratio = [one[name] / alone[name] for one, alone in zip(found, rows["nobody"], strict=True)]
            print(f"{kind}: {name} times {statistics.median(ratio):.2f} of a run that nobody watches")


def watched(chosen: argparse.Namespace, visitors) -> dict:
    """Wall time and processor time of the run's process, the server's processor time, and what the visitors found."""
    process = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "cosim",
            "watch",
            str(chosen.scenario),
            "--controller",
            chosen.controller,
            "--seed",
            "1",
            "--steps",
            str(chosen.steps),
            "--no-open",
        ],
        stdout=subprocess.PIPE,
        text=True,
    )
    address = re.search(r"http://127\.0\.0\.1:\d+/", process.stdout.readline())[0]
    begin, server = time.perf_counter(), psutil.Process(process.pid)
    run = max(server.children(), key=lambda child: sum(child.cpu_times()[:2]))
    before, made = sum(run.cpu_times()[:2]), sum(server.cpu_times()[:2])
    context = multiprocessing.get_context("spawn")
    told = context.SimpleQueue()
    other = visitors and context.Process(target=visitors, args=(address, told), daemon=True)
    if other:
        other.start()
    cpu, end, spent, seen = before, begin, made, dict[str, float]()
    there: tuple[float, float] | None = None  # time and processor time when the browser had its first picture
    while time.perf_counter() - end < IDLE:  # the process waits for another task when the run has ended
        time.sleep(0.05)
        with suppress(psutil.NoSuchProcess):  # without a viewer it ends soon
            if (now := sum(run.cpu_times()[:2])) > cpu:
                cpu, end, spent = now, time.perf_counter(), sum(server.cpu_times()[:2])
                while other and not told.empty():
                    seen |= told.get()
                if there is None and "map_s" in seen:
                    there = end, cpu
    found = {
        "wall_s": round(end - begin, 2),
        "cpu_s": round(cpu - before, 2),
        "server_cpu_s": round(spent - made, 2),
        **seen,
    }
    if there and end - there[0] > IDLE:  # the share of its time that the run was kept waiting, for a core or the page
        found["waiting"] = round(1.0 - (cpu - there[1]) / (end - there[0]), 3)
    if other:
        for child in (*psutil.Process(other.pid).children(recursive=True), psutil.Process(other.pid)):
            with suppress(psutil.NoSuchProcess):
                child.kill()
        other.join()
    process.terminate()
    process.wait()
    return found


def browser(address: str, told) -> None:
    """First paint, the whole map, pictures per second, bytes, every few seconds."""
    from playwright.sync_api import sync_playwright

    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    with sync_playwright() as playwright:
        page = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"]).new_page()
        sizes = {"http_bytes": 0, "websocket_bytes": 0}

        def count(kind: str, payload: bytes | str) -> None:
            sizes[kind] += len(payload)

        page.on("response", lambda answer: count("http_bytes", answer.body()) if answer.status == 200 else None)
        page.on("websocket", lambda socket: socket.on("framereceived", lambda frame: count("websocket_bytes", frame)))
        begin = time.perf_counter()
        page.goto(address)
        page.wait_for_function(THERE, timeout=300e3)
        told.put(
            {
                "first_paint_s": round(page.evaluate(PAINTED) / 1000, 2),
                "map_s": round(time.perf_counter() - begin, 2),
                **sizes,
            }
        )
        page.evaluate(COUNT)
        sizes["websocket_bytes"] = 0
        begin = time.perf_counter()
        while True:
            page.wait_for_timeout(2000)
            seconds = time.perf_counter() - begin
            told.put(
                {
                    "pictures_per_s": round(page.evaluate("() => window.pictures") / seconds, 2),
                    "kB_per_s": round(sizes["websocket_bytes"] / 1000 / seconds, 1),
                }
            )


def busy(_: str, __) -> None:
    """Nobody who looks, but a core that is in use."""
    while True:
        pass


def elsewhere(address: str, told) -> None:
    """One who looks from another machine: takes what is sent."""
    crowd(address, told, clients=1, harmful=False)


def crowd(address: str, told, clients: int = CLIENTS + 1, harmful: bool = True) -> None:
    """Clients that ask at once, and those for whom there is no room again and again. harmful: one is slow, and there is
    garbage"""
    psutil.Process().nice(19 if os.name == "posix" else psutil.IDLE_PRIORITY_CLASS)
    port, count = int(re.search(r":(\d+)/", address)[1]), {"in": 0, "waited": 0, "messages": 0}

    async def client(slow: bool) -> None:
        while True:
            try:
                page = (await AsyncHTTPClient(max_clients=100).fetch(address, request_timeout=120)).body.decode()
                break
            except HTTPClientError as error:
                count["waited"] += error.code == 503
                await asyncio.sleep(5.0)
        token = re.search(r'"token":"([^"]+)"', page)[1]
        socket = await websocket_connect(
            HTTPRequest(
                f"ws://127.0.0.1:{port}/ws",
                headers={"Sec-WebSocket-Protocol": f"bokeh, {token}", "Origin": f"http://127.0.0.1:{port}"},
            ),
            max_message_size=100_000_000,
        )
        count["in"] += 1
        for part in PULL:
            socket.write_message(part)
        while await socket.read_message() is not None:
            count["messages"] += 1
            if slow:
                await asyncio.sleep(1.0)

    async def garbage() -> None:
        while True:
            try:
                _, writer = await asyncio.open_connection("127.0.0.1", port)
                writer.write(os.urandom(100_000))
                await writer.drain()
                writer.close()
            except OSError:
                pass
            await asyncio.sleep(0.05)

    async def tell() -> None:
        while True:
            await asyncio.sleep(1.0)
            told.put(dict(count))

    async def all_of_them() -> None:
        harm = [garbage()] if harmful else []
        await asyncio.gather(
            *(client(harmful and n == 0) for n in range(clients)), *harm, tell(), return_exceptions=True
        )

    asyncio.run(all_of_them())


if __name__ == "__main__":
    main()

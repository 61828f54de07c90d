"""The guided session in a real Chromium, by what a person clicks; the command line beside it."""

from __future__ import annotations

import json
import os
import queue
import re
import signal
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from importlib import resources
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("starlette", reason="the page needs the extra live")

import imulab as il
from benchpage import PATIENCE
from imulab.cli import main
from imulab.report import noise_figures
from liveports import lines_of
from test_live_link import Sender

FIT = ["--order", "1", "--gravity", "9.81+-0"]
UNIT = "simulate:order=1,gravity=9.81,noise=0.2mg"
EVIL = "<img src=x onerror=document.title='taken'><script>document.title='taken'</script>"


class Live:
    """`imulab live --page` in a process of its own."""

    def __init__(self, folder: Path, *words: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "imulab", "live", *words, "--page", "--no-browser"],
            cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        self.lines: queue.Queue[str] = queue.Queue()
        self.reader = threading.Thread(target=self._read, daemon=True)
        self.reader.start()
        self.address = self.lines.get(timeout=PATIENCE)

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.lines.put(line.strip())

    def end(self) -> tuple[int, str]:
        """Wait for the end; exit status and standard error."""
        assert self.process.stderr is not None
        status = self.process.wait(PATIENCE)
        error = self.process.stderr.read()
        self.close()
        return status, error

    def close(self) -> None:
        self.process.kill()
        self.process.wait(PATIENCE)
        self.reader.join(5)
        for stream in (self.process.stdout, self.process.stderr):
            assert stream is not None
            stream.close()


@pytest.fixture
def live(tmp_path) -> Iterator[object]:
    started: list[Live] = []

    def start(*words: str) -> Live:
        started.append(Live(tmp_path, *words))
        return started[-1]

    yield start
    for each in started:
        each.close()


def press(page: Any, place: Any) -> None:
    """Press the mouse on a place and hold it, again where the place has moved between aiming and pressing."""
    for _ in range(20):
        place.hover()
        page.mouse.down()
        if place.evaluate("each => each.matches(':active')"):
            return
        page.mouse.up()
    pytest.fail("the place goes on moving")


def resize(page: Any, width: int) -> None:
    page.set_viewport_size({"width": width, "height": 844})
    page.wait_for_function("width => innerWidth === width", arg=width)


def content(record: Path) -> dict:
    found = json.loads(record.read_text())
    return {key: value for key, value in found.items() if key not in ("created", "content_sha256")}


def test_from_the_plug_to_the_record_with_a_knocked_attitude_dropped(live, new_page, tmp_path, monkeypatch):
    words = ["--follow", "--attitudes", "14", *FIT, "--save", "rec.csv", "-o", "sn42.json"]
    running = live(f"{UNIT},speed=25,knock=5", *words)
    page = new_page(running.address)
    named = page.locator(".said.bad:has(button:text-is('Drop attitude 5'))")
    named.wait_for()
    assert "knocked?" in named.inner_text()
    other = new_page(running.address)  # a second page on the session: the same, and it can drop, too
    other.locator(".said.bad button").dblclick()
    named.wait_for(state="detached")
    page.reload()
    page.wait_for_selector(".enough:not([hidden])")
    said = page.evaluate(
        """() => import("/static/session.js").then(({ advice }) =>
            [[true, []], [false, ["the model is too simple: fit"]], [false, []]].map(([aside, warnings]) => advice(
                { phase: "measuring", state: "accepted", enough: "enough", warnings,
                  attitudes: [{ number: 5, aside }] })))"""
    )
    assert said == [
        "Enough, but attitude 5 looks knocked: drop it first.",
        "Enough attitudes, but the model is too simple: see the warning below.",
        "Enough: make the record.",
    ]
    words = page.evaluate(
        """() => import("/static/dom.js").then(({ inWords }) => inWords(
            "record more (imulab tumble plan --add FILE), or state --mag-order, m/s^2, 'imulab show A -o B'"))"""
    )
    assert words == "record more (imulab tumble plan --add FILE), or state “mag order”, m/s², 'imulab show A -o B'"
    numbers = page.locator("section:has(> h2:text-is('Attitudes')) tbody tr td:first-child").all_inner_texts()
    assert "5" not in numbers
    assert len(numbers) >= 14
    page.wait_for_selector(".facts dt:text-is('|f| now, uncorrected')")
    page.get_by_role("button", name="Make the record").dblclick()
    for each in (page, other):
        each.wait_for_selector(".result")
        assert each.locator("#said").inner_text() == ""  # nothing was asked for twice
        assert each.locator(".advice").inner_text() == "Done: the record is made."
    page.wait_for_selector(r".result .facts dd:text-matches('^9\\.8[01]\\d+ m')")  # 10.2 uncorrected
    with page.expect_download() as saved:
        page.get_by_text("Save the record", exact=True).click()
    monkeypatch.chdir(tmp_path)
    assert Path(saved.value.path()).read_bytes() == Path("sn42.json").read_bytes()
    with page.context.expect_page() as opened:
        page.get_by_text("Open the report").click()
    opened.value.wait_for_selector("html[data-drawn]")
    assert opened.value.evaluate("origin") == "null"  # a page of its own, which reaches nothing of the session
    page.get_by_text("Firmware and other formats").click()  # the workbench beside the session has its files
    page.locator("[data-name='sn42.json']").click()
    page.get_by_role("button", name="Firmware (zip)").wait_for()
    page.locator("[data-name='rec.csv']").click()
    page.get_by_text("attitudes at rest (shaded)").wait_for()
    page.get_by_role("tab", name="Session").click()
    page.get_by_role("button", name="End the session").click()
    assert "can be closed" in page.locator("#said").inner_text()
    assert running.end()[0] == 0
    assert not (tmp_path / "imulab-files").exists()
    assert main(["tumble", "fit", "rec.csv", *FIT, "-o", "fit.json"]) == 0
    assert content(tmp_path / "sn42.json") == content(tmp_path / "fit.json")


@pytest.mark.slow
def test_a_simulated_unit_is_turned_with_the_mouse_and_its_gyroscopes_are_calibrated(live, new_page, tmp_path):
    running = live(f"{UNIT},speed=10,gyro=1", "--attitudes", "14", *FIT, "--save", "rec.csv", "-o", "both.json")
    page = new_page(running.address)
    held = page.locator(".sphere .held")
    turn = page.get_by_role("button", name="Turn it so")
    for count in range(1, 13):
        held.nth(count - 1).wait_for(state="attached")
        for _ in range(300):  # what was wanted when it is clicked may just have been reached
            if held.count() > count:
                break
            turn.click()
            page.wait_for_timeout(200)
    page.get_by_text("gyro_scale_factor_x").wait_for()
    figure = page.locator(".body.by-hand")
    before = page.locator(".sphere .now-mark").get_attribute("d")
    press(page, figure)
    box = figure.bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y + 90, steps=5)  # the upper side comes to the front: a quarter turn
    page.mouse.up()
    page.wait_for_function("old => document.querySelector('.sphere .now-mark').getAttribute('d') !== old", arg=before)
    page.evaluate("window.told = new WebSocket(location.href.replace('http', 'ws') + 'ws')")
    page.wait_for_function("() => told.readyState === 1")
    for up in ("[0, 0, 0]", "[1, 2]", '["a", 0, 0]', "[1e999, 0, 0]", "null"):
        page.evaluate(
            """up => new Promise(done => {
              told.onmessage = event => { if (event.data.includes('"refused"')) done(); };
              told.send(`{"type": "turn", "up": ${up}}`);
            })""",
            up,
        )
    page.get_by_role("button", name="Make the record").click()
    page.wait_for_selector(".result")
    page.wait_for_selector(".result .caption:text-matches('deg/s corrected')")
    assert "--with gyro -o both.json" in page.locator(".result pre").inner_text()
    assert "gyro_misalignment_yx" in content(tmp_path / "both.json")["parameters"]


class Elsewhere(BaseHTTPRequestHandler):
    """A page of another port of this machine, which may do what it likes."""

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("content-type", "text/html")
        self.end_headers()
        self.wfile.write(b"<title>elsewhere</title>")

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def elsewhere() -> Iterator[str]:
    with HTTPServer(("127.0.0.1", 0), Elsewhere) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_address[1]}/"
        server.shutdown()
        thread.join()


def test_a_wrong_token_and_another_page_get_nothing(live, new_page, elsewhere):
    running = live(f"{UNIT},speed=5", "--save", "rec.csv")
    base = running.address.partition("?")[0]
    stranger = new_page(f"{base}?token=wrong")
    assert "open that one, with its token" in stranger.inner_text("body")
    page = new_page(running.address)
    page.wait_for_selector(".now[data-state]")
    assert page.url == base  # the token has left the address
    # Another page of this browser asks for the socket and for an answer; the browser sends the cookie along.
    hostile = new_page(elsewhere)
    hostile.evaluate(
        """base => {
      window.found = [];
      const socket = new WebSocket(base.replace("http", "ws") + "ws");
      socket.onopen = () => found.push("socket open");
      socket.onclose = () => found.push("socket closed");
      fetch(base + "api/session/recording", { credentials: "include", mode: "no-cors" })
        .then(() => found.push("answer, unreadable"), () => found.push("no answer"));
      const script = document.createElement("script");
      script.onload = () => found.push("script"), script.onerror = () => found.push("no script");
      script.src = base + "static/plotly.js";
      document.head.append(script);
    }""",
        base,
    )
    hostile.wait_for_function("() => found.length === 3")
    assert sorted(hostile.evaluate("found")) == ["no answer", "no script", "socket closed"]


def test_finishing_too_early_is_answered_and_the_session_goes_on(live, new_page):
    running = live(f"{UNIT},speed=25,hold=100 h", *FIT, "--save", "rec.csv")  # it stays as it lies until it is turned
    page = new_page(running.address)
    growing = page.evaluate("fetch('/api/session/recording').then(answer => answer.json())")
    assert growing == {"error": "the recording still grows, and there is no record yet: finish the session first"}
    finish = page.get_by_role("button", name="Finish now")
    page.locator(".sphere .held").wait_for(state="attached")
    assert page.locator("#session").get_attribute("role") == "tabpanel"
    assert finish.is_disabled()
    assert re.fullmatch(r"needs at least \d (more )?attitudes?", page.inner_text("#missing"))
    page.clock.install()
    page.clock.pause_at(
        "2099-01-01"
    )  # how long the refusal stands is counted by this clock, not by the machine's speed
    page.evaluate(
        """() => new Promise(done => {
      const other = new WebSocket(location.href.replace("http", "ws") + "ws");
      other.onopen = () => { other.send('{"type": "finish"}'); done(); };
    })"""
    )
    refusal = page.locator("#said .bad:has-text('attitude')")
    refusal.wait_for()  # a program may ask for it: refused
    page.get_by_role("button", name="Turn it so").click()
    page.clock.run_for(1)  # the click is over
    page.locator(".sphere .held").nth(1).wait_for(state="attached")
    page.clock.run_for(4900)
    assert refusal.count() == 1  # it stands for 5 s, though another attitude is held at once
    page.clock.run_for(200)
    assert refusal.count() == 0
    running.process.send_signal(signal.SIGINT)
    page.wait_for_selector("#said .bad:has-text('The program has ended')")
    status, error = running.end()
    assert status == 130, error
    assert "attitudes: --resume goes on with it" in error


def test_a_killed_program_is_said_on_the_page(live, new_page):
    running = live(f"{UNIT},speed=5", "--save", "rec.csv")
    page = new_page(running.address)
    page.wait_for_selector(".now[data-state]")
    os.kill(running.process.pid, signal.SIGKILL)
    page.wait_for_selector("#said .bad:has-text('The program has ended, or cannot be reached')")


def test_nothing_of_a_stream_is_executed(live, new_page, tmp_path):
    (tmp_path / "hostile.csv").write_text(
        f"# format = {EVIL}\n# {EVIL} = {EVIL}\n"
        f"time [s],accel_x [m/s^2],accel_y [m/s^2],accel_z [m/s^2],{EVIL} [count]\n"
        + "".join(f"{k / 100},{0.01 * (k % 3)},0.02,9.81,1\n" for k in range(3000))
    )
    running = live("replay:hostile.csv", "--save", "rec.csv")
    page = new_page(running.address)
    page.wait_for_selector(".log:has-text('<img')", state="attached")
    assert page.locator("main img").count() == 0
    assert "taken" not in page.title()


def test_the_guess_of_an_unknown_stream_is_one_click(live, new_page):
    recording = il.simulate_tumble(attitudes=40, order=1, gravity=9.81, hold="3 s", move="1 s", gyro=False)
    values = zip(recording.si("time"), recording.triad("accel"), strict=True)
    rows = [b"%d;%.4f;%.4f;%.4f\n" % (1e3 * time, *force) for time, force in values]
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(PATIENCE)
        running = live(f"tcp:127.0.0.1:{server.getsockname()[1]}", "--attitudes", "12", *FIT, "--save", "rec.csv")
        page = new_page(running.address)
        link = server.accept()[0]
        sender = Sender(link.sendall, [b"ms;p;q;r\n", *rows])  # titles that come once: another start would miss them
        page.locator(".advice:text-is('Unknown format: look at the guess, and take it.')").wait_for()
        assert "[columns]" in page.get_by_label("Layout").inner_text()
        page.get_by_role("button", name="Read it so").click()
        page.get_by_label("Layout").wait_for(state="detached")
        page.get_by_role("button", name="Make the record").click()
        page.wait_for_selector(".result")
        sender.stop()
        link.close()


def test_an_unknown_stream_shows_its_lines_and_a_guess(live, new_page, tmp_path):
    rows = "".join(f"{10 * k},{k % 3},{4 - k % 3},{1000 + k % 5}\\n" for k in range(400))
    sender = subprocess.Popen(
        [
            sys.executable, "-c",
            "import socket, sys, time\n"
            "s = socket.create_server(('127.0.0.1', 0)); print(s.getsockname()[1], flush=True)\n"
            f"c, _ = s.accept()\nfor line in '{rows}'.splitlines(True):\n"
            "  c.sendall(line.encode()); time.sleep(0.01)\n"
            "sys.stdin.readline()\n",  # it ends when the page has been seen
        ],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        port = sender.stdout.readline().strip()
        running = live(f"tcp:127.0.0.1:{port}", "--save", "rec.csv")
        page = new_page(running.address)
        page.get_by_role("button", name="Read it so").wait_for()
        assert "[columns]" in page.locator("pre").last.inner_text()
        sender.communicate("\n")
        page.wait_for_selector("#said .bad:has-text('unknown format')")
        status, error = running.end()
        assert status == 2
        assert "unknown format" in error
        assert not (tmp_path / "rec.csv").exists()
    finally:
        sender.kill()
        sender.wait()
        sender.stdin.close()
        sender.stdout.close()


def test_no_script_and_old_browsers_are_told(live, browser):
    running = live(f"{UNIT},speed=5", "--save", "rec.csv")
    context = browser.new_context(java_script_enabled=False)
    page = context.new_page()
    page.goto(running.address)
    assert "This page needs JavaScript" in page.inner_text("main")
    context.close()
    context = browser.new_context()
    page = context.new_page()
    page.goto(running.address)
    page.route("**/", old)
    page.reload()
    page.wait_for_selector("#old:not([hidden])")
    assert "too old for this page" in page.locator("#old").inner_text()
    context.close()


def old(route) -> None:
    """Answer with the page as a browser sees it that knows neither modules nor nomodule."""
    answer = route.fetch()
    module = '<script type="module" src="/static/app.js"></script>'
    route.fulfill(response=answer, body=answer.text().replace(module, "").replace("nomodule ", ""))


def test_nothing_overflows_sideways(live, new_page):
    running = live(f"{UNIT},speed=25", "--follow", "--target", "bias 100 ug", *FIT, "--save", "rec.csv")
    page = new_page(running.address)
    page.wait_for_selector("table")
    for width in (1280, 768, 390):
        page.set_viewport_size({"width": width, "height": 844})
        page.wait_for_function("width => document.documentElement.scrollWidth <= width", arg=width)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--page", "--plain"], "--page together with --plain"),
        (["--port", "8000"], "--port: expected --page with it"),
        (["--no-browser"], "--no-browser: expected --page with it"),
        (["--host", "0.0.0.0"], "--host: expected --page with it"),
        (["--page", "--port", "70000"], "--port 70000: expected 0 (a free one) to 65535"),
        (["--page", "--port", "x"], "--port 'x'"),
    ],
)
def test_mistakes_are_one_line_and_leave_no_file(words, said, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["live", "simulate", "--save", "rec.csv", *words]) == 2
    error = capsys.readouterr().err.strip()
    assert said in error
    assert "\n" not in error
    assert not list(tmp_path.iterdir())


def test_what_is_not_installed_is_named(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("imulab.live.page.find_spec", lambda name: None if name == "uvicorn" else name)
    assert main(["live", "simulate", "--save", "rec.csv", "--page"]) == 2
    assert (
        "the page needs uvicorn, which is not here: pip install '.[live]' in imulab's source folder"
        in capsys.readouterr().err
    )


def test_a_link_that_is_lost_keeps_the_page_and_comes_back(live, new_page, tmp_path):
    options = {"hold": "3 s", "move": "1 s", "gyro": False, "noise": "0.3 mg"}
    lines = lines_of(il.simulate_tumble(attitudes=16, order=1, gravity=9.81, **options))
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(PATIENCE)
        running = live(
            f"tcp:127.0.0.1:{server.getsockname()[1]}", "--attitudes", "12", *FIT, "--save", "rec.csv", "-o", "rec.json"
        )
        page = new_page(running.address)
        first = server.accept()[0]
        sender = Sender(first.sendall, lines[: len(lines) // 3])  # however late the page is, much is left to send
        page.locator("section:has(> h2:text-is('Attitudes')) tbody tr").nth(2).wait_for()
        gone = sender.stop()
        first.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        first.close()
        page.wait_for_selector(r".advice:text-matches('^Link lost at \\d+ of 12; reconnecting\\.$')")
        assert "--resume goes on with it. In " in page.inner_text(".outlook")
        assert page.locator("section:has(> h2:text-is('Attitudes')) tbody tr").count() >= 3
        second = server.accept()[0]
        sender = Sender(second.sendall, lines[gone:])
        page.wait_for_selector(".outlook", state="hidden")
        page.get_by_role("button", name="Make the record").click()
        page.wait_for_selector(".result")
        sender.stop()
        second.close()


def test_a_session_that_ends_without_a_record_keeps_its_tables(live, new_page, tmp_path):
    il.write_csv(il.simulate_tumble(attitudes=5, order=1, gravity=9.81, gyro=False), tmp_path / "few.csv")
    running = live("replay:few.csv@6", *FIT, "--save", "rec.csv", "-o", "rec.json")
    page = new_page("about:blank")
    held: list[Any] = []
    page.route("**/api/workbench/*", lambda route: held.append(route))
    page.goto(running.address)
    reason = page.locator("#said .bad:has-text('For a record it needs at least 4 more attitudes.')")
    reason.wait_for()
    running.process.wait(PATIENCE)
    for route in held:  # it cannot be reached any more
        route.abort()
    page.wait_for_timeout(300)
    assert reason.count() == 1
    assert page.inner_text(".advice") == "The session has ended without a record."
    assert page.locator("section:has(> h2:text-is('Attitudes')) tbody tr").count() == 5
    assert "rec.csv keeps 5 attitudes: --resume goes on with it." in page.inner_text("main")
    assert not page.locator("#session button:enabled").count()
    status, error = running.end()
    assert status == 2
    assert "rec.csv keeps 5 attitudes: --resume goes on with it" in error


def test_the_page_shows_readings_progress_and_cover_and_reads_out_what_to_do(live, new_page):
    running = live(f"{UNIT},speed=4", "--follow", "--attitudes", "14", *FIT, "--save", "rec.csv")
    page = new_page(running.address)
    page.evaluate(
        """() => {
      window.spoken = [];
      speechSynthesis.speak = said => spoken.push(said.text);
    }"""
    )
    page.get_by_role("button", name="Voice").click()
    page.wait_for_function("() => spoken.includes('Hold still.') && spoken.some(text => text.startsWith('Turn it: '))")
    assert page.evaluate("spoken.every((text, k) => text !== spoken[k - 1])")
    shown = page.wait_for_function(  # a hold is soon over: both are read at once
        r"""() => document.querySelector(".now[data-state='still'] .ring text")?.textContent.match(/^[1-9][.][0-9] s$/)
            && document.querySelector(".ring .full").getAttribute("stroke-dasharray")"""
    )
    full, round_ = map(float, shown.json_value().split())
    assert 0 < full <= round_
    page.locator(".sphere .held").nth(2).wait_for(state="attached")
    both = "['.covered-part polygon', '.held'].map(each => document.querySelectorAll(`.sphere ${each}`).length)"
    covered, held = page.evaluate(both)  # at once: attitudes go on being held
    assert covered >= held >= 3
    assert sorted(set(page.locator(".sphere text").all_text_contents())) == [
        "x",
        "y",
        "z down",
        "z up",
    ]  # nothing over a mark
    assert page.locator(".strip .band").count() == 3
    assert re.fullmatch(r"x −?\d+\.\d+", page.locator(".readings .values span").first.inner_text())
    colour = "each => getComputedStyle(document.querySelector(each)).color"
    curves = {page.evaluate(colour, place) for place in (".strip .band.axis-x", ".body .axis-x")}
    assert curves == {"rgb(31, 111, 139)"}  # that of x in reports, #1f6f8b; small letters are darker
    letters = {page.evaluate(colour, f"{place} .axis-x") for place in (".sphere", ".readings")}
    assert letters == {"color(srgb 0.12451 0.373529 0.465686)"}


def test_axes_have_the_colours_of_reports():
    style = (resources.files("imulab") / "live/page/static/workbench.css").read_text()
    drawn = (resources.files("imulab") / "report/draw.js").read_text()
    light, dark = (re.findall(r"--c([012]): (#\w+);", line) for line in style.split("\n") if "--c0: #" in line)
    night = dict(re.findall(r'"(#\w{6})": "(#\w{6})"', drawn))
    assert [colour for _, colour in light] == list(noise_figures._CHANNEL_COLOURS[:3])
    assert [colour for _, colour in dark] == [night[colour] for _, colour in light]


def test_every_button_is_inside_and_print_has_none(live, new_page):
    running = live(
        f"{UNIT},speed=25,knock=3", "--follow", "--attitudes", "14", *FIT, "--save", "rec.csv", "-o", "r.json"
    )
    page = new_page(running.address)
    outside = """width => [...document.querySelectorAll("#session button, #session a.button")].filter(each => {
        const box = each.getBoundingClientRect();
        return each.offsetParent && (box.left < 0 || box.right > width);
    }).map(each => each.textContent)"""
    cut = """() => [...document.querySelectorAll("[aria-label='Parameters']")].filter(each => each.offsetParent
        && each.scrollWidth > each.clientWidth).length"""
    page.locator(".said.bad button").wait_for()
    for width in (768, 390):
        resize(page, width)
        assert page.evaluate(outside, width) == []
    page.locator(".said.bad button").click()
    page.get_by_role("button", name="Make the record").click()
    page.wait_for_selector(".result")
    for width in (768, 390):
        resize(page, width)
        assert page.evaluate(outside, width) == []
        assert page.evaluate(cut) == 0  # no "ppm of" of "ppm off nominal"
        assert page.locator(".result pre").evaluate("each => each.scrollWidth <= each.clientWidth")
    assert page.get_attribute(".now", "data-verdict") in ("good", "look")
    page.emulate_media(media="print")
    shown = "[...document.querySelectorAll('button, a.button, input, select')].filter(each => each.offsetParent).length"
    assert page.evaluate(shown) == 0
    assert "scale_factor_x" in page.inner_text(".result")


def test_a_button_stays_while_it_is_pressed(live, new_page):
    running = live(f"{UNIT},speed=10,knock=3", "--follow", "--attitudes", "40", *FIT, "--save", "rec.csv")
    other = new_page(running.address).locator(".sphere .held")  # the page that is pressed shows no further attitudes
    page = new_page(running.address)
    named = page.locator(".said.bad button")
    press(page, named)
    other.nth(other.count() + 2).wait_for(state="attached")
    page.mouse.up()
    named.wait_for(state="detached")


def test_lost_samples_stand_in_the_headline(live, new_page):
    lines = lines_of(il.simulate_tumble(attitudes=8, order=1, gravity=9.81, gyro=False))
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(PATIENCE)
        running = live(f"tcp:127.0.0.1:{server.getsockname()[1]}", *FIT, "--save", "rec.csv")
        page = new_page(running.address)
        link = server.accept()[0]
        sender = Sender(link.sendall, [line for k, line in enumerate(lines) if k % 20 != 7])
        page.wait_for_selector(".now .loss:text-matches('^5([.][0-9])? % of the samples lost$')")
        sender.stop()
        link.close()


def test_the_place_is_asked_for_where_gravity_is_not_stated(live, new_page, tmp_path):
    lines = lines_of(il.simulate_tumble(attitudes=90, order=1, gravity=9.8073, hold="3 s", move="1 s", gyro=False))
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(PATIENCE)
        words = ["--attitudes", "12", "--order", "1", "--save", "rec.csv", "-o", "rec.json"]
        running = live(f"tcp:127.0.0.1:{server.getsockname()[1]}", *words)
        page = new_page(running.address)
        link = server.accept()[0]
        sender = Sender(link.sendall, lines)
        use = page.get_by_role("button", name="Use")
        use.click()
        page.wait_for_selector(".place .wrong:has-text('expected the latitude, or the gravity')")
        page.get_by_label("Latitude").fill("95")
        use.click()
        page.wait_for_selector(".place .wrong:has-text('latitude 95 deg: expected -90 to 90 deg')")
        assert page.get_by_label("Latitude").get_attribute("aria-invalid") == "true"
        assert page.locator("#said").inner_text() == ""
        page.get_by_label("Latitude").fill("48.1")
        page.get_by_label("height").fill("500")
        use.click()
        page.wait_for_selector(".place", state="hidden")
        page.wait_for_selector(".facts div:has-text('gravity here') dd:text-is('9.8075 m/s²')")
        page.get_by_role("button", name="Make the record").click()
        page.wait_for_selector(".result")
        assert "--latitude 48.1 --height 500" in page.inner_text(".result pre")
        sender.stop()
        link.close()
    record = il.load(tmp_path / "rec.json")
    assert record.model["gravity"]["value"] == pytest.approx(il.normal_gravity("48.1", "500 m"), abs=1e-9)


@pytest.mark.slow
def test_axe_finds_nothing_from_the_first_sample_to_the_record(live, new_page, accessibility):
    words = ["--follow", "--attitudes", "14", *FIT, "--save", "rec.csv", "-o", "r.json"]
    page = new_page(live(f"{UNIT},speed=25,knock=3", *words).address)
    page.locator(".said.bad button").wait_for()
    page.evaluate("for (const each of document.querySelectorAll('details')) each.open = true")
    assert accessibility(page) == []
    page.set_viewport_size({"width": 390, "height": 844})
    page.locator(".said.bad button").click()
    page.get_by_role("button", name="Make the record").click()
    page.wait_for_selector(".result")
    assert accessibility(page) == []

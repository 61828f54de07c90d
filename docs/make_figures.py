"""Draw the pictures of the documentation: screenshots of what the demonstration writes (needs Chromium)."""

from __future__ import annotations

import math
import shutil
import subprocess
import tempfile
from dataclasses import replace
from pathlib import Path

from msgspec import structs

import imulab as il
from imulab.cli import main as commands
from imulab.cli.demo import run
from imulab.procedures.centrifuge.manifest import make_manifest
from imulab.procedures.centrifuge.simulate import AxisTruth, FogTruth, RigTruth, Truth
from imulab.procedures.views import exhibits_of
from imulab.report import Card, render, render_index
from imulab.report.traces import BAD, GOOD, Exhibits, Figure

LEVELS = (1, 2, 5, 10, 15, 20, 30, 40)
FIGURES = Path(__file__).resolve().parent / "figures"


def screenshot(page: Path, picture: Path, width: int, height: int) -> None:
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        raise SystemExit("make_figures: no Chromium here (Debian package chromium)")
    with tempfile.TemporaryDirectory() as profile:
        subprocess.run(
            [
                browser, "--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking",
                "--hide-scrollbars", f"--user-data-dir={profile}", f"--window-size={width},{height}",
                "--virtual-time-budget=8000", f"--screenshot={picture}", page.as_uri(),
            ],
            check=True, capture_output=True,
        )  # fmt: skip


def centrifuge(folder: Path) -> None:
    """The report of a simulated test, and what 10 arcsec of tilt do to a perfectly linear gyroscope."""
    test = make_manifest(
        levels=[n * 9.80665 for n in LEVELS], radius=2.0, net_rate=math.radians(40), cycles=2, both_senses=True,
        sensor={"serial": "DTG-7"},
    )  # fmt: skip
    fit = il.fit_centrifuge(test, il.simulate_centrifuge(test, rate=20.0, duration=900.0, static_duration=20.0))
    il.write_report(fit.calibration, folder / "centrifuge.html")
    screenshot(folder / "centrifuge.html", FIGURES / "centrifuge.png", 1080, 890)

    K = math.radians(3.3 / 3600) / 9.80665
    tilted = RigTruth(tilt=math.radians(10 / 3600), tilt_phase=2.4, earth_rate=5.6e-5)
    one = make_manifest(levels=[n * 9.80665 for n in LEVELS], radius=2.0, net_rate=math.radians(40))
    linear = Truth(AxisTruth(D_x=K), AxisTruth(D_y=K), FogTruth(), tilted)
    fit = il.fit_centrifuge(one, il.simulate_centrifuge(one, linear, rate=50.0, duration=120.0, static_duration=20.0))
    force = [run.force / 9.80665 for run in fit.runs]
    curves = {
        "X alone": [abs(run.line[0]) / run.force for run in fit.runs],
        "Y - FOG, without the quarter turn": [abs(run.line[1] - run.line[2]) / run.force for run in fit.runs],
        "X - FOG (as reduced)": [abs(run.line[0] - run.line[2]) / run.force for run in fit.runs],
    }
    colours = dict(zip(curves, (BAD, "#b8860b", GOOD), strict=True))
    figure = Figure(
        "False nonlinearity of a perfectly linear gyroscope, table axis tilted by 10 arcsec",
        "zeta = K(a)/K(1 g) - 1 by the line at the table rate of X alone, of Y less the FOG as it is, and of "
        "X less the FOG. Noise-free.",
        [
            {"type": "scatter", "mode": "lines+markers", "x": force, "name": name,
             "y": [100 * (k / K_all[0] - 1) for k in K_all],
             "line": {"color": colours[name], "width": 2.5}, "marker": {"size": 8}}
            for name, K_all in curves.items()
        ],
        {"xaxis": {"title": {"text": "specific force, g"}, "gridcolor": "#e6eaed"},
         "legend": {"orientation": "h", "y": 1.12},
         "yaxis": {"title": {"text": "zeta, %"}, "gridcolor": "#e6eaed", "zeroline": True}},
    )  # fmt: skip
    worst = max(abs(k / curves["X alone"][0] - 1) for k in curves["X alone"])
    headline = f"Up to {100 * worst:.0f} % of false nonlinearity without the FOG, none with it."
    page = folder / "tilt.html"
    page.write_text(
        render(
            replace(fit.calibration, warnings=(), sensor={"serial": "10 arcsec of tilt, simulated"}),
            Exhibits(headline, [], [figure]),
            "Centrifuge test",
        )
    )
    screenshot(page, FIGURES / "centrifuge_tilt.png", 1080, 760)


def one_figure(folder: Path, record: str, picture: str, words: str = "") -> None:
    """One figure of a record: the first under the record's headline, or the one with these words under its own."""
    exhibits = exhibits_of(il.load(folder / record))
    figure = next(item for item in exhibits.figures if words in item.title)
    heading = figure.message if words else exhibits.headline
    card = Card(figure.title, "", [], structs.replace(figure, title="", message="" if words else figure.message))
    page = folder / f"one_{picture}.html"
    page.write_text(render_index(heading, "", [card]))
    screenshot(page, FIGURES / f"{picture}.png", 1080, figure.height + 320)


def quickstart(folder: Path) -> None:
    """The report of the run beside which the picture stands: in README, quickstart, index and tumble."""
    recording, record, report = (str(folder / name) for name in ("recording.csv", "sn42.json", "sn42.html"))
    commands(["tumble", "simulate", "--gravity", "9.81362", "-o", recording])
    commands(["tumble", "fit", recording, "--gravity", "9.81362", "-o", record, "--report", report])
    screenshot(Path(report), FIGURES / "tumble.png", 1080, 900)


def guides(folder: Path) -> None:
    """One figure of each worked example that the demonstration does not run."""
    recording, table = str(folder / "nine.csv"), str(folder / "table")
    ramps = folder / "ramps"
    for words in (
        f"tumble simulate --field 48.2uT --gravity 9.81362 -o {recording}",
        f"tumble fit {recording} --gravity 9.81362 --with gyro,mag --field 48.2uT -o {folder}/nine.json",
        f"rate simulate -o {table}",
        f"rate fit {table}/test.toml -o {folder}/rate.json",
        f"thermal simulate -o {ramps} --ramps 4",
        f"thermal fit {ramps}/tumble_25.csv {' '.join(f'{ramps}/ramp_{k}.csv' for k in range(1, 5))} "
        f"-o {folder}/thermal.json",
    ):
        commands(words.split())
    one_figure(folder, "nine.json", "gyroscopes", "gyroscopes miss")
    one_figure(folder, "nine.json", "magnetometer", "field before and after")
    one_figure(folder, "rate.json", "rate")
    one_figure(folder, "thermal.json", "thermal")


def main() -> None:
    FIGURES.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name).resolve()
        run(folder, commands)
        quickstart(folder)
        screenshot(folder / "fleet.html", FIGURES / "fleet.png", 1080, 905)
        one_figure(folder, "array.json", "gyro_array")
        one_figure(folder, "warmup.json", "warmup")
        one_figure(folder, "noise.json", "noise")
        guides(folder)
        centrifuge(folder)


if __name__ == "__main__":
    main()

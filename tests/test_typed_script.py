"""A user's script is checked by mypy --strict: the signatures say what comes back."""

import subprocess
import sys

import pytest

SCRIPT = """
from pathlib import Path

import numpy as np
import polars
from numpy.typing import NDArray

import imulab as il
from imulab.views import AnyPlot, AnyPlots

recording: il.Recording = il.Recording.from_arrays(accel=np.ones((9, 3)), rate=100.0, unit="g")
fit: il.TumbleFit = il.fit_tumble(recording, order=1, gravity=9.81, window=(1, 9))
fit.save("sn42.json")
every: AnyPlots = fit.plot()
one: AnyPlot = fit.plot("residual")
one.save("residuals.html")
layout: dict[str, object] = one.to_dict()
first: AnyPlot = every["sphere"]
drawn: AnyPlots = recording.plot()
covariance: NDArray[np.float64] = fit.cov("bias_x", "bias_y")
rows: int = fit.to_frame("polars").height
samples: polars.DataFrame = recording.to_frame("polars")
titles = list(recording.to_frame().columns)
files: list[Path] = fit.export("c", Path("firmware"))
corrected: il.Recording = fit.apply(np.ones((9, 3)), rate=100.0, unit="g")
record: il.Calibration = il.load("sn42.json")
value: float = record.parameters["bias_x"].value
changes = il.compare_records(fit, record)
noise: il.NoiseFit = il.fit_noise([recording], columns=["accel_x"], horizon=10.0)
fused: il.Fused = il.fuse(il.simulate_array(), method="mean")
rate: NDArray[np.float64] = fused.rate
il.write_report(fit, "sn42.html")
"""


@pytest.mark.slow
def test_a_script_of_a_user_is_clean(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT, encoding="utf-8")
    words = ["--strict", "--no-error-summary"]  # with the settings of the project, whose cache the lint has made
    done = subprocess.run([sys.executable, "-m", "mypy", *words, str(script)], capture_output=True, text=True)
    assert (done.stdout, done.returncode) == ("", 0)

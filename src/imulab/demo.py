"""The demonstration, as a user would script it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import imulab as il
from imulab.errors import OptionError
from imulab.present import exhibits_of
from imulab.recording import Recording
from imulab.tumble.engineering import engineering_rows
from imulab.units import from_si

_GRAVITY = 9.81362  # m/s^2, the simulated laboratory
_KNOCKED = 7


def run(folder: str | Path = "demo") -> str:
    """Simulate, fit, apply and report into `folder`; return what was found, as text.

    Raises
    ------
    OptionError
        The folder cannot be made.
    """
    home = Path(folder)
    try:
        home.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OptionError(f"{home}: the folder cannot be made: {error.strerror}") from None
    return _tumble(home)


def _tumble(home: Path) -> str:
    """A MEMS triad turned by hand through 24 attitudes, one of them knocked."""
    recording_file, record_file, report_file = home / "tumble.csv", home / "tumble.json", home / "tumble.html"
    corrected_file = home / "tumble_corrected.csv"
    il.write_csv(il.simulate_tumble(order=2, gravity=_GRAVITY, knock=_KNOCKED, seed=4), recording_file)

    recording = il.read(recording_file)
    attitudes = il.find_attitudes(recording)
    fit = il.fit_tumble(attitudes, order="auto", gravity=_GRAVITY, loss="huber")
    fit.calibration.save(record_file)
    il.write_report(fit.calibration, report_file)
    corrected = il.apply(il.load(record_file), recording)
    il.write_csv(corrected, corrected_file)

    lines = [
        f"tumble: {len(recording)} samples, {len(attitudes)} attitudes (the knocked one, before and after, "
        f"counts twice), order {fit.calibration.model['order']} chosen",
        f"  {exhibits_of(fit.calibration).headline}",
        f"  Against the simulated truth the median attitude was {_error(recording, attitudes.pieces) / 1e3:.1f} mg "
        f"off, and is {_error(corrected, attitudes.pieces) / 1e3:.3f} mg off after correction.",
    ]
    for row in engineering_rows(fit.calibration):
        value, uncertainty = row.text()
        lines.append(f"  {row.name:<22} {value:>10} ± {uncertainty:<6} {row.unit}")
    lines += [f"  note: {message}" for message in fit.calibration.warnings]
    lines += [
        f"  recording {recording_file}, record {record_file}, corrected data {corrected_file}",
        "  the same by hand:",
        f"    imulab tumble fit {recording_file} --gravity {_GRAVITY} --loss huber "
        f"-o {record_file} --report {report_file}",
        f"    imulab apply {record_file} {recording_file} -o {corrected_file}",
        f"open {report_file}",
    ]
    return "\n".join(lines)


def _error(recording: Recording, pieces: np.ndarray | None) -> float:
    """Length of the error of an attitude's mean against the simulated truth, median over the attitudes, µg."""
    error = recording.triad("accel") - recording.triad("truth_accel")
    means = [error[start:stop].mean(axis=0) for start, stop, _ in (pieces if pieces is not None else [])]
    return from_si(float(np.median(np.linalg.norm(means, axis=1))), "ug")

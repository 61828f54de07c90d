"""Records of one made-up unit, every procedure, with numbers of MEMS size."""

from __future__ import annotations

import numpy as np

from imulab.records.calibration import Calibration, Covariance, Parameter
from reference import tumble as reference

G = 9.80665
SENSOR = {"serial": "SN42", "model": "made-up"}
EDGES = [-40.0, -30.0, -20.0, -10.0, 0.0, 40.0, 50.0, 60.0]
SETTLED, TICK = 300.0, 0.005


def tumble(order=2, gyro=False, sensitive=False, seed=1, powers=1) -> Calibration:
    rng = np.random.default_rng(seed)
    units = {"b": "m/s^2", "s": "count/(m/s^2)", "m": "rad", "2": "1/(m/s^2)"}
    units |= {str(power): f"1/(m/s^2)^{power - 1}" for power in (3, 4, 5)}
    truth = reference.random_truth(rng, order, 400.0)
    parameters = {n: Parameter(value, None, units[n[1] if n[0] == "k" else n[0]]) for n, value in truth.items()}
    model = {"order": order, "output_unit": "count"}
    if gyro:
        model["gyro_output_unit"] = "count"
        for i in "xyz":
            parameters[f"gyro_bias_{i}"] = Parameter(rng.uniform(-0.02, 0.02), None, "rad/s")
            parameters[f"gyro_scale_factor_{i}"] = Parameter(rng.uniform(900, 1000), None, "count/(rad/s)")
            for p in range(2, powers + 1):
                unit = "1/(rad/s)" + (f"^{p - 1}" if p > 2 else "")
                parameters[f"gyro_k{p}_{i}"] = Parameter(rng.uniform(-3e-3, 3e-3) / 5 ** (p - 1), None, unit)
            for j in "xyz":
                if i != j:
                    parameters[f"gyro_misalignment_{i}{j}"] = Parameter(rng.uniform(-0.02, 0.02), None, "rad")
                if sensitive:
                    value = rng.uniform(-1e-4, 1e-4)
                    parameters[f"gyro_g_sensitivity_{i}{j}"] = Parameter(value, None, "rad/s/(m/s^2)")
    return Calibration("tumble", parameters, Covariance((), ()), model, {}, sensor=SENSOR)


def centrifuge() -> Calibration:
    values = {"K0": 2.3e-7, "c1": 1.5e-3, "c2": 4e-6, "direction": 0.4}
    units = {"K0": "rad/s/(m/s^2)", "c1": "1/(m/s^2)", "c2": "1/(m/s^2)^2", "direction": "rad"}
    parameters = {
        f"{axis}_{name}": Parameter(sign * value, None, units[name])
        for axis, sign in (("x", 1.0), ("y", -1.1))
        for name, value in values.items()
    }
    levels = [{"level": i, "specific_force": {"value": i * G, "unit": "m/s^2"}, "runs": [i]} for i in range(1, 16)]
    return Calibration("centrifuge", parameters, Covariance((), ()), {}, {}, sensor=SENSOR, sections={"levels": levels})


def warmup(model="knot-log-cubic", exit="zero") -> Calibration:  # noqa: A002
    rng = np.random.default_rng(len(model))
    terms = 3 if model == "exponential" else 4
    shape = (len(EDGES) - (model == "interval-cubic"), 2, terms)
    table = {
        "model": model,
        "exit": exit,
        "temperatures": EDGES,
        "axes": ["gyro_x", "gyro_z"],
        "units": ["rad/s", "rad/s"],
        "settling_time": SETTLED,
        "taper_time": 60.0,
        "time_scale": 20.0,
        "coefficients": rng.uniform(-1e-3, 1e-3, shape).tolist(),  # up to 200 deg/h each
    }
    if model == "exponential":
        table |= {"slopes": rng.uniform(-1e-5, 1e-5, shape).tolist(), "time_constants": [15.0, 90.0, 200.0]}
    return Calibration("warmup", {}, Covariance((), ()), {}, {}, sensor=SENSOR, sections={"table": table})

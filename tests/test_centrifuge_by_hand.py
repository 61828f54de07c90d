"""A whole test, both senses with encoder, from CSV files to the record: against one reduced by hand with numpy."""

import json

import numpy as np
import pytest

from reference import centrifuge as reference

G, DEG_H = reference.G, reference.DEG_H
RADIUS, RATE, SECONDS, NET = 1.7, 20.0, 200.0, np.radians(37.0)
LEVELS = (1.0, 4.0, 11.0)
U_RATE, U_RADIUS = np.radians(0.02), 1.7e-3
NOISE = np.array([3e-6, 4e-6, 2e-6])
DRIFT = np.array([3.3 * np.exp(0.5j), 2.9 * np.exp(-2.2j)]) * DEG_H / G
NAMES = [f"{axis}_{name}" for axis in "xy" for name in ("K_1", "K_2", "K_3", "zeta_2", "zeta_3", "direction")]


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    """Files of a test that imulab had no hand in, and the same as arrays by level and sense."""
    folder = tmp_path_factory.mktemp("by_hand")
    rng = np.random.default_rng(11)
    text = [
        f'radius = {{ value = {RADIUS}, standard_uncertainty = {U_RADIUS}, unit = "m" }}',
        f'rates = {{ unit = "rad/s", standard_uncertainty = {float(U_RATE)!r} }}',
    ]
    arms = np.sqrt(np.array(LEVELS) * G / RADIUS)
    still = {
        "time": np.arange(400) / RATE,
        "dtg_x": 6e-5 + 1e-7 * rng.standard_normal(400),
        "dtg_y": -3e-5 + 1e-7 * rng.standard_normal(400),
        "fog": 1e-6 + 1e-7 * rng.standard_normal(400),
        "table_angle": np.full(400, 1.0),
    }
    runs = {}
    write(folder / "still.csv", still)
    text += ["[[run]]", 'file = "still.csv"', "power_cycle = 1", 'role = "static"']
    for level, arm in enumerate(arms):
        for sense in (1, -1):
            file = f"{level}{'-+'[sense > 0]}.csv"
            table = arm - NET
            columns = reference.recording(
                rng, arm=arm, table=table, sense=sense, radius=RADIUS, start=rng.uniform(0, 6), seconds=SECONDS,
                rate=RATE, noise=NOISE, drift=DRIFT * (1 + 0.002 * LEVELS[level]), tilt=5e-5 * np.exp(0.7j),
                earth=11.0 * DEG_H * np.exp(0.2j),
            )  # fmt: skip
            write(folder / file, columns)
            runs[level, sense] = columns
            text += ["[[run]]", f'file = "{file}"', "power_cycle = 1", 'role = "loaded"', f"sense = {sense}"]
            text += [f"arm_rate = {float(arm)!r}", f"table_rate = {float(table)!r}"]
    (folder / "test.toml").write_text("\n".join(text) + "\n")
    return folder, arms, still, runs


def write(path, columns):
    data = {**columns, "table_angle": np.degrees(columns["table_angle"]) % 360.0}
    titles = {"time": "s", "table_angle": "deg"}
    head = ",".join(f"{name} [{titles.get(name, 'rad/s')}]" for name in data)
    np.savetxt(path, np.stack(list(data.values()), axis=1), fmt="%.17g", delimiter=",", header=head, comments="")


def reduced(folder, imulab, *options):
    done = imulab("centrifuge", "reduce", str(folder / "test.toml"), "--json", *options)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_least_squares(rig, imulab):
    folder, arms, _, runs = rig
    record = reduced(folder, imulab, "--curve", "c1")
    found = np.array([record["parameters"][name]["value"] for name in NAMES])
    order = [record["covariance"]["names"].index(name) for name in NAMES]
    covariance = np.array(record["covariance"]["matrix"])[np.ix_(order, order)]

    lines, spread = np.zeros((3, 2, 4)), np.zeros((3, 2, 4, 4))
    for (level, sense), columns in runs.items():
        lines[level, (1 - sense) // 2], spread[level, (1 - sense) // 2] = reference.run_lines(columns, sense * NET)
    for (level, sense), (line, matrix) in {
        key: (lines[key[0], (1 - key[1]) // 2], spread[key[0], (1 - key[1]) // 2]) for key in runs
    }.items():
        row = record["runs"][1 + 2 * level + (1 - sense) // 2]
        for axis, pair in (("x", slice(0, 2)), ("y", slice(2, 4))):
            assert (row[axis]["A"], row[axis]["B"]) == pytest.approx(line[pair], abs=3e-4 * np.hypot(*line[pair]))
            assert np.trace(row[axis]["covariance"]) == pytest.approx(np.trace(matrix[pair, pair]), rel=0.6)
    force = np.array(LEVELS) * G
    variances = np.stack(
        [np.trace(spread[:, :, 2 * a : 2 * a + 2, 2 * a : 2 * a + 2], axis1=2, axis2=3) for a in (0, 1)], axis=-1
    ).sum(axis=1) / (8 * force**2)[:, None]  # fmt: skip
    arm = np.repeat(arms[:, None], 2, axis=1)

    def of(lines=lines, arm=arm, radius=RADIUS):
        return reference.parameters(lines, arm, radius, variances)

    expected = of()
    # Every cause of uncertainty, by differences: noise of each line, rate of each run, the radius.
    total = np.outer(*[(of(radius=RADIUS * 1.0001) - expected) / 1e-4 * U_RADIUS / RADIUS] * 2)
    for level in range(3):
        for sense in (0, 1):
            other = arm.copy()
            other[level, sense] += 1e-6
            total += np.outer(*[(of(arm=other) - expected) / 1e-6 * U_RATE] * 2)
            step = 1e-3 * np.abs(lines[level, sense]).max()
            J = np.empty((len(NAMES), 4))
            for k in range(4):
                other = lines.copy()
                other[level, sense, k] += step
                J[:, k] = (of(lines=other) - expected) / step
            total += J @ spread[level, sense] @ J.T
    u = np.sqrt(np.diag(total))
    # The Rice correction and the weights of the direction rest on noise as estimated, here white and there by blocks.
    np.testing.assert_array_less(np.abs(found - expected), 0.02 * u)
    # 2 x 126 degrees of freedom: a standard uncertainty is known to 4.5 %.
    own = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(own, u, rtol=0.15)
    np.testing.assert_allclose(covariance / np.outer(own, own), total / np.outer(u, u), atol=0.1)
    # And the truth: the curve by hand from the K_i, K(a) = K0 (1 + c1 a).
    for axis, size in (("x", abs(DRIFT[0])), ("y", abs(DRIFT[1]))):
        for name, value in (("K0", size), ("c1", 0.002 / G)):
            p = record["parameters"][f"{axis}_{name}"]
            assert abs(p["value"] - value) < 4 * p["standard_uncertainty"]
        assert record["parameters"][f"{axis}_K0"]["unit"] == "rad/s/(m/s^2)"
        assert record["parameters"][f"{axis}_c1"]["unit"] == "1/(m/s^2)"


def test_fourier(rig, imulab):
    folder, arms, still, runs = rig
    record = reduced(folder, imulab, "--method", "fourier")
    for axis, name in (("x", "dtg_x"), ("y", "dtg_y")):
        K = []
        for level, arm in enumerate(arms):
            pair = []
            for sense in (1, -1):
                c = runs[level, sense]
                sums = {}
                for channel in (name, "fog"):
                    A, B, m, _ = reference.fourier(c[channel] - still[channel].mean(), arm - NET, 1 / RATE)
                    # The sums go with +w_s t from the first sample; chi starts at table_angle and goes with sense.
                    sums[channel] = (A + 1j * sense * B) * np.exp(1j * c["table_angle"][0])
                pair.append((sums[name] - sums["fog"] * (1 if axis == "x" else 1j)) / (arm**2 * RADIUS))
                assert record["runs"][1 + 2 * level + (1 - sense) // 2]["periods"] == m
            K.append(abs(np.mean(pair)))
        for level in range(3):
            assert record["parameters"][f"{axis}_K_{level + 1}"]["value"] == pytest.approx(K[level], rel=1e-9)
        for level in (1, 2):
            zeta = record["parameters"][f"{axis}_zeta_{level + 1}"]["value"]
            assert zeta == pytest.approx((K[level] - K[0]) / K[0], abs=1e-9)
    assert {"x_K0", "x_direction", "y_K0", "y_direction"} <= set(record["parameters"])

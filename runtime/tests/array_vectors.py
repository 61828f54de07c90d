"""What the methods of a gyro array must compute: plain Python in double, the robust one from tests/reference."""

import math
import random
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests"))
from write_c import emit

from reference import gyro_array as reference

ELEMENTS, SAMPLES, RATE = 6, 400, 50.0
TURN = [math.ldexp(round(math.ldexp(0.2 * math.sin(0.02 * k), 20)), -20) for k in range(SAMPLES)]  # rad/s
EVERY = 7  # samples between two that are written down


def base_readings():
    """A slow turn seen by six unequal gyros; multiples of 2^-20, so that float and double start alike."""
    rng = random.Random(5)
    offset = [rng.uniform(-5e-3, 5e-3) for _ in range(ELEMENTS)]
    sigma = [1e-3 * rng.uniform(0.6, 1.6) for _ in range(ELEMENTS)]
    return [
        [math.ldexp(round(math.ldexp(turn + b + rng.gauss(0, s), 20)), -20) for b, s in zip(offset, sigma)]
        for turn in TURN
    ]


def faulty(scenario, base, k, i):
    """Reading k of gyro i in three of the scenarios of arrays.h, which has all."""
    if scenario == 4 and i == 0 and 100 <= k < 130:  # bursts of what is not a number
        return math.nan
    if scenario == 4 and i == 4 and 200 <= k < 205:
        return math.inf
    if scenario == 7 and 200 <= k < 210:  # all lost
        return math.nan
    if scenario == 8 and i != 4 and 200 <= k < 260:  # all but one
        return -math.inf
    return base[k][i]


SCENARIOS = 16
HEALTHY_MEMORY = 0.015625  # a fixed gain


def support(rows, kernel):
    spread, count, out = 0.0, 0, []
    for z in rows:
        good = [x for x in z if math.isfinite(x)]
        m = len(good)
        if m == 0:
            out.append(math.nan)
            continue
        if m == 1:
            out.append(good[0])
            continue
        pairs = [(i, j) for i in range(m) for j in range(i)]
        count += 1
        mean_square = sum((good[i] - good[j]) ** 2 for i, j in pairs) / len(pairs)
        spread += (mean_square - spread) / count
        weight = [0.0] * m
        for i, j in pairs:
            square = (good[i] - good[j]) ** 2 / spread
            degree = math.exp(-square / 2) if kernel == 0 else math.exp(-math.sqrt(square))
            weight[i] += degree
            weight[j] += degree
        out.append(sum(w * x for w, x in zip(weight, good)) / sum(weight))
    return out


def least_squares(rows, memory):
    method = reference.LeastSquares(ELEMENTS, memory)
    return [method.step(z) for z in rows]


def fixed(rows, weights):
    out = []
    for z in rows:
        good = [i for i in range(ELEMENTS) if math.isfinite(z[i])]
        total = sum(weights[i] for i in good)
        out.append(sum(weights[i] * z[i] for i in good) / total if good else math.nan)
    return out


def kalman(rows, gain, first, given):
    """Virtual gyro with a constant gain; a missing gyro is given the mean innovation of the others."""
    rate, b, out = None, [0.0] * ELEMENTS, []
    for z in rows:
        good = [i for i in range(ELEMENTS) if math.isfinite(z[i])]
        if not good:
            out.append(math.nan)
            continue
        mean = sum(z[i] for i in good) / len(good)
        if rate is None:
            if first:
                b = [z[i] - mean if i in good else 0.0 for i in range(ELEMENTS)]
            elif given is not None:
                b = list(given)
            rate = sum(z[i] - b[i] for i in good) / len(good)
        innovation = {i: z[i] - rate - b[i] for i in good}
        usual = sum(innovation.values()) / len(good)
        v = [innovation.get(i, usual) for i in range(ELEMENTS)]
        rate += sum(gain[0][i] * v[i] for i in range(ELEMENTS))
        b = [b[i] + sum(gain[i + 1][j] * v[j] for j in range(ELEMENTS)) for i in range(ELEMENTS)]
        out.append(rate)
    return out


def thinned(runs):
    return [run[::EVERY] for run in runs]


def array():
    rng = random.Random(6)
    base = base_readings()
    emit("v_array_base", base)
    emit("v_array_turn", [TURN[k] for k in range(SAMPLES)])

    rates = []
    for memory in (None, HEALTHY_MEMORY):
        method = reference.Robust(ELEMENTS, rate=RATE, memory=memory)
        rates.append([method.step(z) for z in base])
    emit("v_robust_rate", thinned(rates))
    reliability = [1.0, 4.0, 0.5, 2.0, 9.0, 1.5]
    emit("v_array_reliability", reliability)
    method = reference.Robust(ELEMENTS, rate=RATE, reliability=reliability)
    emit("v_robust_calibrated", thinned([[method.step(z) for z in base]])[0])

    bias = [rng.uniform(-5e-3, 5e-3) for _ in range(ELEMENTS)]
    emit("v_array_bias", bias)
    feedback = []
    for initial, memory, start in (
        ("first", None, 1),
        ("zero", None, 1),
        (bias, None, 1),
        ("first", 0.125, 1),
        ("zero", None, 40),
    ):
        method = reference.Feedback(ELEMENTS, initial, memory, start)
        feedback.append([method.step(z) for z in base])
    emit("v_feedback_rate", thinned(feedback))
    lost = [[faulty(4, base, k, i) for i in range(ELEMENTS)] for k in range(SAMPLES)]
    gone = [[faulty(8, base, k, i) for i in range(ELEMENTS)] for k in range(SAMPLES)]
    none = [[faulty(7, base, k, i) for i in range(ELEMENTS)] for k in range(SAMPLES)]
    emit("v_mean_rate", thinned([fixed(rows, [1.0] * ELEMENTS) for rows in (lost, gone, none)]))
    emit("v_covariance_rate", thinned([fixed(rows, reliability) for rows in (lost, gone, none)]))
    emit("v_support_rate", [thinned([support(rows, kernel) for rows in (lost, gone, none)]) for kernel in (0, 1)])
    emit("v_least_squares_rate", thinned([least_squares(base, None), least_squares(base, 0.125)]))
    gain = [[0.05 / ELEMENTS * rng.uniform(0.8, 1.2) for _ in range(ELEMENTS)]]
    gain += [[(0.01 if i == j else -0.002) * rng.uniform(0.8, 1.2) for j in range(ELEMENTS)] for i in range(ELEMENTS)]
    emit("v_kalman_gain", gain)
    emit(
        "v_kalman_rate",
        thinned([kalman(lost, gain, True, None), kalman(gone, gain, False, None), kalman(none, gain, False, bias)]),
    )
    # Three axes of two gyros each: offset and alignment first, then the mean.
    offset = [[rng.uniform(-0.01, 0.01) for _ in range(2)] for _ in range(3)]
    matrix = [[[(i == j) + rng.uniform(-0.1, 0.1) for j in range(3)] for i in range(3)] for _ in range(2)]
    reading = [[[rng.uniform(-1, 1) for _ in range(2)] for _ in range(3)] for _ in range(4)]
    out = []
    for sample in reading:
        z = [
            [sum(matrix[e][r][c] * (sample[c][e] - offset[c][e]) for c in range(3)) for e in range(2)] for r in range(3)
        ]
        out.append([sum(row) / 2 for row in z])
    emit("v_aligned_offset", offset)
    emit("v_aligned_matrix", matrix)
    emit("v_aligned_reading", reading)
    emit("v_aligned_rate", out)

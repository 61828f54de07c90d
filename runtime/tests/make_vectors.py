#!/usr/bin/env python3
"""Write vectors.h: what the C core must compute, from equations transcribed apart.

Imports nothing of imulab. Triads, drift and warm-up are computed with 60 decimal digits; blobs are packed by hand; the
array's methods are plain Python in double, the robust one from tests/reference.

`make_vectors.py --seeds DIR` writes the blobs, a file each, for the fuzzer.
"""

import math
import random
import struct
import sys
import zlib
from decimal import Decimal, getcontext
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parents[1] / "tests"))
from reference import gyro_array as reference  # noqa: E402

getcontext().prec = 60
G = 9.80665
LINES = []


def d(x):
    return Decimal(x)


# ---- writing C -----------------------------------------------------------------------------------------------------


def number(x):
    x = float(x)
    if math.isnan(x):
        return "VNAN"
    return f"R({x!r})"


def nested(values):
    """A C initialiser, broken into lines of readable length."""
    if not isinstance(values, (list, tuple)):
        return number(values)
    inner, line = "", 0
    for value in values:
        text = nested(value) + ","
        fresh = isinstance(value, (list, tuple)) or line + len(text) > 110
        inner += ("\n" if fresh else " ") + text
        line = len(text) if fresh else line + 1 + len(text)
    return "{" + inner.strip() + "}"


def shape(values):
    return f"[{len(values)}]" + shape(values[0]) if isinstance(values, (list, tuple)) else ""


def emit(name, values):
    LINES.append(f"static const il_real {name}{shape(values)} = {nested(values)};")


def emit_bytes(name, data):
    LINES.append(f"static const uint8_t {name}[{len(data)}] = {{")
    LINES.extend("    " + ", ".join(map(str, data[i : i + 28])) + "," for i in range(0, len(data), 28))
    LINES.append("};")


def emit_words(name, words):
    LINES.append(f"static const uint32_t {name}[{len(words)}] = {{{', '.join(f'{w}u' for w in words)}}};")


def polynomial(coefficients, u):
    """c0 + c1 u + c2 u^2 + ..., powers written out."""
    total, power = d(0), d(1)
    for c in coefficients:
        total, power = total + d(c) * power, power * u
    return total


# ---- triads --------------------------------------------------------------------------------------------------------


def forward(s, k):
    """A = s + k2 s^2 + k3 s^3 ..."""
    return s + sum(c * s ** (p + 2) for p, c in enumerate(k))


def slope(s, k):
    return 1 + sum((p + 2) * c * s ** (p + 1) for p, c in enumerate(k))


def turning(k, sign):
    """A at the turning point next to zero on one side, by a walk and a bisection; the largest float without any."""
    k, step, s = [d(c) for c in k], d(sign) / 100, d(0)
    for _ in range(200_000):
        if slope(s + step, k) <= 0:
            break
        s += step
    else:
        return sign * 3e38
    low, high = s, s + step
    for _ in range(190):
        middle = (low + high) / 2
        low, high = (middle, high) if slope(middle, k) > 0 else (low, middle)
    return float(forward(low, k))


def solve(a, k):
    """The s next to zero with A(s) = a."""
    k, a = [d(c) for c in k], d(a)
    s = a
    for _ in range(300):
        s -= (forward(s, k) - a) / slope(s, k)
    assert abs(forward(s, k) - a) < d("1e-45")
    return s


def tumble():
    rng = random.Random(1)
    settings, outputs, forces = [], [], []
    for order in range(1, 6):
        gain = [1 / (rng.uniform(0.9, 1.1) * 400) for _ in range(3)]
        bias = [rng.uniform(-0.3, 0.3) for _ in range(3)]
        m = [rng.uniform(-0.02, 0.02) for _ in range(3)]
        k = [[rng.uniform(-3e-3, 3e-3) / G ** (p - 1) for _ in range(3)] for p in range(2, order + 1)]
        low = [turning([c[i] for c in k], -1) for i in range(3)]
        high = [turning([c[i] for c in k], 1) for i in range(3)]
        settings.append([gain, bias, m, low, high, k + [[0.0] * 3] * (4 - len(k))])
        rows_in, rows_out = [], []
        for _ in range(12):
            raw = [rng.uniform(-2 * G, 2 * G) / g for g in gain]
            x, y, z = (solve(d(raw[i]) * d(gain[i]) - d(bias[i]), [c[i] for c in k]) for i in range(3))
            y -= d(m[0]) * x
            z -= d(m[1]) * x + d(m[2]) * y
            rows_in.append(raw)
            rows_out.append([x, y, z])
        outputs.append(rows_in)
        forces.append(rows_out)
    for name, column in zip(("gain", "bias", "misalignment", "low", "high", "nonlinearity"), zip(*settings)):
        emit(f"v_tumble_{name}", list(column))
    emit("v_tumble_output", outputs)
    emit("v_tumble_force", forces)


def gyro():
    rng = random.Random(2)

    def matrix(size):
        return [[rng.uniform(-size, size) for _ in range(3)] for _ in range(3)]

    gain, bias = [rng.uniform(0.9e-3, 1.1e-3) for _ in range(3)], [rng.uniform(-0.02, 0.02) for _ in range(3)]
    turn, g = matrix(0.02), matrix(1e-4)
    for i in range(3):
        turn[i][i] += 1
    output = [[rng.uniform(-5000, 5000) for _ in range(3)] for _ in range(10)]
    force = [[rng.uniform(-2 * G, 2 * G) for _ in range(3)] for _ in range(10)]
    emit("v_gyro_gain", gain)
    emit("v_gyro_bias", bias)
    emit("v_gyro_turn", turn)
    emit("v_gyro_sensitivity", g)
    emit("v_gyro_output", output)
    emit("v_gyro_force", force)
    for name, share in (("plain", 0), ("rate", 1)):
        rates = []
        for m, f in zip(output, force):
            s = [
                d(m[i]) * d(gain[i]) - d(bias[i]) - share * sum(d(g[i][j]) * d(f[j]) for j in range(3))
                for i in range(3)
            ]
            rates.append([sum(d(turn[i][j]) * s[j] for j in range(3)) for i in range(3)])
        emit(f"v_gyro_{name}", rates)
    settings, bent = [], []
    for order in range(2, 6):
        k = [[rng.uniform(-3e-3, 3e-3) / 5 ** (p - 1) for _ in range(3)] for p in range(2, order + 1)]
        low, high = ([turning([c[i] for c in k], sign) for i in range(3)] for sign in (-1, 1))
        settings.append([low, high, k + [[0.0] * 3] * (4 - len(k))])
        rates = []
        for m, f in zip(output, force):
            s = [
                solve(
                    d(m[i]) * d(gain[i]) - d(bias[i]) - sum(d(g[i][j]) * d(f[j]) for j in range(3)),
                    [c[i] for c in k],
                )
                for i in range(3)
            ]
            rates.append([sum(d(turn[i][j]) * s[j] for j in range(3)) for i in range(3)])
        bent.append(rates)
    for name, column in zip(("low", "high", "nonlinearity"), zip(*settings)):
        emit(f"v_gyro_{name}", list(column))
    emit("v_gyro_bent", bent)


def mag():
    """Field of outputs by the exact equations, order 1 and 2, in decimal arithmetic."""
    rng = random.Random(4)
    gain, bias = [rng.uniform(0.9e-2, 1.1e-2) for _ in range(3)], [rng.uniform(-0.8, 0.8) for _ in range(3)]
    turn = [[rng.uniform(-0.2, 0.2) for _ in range(3)] for _ in range(3)]
    for i in range(3):
        turn[i][(i + 1) % 3] += 1  # outputs are renamed
    k2 = [0.02, -0.015, 0.01]
    output = [[rng.uniform(-200, 200) for _ in range(3)] for _ in range(10)]
    emit("v_mag_gain", gain)
    emit("v_mag_bias", bias)
    emit("v_mag_turn", turn)
    emit("v_mag_quadratic", k2)
    emit("v_mag_output", output)
    for name, share in (("plain", 0), ("field", 1)):
        fields = []
        for m in output:
            s = [d(m[i]) * d(gain[i]) - d(bias[i]) for i in range(3)]
            if share:
                s = [2 * a / (1 + (1 + 4 * d(k) * a).sqrt()) for a, k in zip(s, k2)]
            fields.append([sum(d(turn[i][j]) * s[j] for j in range(3)) for i in range(3)])
        emit(f"v_mag_{name}", fields)


def centrifuge():
    rng = random.Random(3)
    k0, c1, c2 = [2.3e-7, -1.9e-7], [1.5e-3, -2e-3], [4e-6, 1e-6]
    theta = [0.4, 2.1]
    cosine, sine = [math.cos(t) for t in theta], [math.sin(t) for t in theta]
    force = [[rng.uniform(-100, 100), rng.uniform(-100, 100)] for _ in range(10)]
    rate = [[rng.uniform(-1e-3, 1e-3), rng.uniform(-1e-3, 1e-3)] for _ in range(10)]
    out = []
    for f, w in zip(force, rate):
        fx, fy = d(f[0]), d(f[1])
        a = (fx * fx + fy * fy).sqrt()
        out.append(
            [
                d(w[i]) - d(k0[i]) * (1 + d(c1[i]) * a + d(c2[i]) * a * a) * (fx * d(cosine[i]) + fy * d(sine[i]))
                for i in range(2)
            ]
        )
    for name, values in (("k0", k0), ("c1", c1), ("c2", c2), ("cosine", cosine), ("sine", sine)):
        emit(f"v_centrifuge_{name}", values)
    emit("v_centrifuge_force", force)
    emit("v_centrifuge_rate", rate)
    emit("v_centrifuge_expected", out)


# ---- warm-up -------------------------------------------------------------------------------------------------------

EDGES = [-40.0, -30.0, -20.0, -10.0, 0.0, 40.0, 50.0, 60.0]
STARTS = [-40.0, -40.01, -30.001, -30.0, -25.0, 20.0, 59.99, 60.0, 60.01, float("nan")]
TICK, T_M, TAPER, TAU0 = 0.125, 300.0, 60.0, 20.0
TICKS = [0, 1, 777, 2399, 2400, 2401, 2640, 2879, 2880, 5000, 4294967295]
CONSTANTS = [15.0, 90.0, 200.0]


def warmup():
    rng = random.Random(4)
    size = 3e-4  # rad/s
    coefficient = [[[rng.uniform(-size, size) for _ in range(4)] for _ in range(2)] for _ in range(8)]
    slopes = [[[rng.uniform(-size, size) / 10 for _ in range(3)] for _ in range(2)] for _ in range(8)]
    emit("v_warmup_edges", EDGES)
    emit("v_warmup_coefficient", coefficient)
    emit("v_warmup_amplitude", [[axis[:3] for axis in row] for row in coefficient])
    emit("v_warmup_slope", slopes)
    emit("v_warmup_constant", CONSTANTS)
    emit("v_warmup_starts", STARTS)
    emit_words("v_warmup_ticks", TICKS)
    for name, value in (("tick", TICK), ("settling", T_M), ("taper", TAPER), ("scale", TAU0)):
        emit(f"v_warmup_{name}", value)

    def at(model, start, axis, t):
        """Z(t) of the table for a unit powered on at `start`."""
        rows = [row[axis] for row in coefficient]
        if model == 0:
            row = next(i for i in range(7) if start < EDGES[i + 1] or i == 6)
            return polynomial(rows[row], t / d(T_M))
        low = next(i for i in range(7) if start <= EDGES[i + 1])
        h = d(EDGES[low + 1]) - d(EDGES[low])
        x = (d(start) - d(EDGES[low])) / h
        if model < 3:
            u = t / d(T_M) if model == 1 else (1 + t / d(TAU0)).ln() / (1 + d(T_M) / d(TAU0)).ln()
            return polynomial([d(a) * (1 - x) + d(b) * x for a, b in zip(rows[low], rows[low + 1])], u)
        total = d(0)
        for j in range(3):
            y0, y1 = d(rows[low][j]), d(rows[low + 1][j])
            m0, m1 = d(slopes[low][axis][j]), d(slopes[low + 1][axis][j])
            value = (2 * x**3 - 3 * x**2 + 1) * y0 + (x**3 - 2 * x**2 + x) * h * m0
            value += (3 * x**2 - 2 * x**3) * y1 + (x**3 - x**2) * h * m1
            total += value * (-t / d(CONSTANTS[j])).exp()
        return total

    def bias(model, rule, start, axis, ticks):
        if not EDGES[0] <= start <= EDGES[-1]:
            return 0
        t = ticks * d(TICK)
        if t < d(T_M):
            return at(model, start, axis, t)
        if rule == 0 or (rule == 2 and t >= d(T_M + TAPER)):
            return 0
        share = 1 if rule == 1 else (d(T_M + TAPER) - t) / d(TAPER)
        return share * at(model, start, axis, d(T_M))

    expected = [
        [[[[bias(m, e, s, a, t) for a in range(2)] for t in TICKS] for s in STARTS] for e in range(3)] for m in range(4)
    ]
    emit("v_warmup_bias", expected)


# ---- gyro array ----------------------------------------------------------------------------------------------------

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


# ---- blobs ---------------------------------------------------------------------------------------------------------


def section(kind, *parts):
    payload = b"".join(parts)
    return struct.pack("<II", kind, len(payload)) + payload


def blob(width, *sections, version=1):
    body = b"".join(sections)
    head = b"\x89IMULAB\n" + struct.pack("<HHI", version, width, 20 + len(body))
    return head + body + struct.pack("<I", zlib.crc32(head + body))


def words(*values):
    return struct.pack(f"<{len(values)}I", *values)


def reals(width, *values):
    return struct.pack(f"<{len(values)}{'d' if width == 8 else 'f'}", *values)


def counted(width, n, start):
    """n numbers that say where they stand, all exact in float."""
    return reals(width, *(start + i / 8 for i in range(n)))


def make_sections(w):
    tumble_of = [
        section(1, words(order), counted(w, 15, order), counted(w, 3 * (order - 1), 50)) for order in range(1, 6)
    ]
    gyro_of = [section(2, words(0), counted(w, 15, 1)), section(2, words(1), counted(w, 24, 1))]
    drift = section(3, words(1, 0), counted(w, 11, 2))
    warm = []
    for model in range(4):
        terms, rows = (4, 2 if model == 0 else 3) if model < 3 else (2, 3)
        head = words(model, model % 3, 3, 2, terms) + reals(w, 300, 60, 20, 15, 90, 200) + reals(w, -40, 0, 60)
        tables = counted(w, rows * 2 * terms, 1) + (counted(w, rows * 2 * terms, 100) if model == 3 else b"")
        warm.append(section(4, head, tables))
    sensors = []
    for method in range(7):
        n, axes = 3, 3 if method == 4 else 1
        mask = [1, 2, 4, 8, 7, 8, 16][method]
        size = axes * n * (mask & 1) + n * axes * axes * (mask >> 1 & 1) + axes * n * (mask >> 2 & 1)
        size += axes * n * (mask >> 3 & 1) + axes * (n + 1) * n * (mask >> 4 & 1)
        head = words(method, n, axes, 2 if mask & 4 else 0, 1, 1, 100, 20, 10, 5, mask)
        sensors.append(section(5, head, reals(w, 0.25, 6, 4, 0.0078125, 0.5, 0.0625), counted(w, size, 1)))
    return tumble_of, gyro_of, drift, warm, sensors


def make_blobs(w):
    tumble_of, gyro_of, drift, warm, sensors = make_sections(w)
    text = section(0, b'{"format": "imulab.blob"}')
    made = [blob(w), blob(w, text), blob(w, text, tumble_of[1], gyro_of[1], drift, warm[3], sensors[4])]
    field = [section(6, words(1), counted(w, 15, 3)), section(6, words(2), counted(w, 18, 3))]
    crossed = section(1, words(256 + 2), counted(w, 15, 2), counted(w, 6, 50))  # with cross terms
    laws = [
        section(7, words(pieces, terms), counted(w, pieces + 1, -20), counted(w, 9 * pieces * terms, 30))
        for pieces, terms in ((1, 4), (3, 2))
    ]
    bent = section(2, words(1, 3), counted(w, 24, 1), counted(w, 12, 60))  # of order 3: version 2
    made += [blob(w, s) for s in (*tumble_of, *gyro_of, drift, crossed, *warm, *sensors, *field, *laws)]
    return [*made, blob(w, bent, version=2)]


def blobs():
    for w in (4, 8):
        made = make_blobs(w)
        for i, data in enumerate(made):
            emit_bytes(f"v_blob{w}_{i}", data)
        names = ", ".join(f"v_blob{w}_{i}" for i in range(len(made)))
        LINES.append(f"static const uint8_t *const v_blob{w}[] = {{{names}}};")
        LINES.append(f"static const size_t v_blob{w}_size[] = {{{', '.join(str(len(b)) for b in made)}}};")
    LINES.append(f"enum {{ V_BLOBS = {len(made)}, V_BLOB_WHOLE = 2, V_BLOB_TUMBLE = 3, V_BLOB_GYRO = 8 }};")
    LINES.append(
        "enum { V_BLOB_DRIFT = 10, V_BLOB_CROSS = 11, V_BLOB_WARMUP = 12, V_BLOB_ARRAY = 16, V_BLOB_MAG = 23,"
        " V_BLOB_THERMAL = 25, V_BLOB_BENT = 27 };"
    )
    letters = b"imulab " * 40
    emit_bytes("v_crc_bytes", letters)
    LINES.append(f"static const uint32_t v_crc = {zlib.crc32(letters)}u;")


def write_seeds(folder):
    """The blobs for the fuzzer, whose first byte says what it mends: once nothing, once size and CRC."""
    folder.mkdir(parents=True, exist_ok=True)
    for w in (4, 8):
        for i, data in enumerate(make_blobs(w)):
            for choice in (2, 3 + (w & 8) // 2):
                (folder / f"{w}-{i}-{choice}").write_bytes(bytes([choice]) + data)


def main():
    if sys.argv[1:2] == ["--seeds"]:
        write_seeds(Path(sys.argv[2]))
        return
    for part in (tumble, gyro, mag, centrifuge, warmup, array, blobs):
        part()
    head = [
        "/* Written by make_vectors.py; do not edit. */",
        "#ifndef VECTORS_H",
        "#define VECTORS_H",
        "",
        "#include <math.h>",
        "",
        '#include "imulab.h"',
        "",
        "#define R(x) ((il_real)(x))",
        "#define VNAN ((il_real)NAN)",
        "",
        f"enum {{ V_ELEMENTS = {ELEMENTS}, V_SAMPLES = {SAMPLES}, V_EVERY = {EVERY}, V_SCENARIOS = {SCENARIOS} }};",
        f"enum {{ V_STARTS = {len(STARTS)}, V_TICKS = {len(TICKS)} }};",
        "",
    ]
    text = "\n".join([*head, *LINES, "", "#endif", ""])
    (HERE / "vectors.h").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()

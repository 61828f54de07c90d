#!/usr/bin/env python3
"""Write vectors.h: what the C core must compute, from equations transcribed apart.

Imports nothing of imulab. Triads, drift and warm-up are computed here, with 60 decimal digits; array_vectors.py has the
array's methods, imus_vectors.py whole IMUs (with numpy), pack_blobs.py the blobs.

`make_vectors.py --seeds DIR` writes the blobs, a file each, for the fuzzer.
"""

import math
import random
import sys
import zlib
from decimal import Decimal, getcontext
from pathlib import Path

from array_vectors import ELEMENTS, EVERY, SAMPLES, SCENARIOS, array
from imus_vectors import imus
from pack_blobs import make_blobs, write_seeds
from write_c import LINES, emit, emit_bytes, emit_words

HERE = Path(__file__).resolve().parent
getcontext().prec = 60
G = 9.80665


def d(x):
    return Decimal(x)


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


# ---- blobs ---------------------------------------------------------------------------------------------------------


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
        " V_BLOB_THERMAL = 25, V_BLOB_BENT = 27, V_BLOB_THERMAL_GYRO = 28, V_BLOB_IMUS = 30 };"
    )
    letters = b"imulab " * 40
    emit_bytes("v_crc_bytes", letters)
    LINES.append(f"static const uint32_t v_crc = {zlib.crc32(letters)}u;")


def main():
    if sys.argv[1:2] == ["--seeds"]:
        write_seeds(Path(sys.argv[2]))
        return
    for part in (tumble, gyro, mag, centrifuge, warmup, array, imus, blobs):
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

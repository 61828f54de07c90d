"""The equations of the warm-up table, transcribed apart: plain loops and powers of t in seconds, on the raw samples."""

from __future__ import annotations

import math

import numpy as np


def pick_interval(edges, temperature):
    """Index of the half-open interval, the last one closed; None outside or for nan."""
    for i in range(len(edges) - 1):
        last = i == len(edges) - 2
        if edges[i] <= temperature and (temperature < edges[i + 1] or (last and temperature <= edges[i + 1])):
            return i
    return None


def source_fit(time, values, settling_time):
    """Powers-of-t coefficients B_0 .. B_3 of samples pooled over cycles: lists of arrays."""
    t = np.concatenate([x[x < settling_time] for x in time])
    y = np.concatenate([v[x < settling_time] for x, v in zip(time, values, strict=True)])
    # Legendre polynomials on [0, T_M] keep the condition low; converted to powers at the end.
    series = np.polynomial.Legendre.fit(t, y, 3, domain=[0, settling_time])
    return series.convert(kind=np.polynomial.Polynomial, domain=[-1, 1], window=[-1, 1]).coef


def least_squares(functions, time, values):
    """Coefficients of arbitrary basis functions, from raw samples."""
    design = np.column_stack([f(time) for f in functions])
    return np.linalg.lstsq(design, values, rcond=None)[0]


def cubic(b, t):
    return b[0] + b[1] * t + b[2] * t**2 + b[3] * t**3


def z_at(section, axis, t, temperature):
    """Z of one axis at one instant by the section ``table`` of a record, in scalar arithmetic; 0 outside."""
    at = section["temperatures"]
    if math.isnan(temperature) or temperature < at[0] or temperature > at[-1]:
        return 0.0
    end, rule = section["settling_time"], section["exit"]
    if t >= end:
        if rule == "zero":
            return 0.0
        share = 1.0 if rule == "hold" else max(0.0, 1 - (t - end) / section["taper_time"])
        return share * _before_end(section, axis, end, temperature)
    return _before_end(section, axis, t, temperature)


def _before_end(section, axis, t, temperature):
    at, end = section["temperatures"], section["settling_time"]
    i = pick_interval(at, temperature)
    c = [row[axis] for row in section["coefficients"]]
    model = section["model"]
    if model == "interval-cubic":
        return cubic(c[i], t / end)
    width = at[i + 1] - at[i]
    s = (temperature - at[i]) / width
    if model == "exponential":
        d = [row[axis] for row in section["slopes"]]
        total = 0.0
        for j, tau in enumerate(section["time_constants"]):
            h = 2 * s**3 - 3 * s**2 + 1, s**3 - 2 * s**2 + s, -2 * s**3 + 3 * s**2, s**3 - s**2
            a = h[0] * c[i][j] + h[1] * width * d[i][j] + h[2] * c[i + 1][j] + h[3] * width * d[i + 1][j]
            total += a * math.exp(-t / tau)
        return total
    u = t / end
    if model == "knot-log-cubic":
        tau = section["time_scale"]
        u = math.log(1 + t / tau) / math.log(1 + end / tau)
    return (1 - s) * cubic(c[i], u) + s * cubic(c[i + 1], u)

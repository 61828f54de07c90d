"""Equations of the centrifuge test transcribed apart from imulab (which this module does not import).

Source: CN102636185A (reduction), GUM (uncertainties); the table of lines is worked out by hand from the error model.
"""

from __future__ import annotations

import numpy as np

G = 9.80665
DEG_H = np.pi / 180 / 3600


def fourier(residual, rate, step):
    """A, B by the source's sums: N = m T / t rounded, samples from the first one."""
    period = 2 * np.pi / rate
    m = int(np.floor(len(residual) * step / period + 1e-9))
    N = round(m * period / step)
    j = np.arange(N)
    A = 2 / N * np.sum(residual[:N] * np.cos(j * rate * step))
    B = 2 / N * np.sum(residual[:N] * np.sin(j * rate * step))
    return A, B, m, N


def regression(time, chi, net_rate, channel):
    """Lines of a channel by one least-squares fit over all samples; returns coefficients and (J'J)^-1."""
    middle = time - time.mean()
    columns = [np.ones_like(time), middle]
    for k in (1, 2, 3):
        columns += [np.cos(k * chi), np.sin(k * chi)]
    columns += [np.cos(net_rate * (time - time[0])), np.sin(net_rate * (time - time[0]))]
    J = np.stack(columns, axis=1)
    return np.linalg.lstsq(J, channel, rcond=None)[0], np.linalg.inv(J.T @ J)


def k_and_zeta_uncertainty(K, amplitude, sigma, arm_rate, u_arm, u_radius_relative):
    """u(K_i), u(zeta_i) and the covariance of the zeta_i from the document's formulas; index 0 is the reference."""
    noise = (sigma / amplitude) ** 2 + (2 * u_arm / arm_rate) ** 2
    u_K = K * np.sqrt(noise + u_radius_relative**2)
    zeta = K / K[0] - 1
    count = len(K) - 1
    covariance = np.empty((count, count))
    for i in range(count):
        for j in range(count):
            common = noise[0] + (noise[i + 1] if i == j else 0.0)
            covariance[i, j] = (1 + zeta[i + 1]) * (1 + zeta[j + 1]) * common
    return u_K, covariance


def table_of_lines(p, arm, table, force):
    """Heights and phases of X's and the FOG's lines as complex C in Re[C exp(i k chi)], by hand.

    p: dict with K, scale_x, scale_f, bias_x, bias_f, mu_x, mu_f, quadratic, cubic, tilt, tilt_phase, flexure,
    flexure_phase, earth, earth_phase, base, base_phase.
    """
    net = arm - table
    common = -arm * (p["tilt"] * np.exp(1j * p["tilt_phase"]) + p["flexure"] * force * np.exp(1j * p["flexure_phase"]))
    return {
        "x": {
            "0": p["bias_x"] + (1 + p["scale_x"]) * net * p["mu_x"] + p["quadratic"] * force**2 / 2,
            "net": (1 + p["scale_x"]) * p["earth"] * np.exp(-1j * p["earth_phase"])
            + p["K"] * G * p["base"] * np.exp(-1j * p["base_phase"]),
            "1": p["K"] * force + (1 + p["scale_x"]) * common + 3 / 4 * p["cubic"] * force**3,
            "2": p["quadratic"] * force**2 / 2,
            "3": p["cubic"] * force**3 / 4,
        },
        "fog": {
            "0": p["bias_f"] + (1 + p["scale_f"]) * net * p["mu_f"],
            "net": (1 + p["scale_f"]) * p["earth"] * np.exp(-1j * p["earth_phase"]),
            "1": (1 + p["scale_f"]) * common,
            "2": 0.0,
            "3": 0.0,
        },
    }

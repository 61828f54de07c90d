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
    j = np.arange(1, N + 1)
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


# --- a whole test by hand: recordings, reduction, uncertainties (contract, "Centrifuge: manifest and record") ---------


def recording(rng, *, arm, table, sense, radius, start, seconds, rate, noise, drift, tilt, earth):
    """Columns of one run, SI: X, Y, FOG, chi. drift: two complex numbers (for X and Y) per m/s^2; tilt complex.

    chi goes from X to the specific force, X to Y. What is fixed in the arm Y senses a quarter turn later;
    a vector fixed in the room turns backwards by the angle that the gyroscope turned.
    """
    t = np.arange(round(seconds * rate)) / rate
    chi = start + sense * table * t
    force = arm**2 * radius
    x, y = force * np.cos(chi), force * np.sin(chi)
    turned = sense * (arm - table) * t
    bend = -sense * arm * np.abs(tilt)
    in_x = bend * np.cos(chi + np.angle(tilt)) + np.abs(earth) * np.cos(np.angle(earth) - turned)
    in_y = bend * np.sin(chi + np.angle(tilt)) + np.abs(earth) * np.sin(np.angle(earth) - turned)
    white = noise[:, None] * np.sqrt(rate) * rng.standard_normal((3, len(t)))
    return {
        "time": t,
        "dtg_x": in_x + drift[0].real * x + drift[0].imag * y + 6e-5 + 1e-8 * t + 2e-10 * x**2 + white[0],
        "dtg_y": in_y + drift[1].real * x + drift[1].imag * y - 3e-5 - 1e-8 * t - 1e-10 * y**2 + white[1],
        "fog": in_x + 1e-6 + white[2],
        "table_angle": chi,
    }


def run_lines(c, net_rate):
    """Lines (A_X, B_X, A_Y, B_Y) less the FOG's, and their covariance for white noise."""
    channels = [c[name] for name in ("dtg_x", "dtg_y", "fog")]
    fits = [regression(c["time"], c["table_angle"], net_rate, channel) for channel in channels]
    (x, y, fog), inverse = (fit[0][2:4] for fit in fits), fits[0][1][2:4, 2:4]
    variance = [_residual_variance(c["time"], c["table_angle"], net_rate, channel) for channel in channels]
    lines = np.array([x[0] - fog[0], x[1] - fog[1], y[0] + fog[1], y[1] - fog[0]])
    turn = np.array([[0.0, 1.0], [-1.0, 0.0]])  # what Y loses is (-B_F, A_F)
    share = np.zeros((4, 6))
    share[:2, :2] = share[2:, 2:4] = np.eye(2)
    share[:2, 4:], share[2:, 4:] = -np.eye(2), turn
    return lines, share @ np.kron(np.diag(variance), inverse) @ share.T


def _residual_variance(time, chi, net_rate, channel):
    middle = time - time.mean()
    columns = [np.ones_like(time), middle]
    for angle in (chi, 2 * chi, 3 * chi, net_rate * (time - time[0])):
        columns += [np.cos(angle), np.sin(angle)]
    J = np.stack(columns, axis=1)
    left = channel - J @ np.linalg.lstsq(J, channel, rcond=None)[0]
    return left @ left / (len(time) - J.shape[1])


def parameters(lines, arm, radius, variances):
    """K, zeta, and direction of X and Y from the half-sums of both senses.

    lines: (levels, senses, 4), rad/s; arm: (levels, senses); variances of a component of each level's half-sum per
    axis, (levels, 2), for the Rice correction.
    """
    pooled = (lines / (arm**2 * radius)[:, :, None]).mean(axis=1)
    found = []
    for axis in (0, 1):
        A, B = pooled[:, 2 * axis], pooled[:, 2 * axis + 1]
        size = np.hypot(A, B)
        K = size - variances[:, axis] / (2 * size)
        weight = 1 / variances[:, axis]
        found += [*K, *(K[1:] / K[0] - 1), np.arctan2((weight * B).sum(), (weight * A).sum())]
    return np.array(found)

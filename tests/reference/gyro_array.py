"""The gyro array's recursions, transcribed from the methods document in plain Python, one axis, one sample at a time.

Nothing here imports imulab. Every method is a class with ``step(readings) -> rate``; ``weights`` holds what was
used in the last sample.
"""

import math

NAN = float("nan")


def mean_of(values):
    return sum(values) / len(values)


def median_of(values):
    ordered = sorted(values)
    half = len(ordered) // 2
    return ordered[half] if len(ordered) % 2 else 0.5 * (ordered[half - 1] + ordered[half])


class Mean:
    """The arithmetic mean of the finite readings."""

    def __init__(self, elements):
        self.n = elements

    def step(self, z):
        good = [i for i in range(self.n) if math.isfinite(z[i])]
        self.weights = [1 / len(good) if i in good else 0.0 for i in range(self.n)]
        return mean_of([z[i] for i in good]) if good else NAN


class Feedback:
    """The source's recursion; `memory` is None (growing) or a gain; samples count from `start`."""

    def __init__(self, elements, initial_bias="first", memory=None, start=1):
        self.n, self.initial, self.memory = elements, initial_bias, memory
        self.k = start

    def step(self, z):
        n = self.n
        if not hasattr(self, "b"):
            zbar = mean_of(z)
            if self.initial == "first":
                self.b = [x - zbar for x in z]
            elif self.initial == "zero":
                self.b = [0.0] * n
            else:
                self.b = list(self.initial)
            self.D = [0.0] * n
            self.rate = mean_of([z[i] - self.b[i] for i in range(n)])
            self.weights = [1 / n] * n
            return self.rate
        self.k += 1
        g = 1 / self.k if self.memory is None else self.memory
        inverse = []
        y = []
        for i in range(n):
            self.b[i] = (1 - g) * self.b[i] + g * (z[i] - self.rate)
            y.append(z[i] - self.b[i])
            self.D[i] = (1 - g) * self.D[i] + g * (y[i] - self.rate) ** 2
            inverse.append(1 / max(self.D[i], 1e-300))
        total = sum(inverse)
        self.weights = [x / total for x in inverse]
        self.rate = sum(self.weights[i] * y[i] for i in range(n))
        return self.rate


class LeastSquares:
    """Inverse-variance weights; the variance of each gyro about the array mean, its own mean removed."""

    def __init__(self, elements, memory=None):
        self.n, self.memory, self.k = elements, memory, 0
        self.mean, self.var = [0.0] * elements, [0.0] * elements

    def step(self, z):
        self.k += 1
        g = 1 / self.k if self.memory is None else (1.0 if self.k == 1 else self.memory)
        zbar = mean_of(z)
        for i in range(self.n):
            e = z[i] - zbar - self.mean[i]
            self.mean[i] += g * e
            self.var[i] = (1 - g) * (self.var[i] + g * e * e)
        inverse = [1.0] * self.n if self.k < 3 else [1 / max(v, 1e-300) for v in self.var]
        total = sum(inverse)
        self.weights = [x / total for x in inverse]
        return sum(self.weights[i] * z[i] for i in range(self.n))


class Support:
    """Weights from the support of each pair, kernel of the distance over the rms distance so far."""

    def __init__(self, elements, memory=None, kernel="gaussian"):
        self.n, self.memory, self.kernel, self.k, self.h2 = elements, memory, kernel, 0, 0.0

    def step(self, z):
        n = self.n
        self.k += 1
        pairs = [(z[i] - z[j]) ** 2 for i in range(n) for j in range(i)]
        g = 1 / self.k if self.memory is None else (1.0 if self.k == 1 else self.memory)
        self.h2 = (1 - g) * self.h2 + g * mean_of(pairs)
        support = []
        for i in range(n):
            total = 0.0
            for j in range(n):
                if j != i:
                    d2 = (z[i] - z[j]) ** 2 / self.h2 if self.h2 > 0 else 0.0
                    total += math.exp(-d2 / 2) if self.kernel == "gaussian" else math.exp(-math.sqrt(d2))
            support.append(total)
        self.weights = [x / sum(support) for x in support]
        return sum(self.weights[i] * z[i] for i in range(n))


class UndeterminedError(Exception):
    """The methods document says how far such a sample may move the output, but not what the output is."""


class Robust:
    """The document's `robust` while every gyro is healthy, in the order and the names of the document.

    Residuals against the unweighted mean of the same sample, biases that sum to zero, variances by the N-cornered hat
    from running mean squares, memory growing up to a cap, a variance floor, a weight cap. The document leaves the
    numbers open; these are those that docs/gyro_array_method.md states ("robust"). For gyros that are lost, gated,
    stuck, late, or have jumped the document has rules and bounds, but no equations: there `step` raises
    `UndeterminedError`, and the core is held to the bounds (test_gyro_array_fused.py, runtime/tests/test_robust.c).

    `rate` in Hz, at most 100; `reliability` are relative variances from a calibration, or None.
    """

    MEMORY, GATE, FLOOR, CAP, TEACHES = 100.0, 6.0, 0.05, 0.5, 3.0  # s, sigma, of the mean variance, weight, sigma
    OWN, CALIBRATED = 16, 200  # samples that the mean variance counts for in each gyro's own
    ESTABLISHED = 10.0  # s, after which the best gyro may weigh more
    MOTION = 10.0  # sigma, beyond which the rate's change in a sample, or a hundredth of it, is told from a bias

    def __init__(self, elements, rate=50.0, memory=None, reliability=None):
        self.n, self.rate, self.memory = elements, rate, memory
        self.most = round(self.MEMORY * rate)
        self.prior = self.OWN if reliability is None else self.CALIBRATED
        inverse = [1.0] * elements if reliability is None else [1 / x for x in reliability]
        self.ratio = [x / mean_of(inverse) for x in inverse]
        self.b, self.m, self.k = [0.0] * elements, [0.0] * elements, 0
        self.before = NAN

    def variances(self):
        """var_i = n/(n-2) [m_i - sum_j m_j / (n(n-1))], mixed with their mean and floored; and that mean."""
        n = self.n
        own = [n / (n - 2) * (x - sum(self.m) / (n * (n - 1))) for x in self.m]
        usual = max(mean_of(own), 0.0)
        share = self.prior / (self.prior + self.remembered())
        mixed = [share * self.ratio[i] * usual + (1 - share) * own[i] for i in range(n)]
        return [max(x, self.FLOOR * usual, 1e-300) for x in mixed], usual

    def remembered(self):
        return min(self.k, self.most if self.memory is None else min(self.most, 1 / self.memory))

    def weigh(self, variance):
        inverse = [1 / x for x in variance]
        w = [x / sum(inverse) for x in inverse]
        top = max(range(self.n), key=lambda i: w[i])
        best = 1 - (1 - self.CAP) * min(self.ESTABLISHED * self.rate / max(self.remembered(), 1), 1)
        if w[top] <= best:
            return w
        return [best if i == top else w[i] / (1 - w[top]) * (1 - best) for i in range(self.n)]

    def step(self, z):
        n = self.n
        if not all(map(math.isfinite, z)):
            raise UndeterminedError("a reading is no number")
        variance, usual = self.variances()
        r = [z[i] - self.b[i] for i in range(n)]
        self.weights = self.weigh(variance)
        rate = sum(self.weights[i] * r[i] for i in range(n))
        self.check(r, rate, variance, usual)
        # A reading teaches by no more than 3 sigma of its distance from the fused rate, once there is a variance.
        away = [x - rate for x in r]
        if self.k >= 16:
            bound = [self.TEACHES * math.sqrt(max(v, usual)) for v in variance]
            away = [min(max(x, -limit), limit) for x, limit in zip(away, bound, strict=True)]
        e = [x - mean_of(away) for x in away]
        self.k += 1
        g = 1 / min(self.k, self.most) if self.memory is None else max(self.memory, 1 / self.k)
        self.m = [(1 - g) * (self.m[i] + g * e[i] ** 2) for i in range(n)]  # about the running mean, which is b
        self.b = [self.b[i] + g * e[i] for i in range(n)]
        self.before = rate
        return rate

    def check(self, r, rate, variance, usual):
        """Refuse what the document has no equation for: readings beyond the gate, and motion that gyros differ in."""
        if self.k < 16:
            return
        middle = median_of(r)
        young = 1 + 16 / self.k
        for x, v in zip(r, variance, strict=True):
            if abs(x - middle) > self.GATE * young * math.sqrt(v + 2 * usual / self.n):
                raise UndeterminedError("a reading is beyond the gate")
        noise = self.n / sum(1 / v for v in variance)
        if (rate - self.before) ** 2 + (0.01 * rate) ** 2 > self.MOTION**2 * noise:
            raise UndeterminedError("lateness and scale factors are told from biases")

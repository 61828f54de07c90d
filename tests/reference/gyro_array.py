"""The gyro array's recursions, transcribed from the methods document in plain Python, one axis, one sample at a time.

Nothing here imports imulab. Every method is a class with ``step(readings) -> rate``; ``weights`` and ``flags`` hold
what was used in the last sample.
"""

import math

NON_FINITE, GATED, STUCK, JUMPED, EXCLUDED, QUIET, HELD = 1, 2, 4, 8, 16, 32, 64
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


def is_held(run, changed, repeated):
    """Whether a run of equal readings is one that chance makes less than once in a million times."""
    return changed > repeated and ((repeated + 1) / (changed + repeated + 2)) ** run <= 1e-6


class Robust:
    """Grubbs weights, gate, stuck counter, jumps and re-admission; `rate` in Hz turns times into samples.

    `reliability` are start weights from a calibration, or None.
    """

    def __init__(
        self,
        elements,
        rate=50.0,
        memory=None,
        gate=6.0,
        spread_gate=4.0,
        weight_cap=0.5,
        floor=0.05,
        cap_time=100.0,
        stuck_time=0.5,
        jump_time=0.5,
        quiet_time=1.0,
        motion=0.01,
        reliability=None,
    ):
        n = self.n = elements
        self.memory, self.gate, self.spread_gate = memory, gate, spread_gate
        self.weight_cap, self.floor, self.motion = weight_cap, floor, motion
        self.cap = max(100, round(cap_time * rate))
        self.stuck_after = max(20, round(stuck_time * rate))
        self.jump_after = max(10, round(jump_time * rate))
        self.quiet_after = max(5, round(quiet_time * rate))
        self.prior = 16.0 if reliability is None else 200.0
        inverse = [1.0] * n if reliability is None else [1 / x for x in reliability]
        self.ratio = [x / mean_of(inverse) for x in inverse]
        self.b = [0.0] * n  # bias against the array's consensus
        self.v = [0.0] * n  # running Grubbs variance
        self.count = [0] * n  # samples learnt from
        self.last = [NAN] * n  # last finite reading
        self.repeats = [0] * n  # identical readings in a row, less one
        self.compared = [0] * n  # pairs of successive readings seen
        self.changed = [0] * n  # of these, pairs that differ
        self.resolution = math.inf  # the smallest change ever seen
        self.stuck = [False] * n
        self.out = [False] * n  # not in use until it was quiet long enough
        self.fresh = [False] * n  # out, and its bias is being estimated anew
        self.jumped = [False] * n  # fresh because of a jump
        self.bad = [0] * n  # samples in a row that were not usable or gated
        self.calm = [0] * n  # good samples in a row while out
        self.away = [0] * n  # gated samples in a row, with their mean and sum of squares
        self.away_mean = [0.0] * n
        self.away_square = [0.0] * n
        self.fast = [0.0] * n  # mean residual of the last second or so
        self.late = [0.0] * n  # residual in a change of the rate within 10 ms
        self.scale = [0.0] * n  # and in a hundredth of the rate
        self.quick = min(1.0, 100 / self.quiet_after)
        self.slow, self.rates, self.moved = 0.0, 0, False  # rate smoothed over 10 ms, rates so far (up to 16)
        self.turn_mean, self.turn_square = [0.0, 0.0], [0.0, 0.0, 0.0]

    def step(self, z):
        n = self.n
        flags = [0] * n
        # 1. non-finite, repeats, stuck
        usable = [math.isfinite(x) for x in z]
        for i in range(n):
            if not usable[i]:
                flags[i] |= NON_FINITE
                continue
            if math.isfinite(self.last[i]):
                self.compared[i] += 1
                if z[i] == self.last[i]:
                    self.repeats[i] += 1
                else:
                    self.repeats[i] = 0
                    self.changed[i] += 1
                    self.resolution = min(self.resolution, abs(z[i] - self.last[i]))
            self.last[i] = z[i]
        alive = [j for j in range(n) if usable[j] and self.repeats[j] < self.stuck_after]
        usual = median_of([self.changed[j] / max(self.compared[j], 1) for j in alive]) if alive else 0.0
        repeated = [max(0, self.compared[i] - self.changed[i] - self.repeats[i]) for i in range(n)]
        known = [i for i in range(n) if usable[i] and self.changed[i]]
        pool = sum(self.changed[i] for i in known), sum(repeated[i] for i in known)
        held = [
            usable[i] and is_held(self.repeats[i], *((self.changed[i], repeated[i]) if self.changed[i] else pool))
            for i in range(n)
        ]
        free = any(usable[i] and not held[i] for i in range(n))
        for i in range(n):
            if not usable[i]:
                continue
            share = self.changed[i] / max(self.compared[i], 1) if self.changed[i] else usual
            stuck = bool(alive) and self.repeats[i] >= self.stuck_after and self.repeats[i] * share >= 20
            if stuck or (held[i] and free):
                flags[i] |= STUCK if stuck else HELD
                usable[i] = False
                self.compared[i] -= self.compared[i] > 0
                if not self.stuck[i] and 0 < self.count[i] <= 2 * self.repeats[i]:
                    self._forget(i)
            self.stuck[i] = stuck
        # 2. who is there: gyros in use so far; newcomers and all others wait
        learnt = max(self.count)
        for i in range(n):
            if usable[i] and self.count[i] == 0 and learnt > 2 and not self.fresh[i]:
                self.out[i] = self.fresh[i] = True
                self.calm[i] = 0
        core = [i for i in range(n) if usable[i] and not self.out[i]]
        waived = not core
        if waived:
            core = [i for i in range(n) if usable[i]]
        # 3. the gates about the median
        r = [z[i] - self.b[i] for i in range(n)]
        middle = median_of([r[i] for i in core]) if core else NAN
        spread = 1.4826 * median_of([abs(r[i] - middle) for i in core]) if core else 0.0
        vbar = self._vbar()
        noise = len(core) / sum(1 / self._variance(i, vbar) for i in core) if core else NAN
        turn = self._turn(middle, noise)
        still = self._still(r, turn)
        raw = [0.0] * n
        inside = [False] * n
        learn = [False] * n
        half = [0.0] * n
        for i in range(n):
            if not usable[i]:
                continue
            if len(core) < 2 or (len(core) == 2 and i in core):  # two judge who comes back, not each other
                inside[i] = learn[i] = True
                continue
            if learnt < 2:
                narrow = (30.0 if len(core) > 3 else 100.0) * spread
            else:
                sigma = math.sqrt(self._variance(i, vbar) + 2 * vbar / len(core))
                narrow = self.gate * (1 + 16 / max(self.count[i], self.calm[i], 1)) * sigma
            if self.resolution < math.inf:
                narrow = max(narrow, 1.5 * self.resolution)
            narrow = max(narrow, 1e-12 * max(abs(z[i]), abs(middle)))
            half[i] = max(narrow, self.spread_gate * spread)
            raw[i] = abs(r[i] - middle)
            distance = min(raw[i], abs(still[i] - middle))
            learn[i] = distance <= narrow
            inside[i] = distance <= half[i] or (self.fresh[i] and self.calm[i] < self.quiet_after // 2)
        # 4. what that does to each gyro
        for i in range(n):
            if not usable[i]:
                self.bad[i] += 1
                self.calm[i] = self.away[i] = 0
                self.fast[i] = 0.0
                if self.stuck[i] or self.bad[i] >= max(self.quiet_after // 5, 1):
                    self.out[i] = True
                if self.stuck[i]:
                    self.jumped[i] = False
            elif not inside[i]:
                flags[i] |= GATED
                self.bad[i] += 1
                self.calm[i] = 0
                if self.bad[i] >= max(self.quiet_after // 5, 1):
                    self.out[i] = True
                self._follow_away(i, still[i] - middle, middle, half[i], vbar)
            else:
                self.bad[i] = 0
                if self.out[i] and not self.fresh[i] and half[i] > 0:
                    self._follow_away(i, still[i] - middle, middle, half[i], vbar)
                else:
                    self.away[i] = 0
                if self.out[i]:
                    self.calm[i] += 1
                    if self.calm[i] > self.quiet_after:
                        if self.fresh[i]:
                            self.v[i] = self.v[i] if self.count[i] else vbar
                            self.count[i] = max(self.count[i], self.quiet_after)
                        self.out[i] = self.fresh[i] = self.jumped[i] = False
                        self.fast = [0.0] * n
        # 5. the output
        here = [inside[i] and (i in core if waived else usable[i] and not self.out[i]) for i in range(n)]
        used = [i for i in range(n) if here[i] and (raw[i] <= half[i] or self.fresh[i])]
        excused = [i for i in range(n) if here[i] and i not in used]  # beyond the gate by what moves with the rate
        for i in excused:
            flags[i] |= GATED
        if not used and core:
            used = [min(core, key=lambda i: abs(r[i] - middle))]
        w = self._weigh(used, vbar)
        rate = sum(w[i] * r[i] for i in used) if used else NAN
        # 6. learning
        for i in range(n):
            if i not in used:
                flags[i] |= EXCLUDED
            if usable[i] and self.out[i]:
                flags[i] |= QUIET
                if self.fresh[i] and used and i not in used and self.calm[i]:
                    self.b[i] += (still[i] - rate) / self.calm[i]
            if self.jumped[i]:
                flags[i] |= JUMPED
        pupils = [i for i in range(n) if learn[i] and (i in used or i in excused)]
        if len(pupils) >= 2:
            self._learn(pupils, r, rate, middle, vbar, noise, learnt)
        if used:
            self.slow = self.slow + self.quick * (rate - self.slow) if self.rates else rate
            self.rates = min(self.rates + 1, 16)
        self.weights, self.flags = w, flags
        return rate

    def _turn(self, rate, noise):
        """Change of the rate within 10 ms and a hundredth of it; nothing where the noise of the gyros hides both."""
        turn = (rate - self.slow, 0.01 * rate)
        least = (3 if self.moved else 10) ** 2 * noise
        return turn if self.rates >= 16 and turn[0] ** 2 + turn[1] ** 2 > least else (0.0, 0.0)

    def _still(self, r, turn):
        return [r[i] - (self.late[i] * turn[0] + self.scale[i] * turn[1]) for i in range(self.n)]

    def _held_to(self, pupils, r, rate, vbar):
        """Residuals about their mean; no more than 3 sigma from the fused rate teach, once there is a variance."""
        held = {i: r[i] - rate for i in pupils}
        for i in pupils:
            if self.count[i] >= 16:
                most = 3 * math.sqrt(max(self._variance(i, vbar), vbar))
                held[i] = min(max(held[i], -most), most)
        centre = mean_of(list(held.values()))
        return {i: held[i] - centre for i in pupils}

    def _learn_turn(self, turn, f, gains, noise):
        """Recursive least squares of the residuals on (1, turn); returns the gain of the bias, in its usual one."""
        g = min(gains.values())
        mean, square = self.turn_mean, self.turn_square
        away = [turn[j] - mean[j] for j in range(2)]
        self.turn_mean = mean = [mean[j] + g * away[j] for j in range(2)]
        products = (away[0] ** 2, away[1] ** 2, away[0] * away[1])
        self.turn_square = square = [(1 - g) * (square[j] + g * products[j]) for j in range(3)]
        left = [turn[j] - mean[j] for j in range(2)]
        first, second = square[0] + noise, square[1] + noise
        scale = 1 / (first * second - square[2] ** 2)
        k = scale * (second * left[0] - square[2] * left[1]), scale * (first * left[1] - square[2] * left[0])
        for i in f:
            self.late[i] = min(max(self.late[i] + gains[i] * k[0] * f[i], -2.0), 2.0)
            self.scale[i] = min(max(self.scale[i] + gains[i] * k[1] * f[i], -5.0), 5.0)
        self.moved = square[0] + square[1] > noise or turn[1] != 0.0
        if not self.moved:
            self.turn_mean, self.turn_square = [0.0, 0.0], [0.0, 0.0, 0.0]
        return 1 - k[0] * mean[0] - k[1] * mean[1]

    def _learn(self, pupils, r, rate, middle, vbar, noise, learnt):
        m = len(pupils)
        turn = self._turn(rate, noise)
        still = self._still(r, turn)
        e, f = self._held_to(pupils, r, rate, vbar), self._held_to(pupils, still, rate, vbar)
        gains = {}
        for i in pupils:
            self.count[i] += 1
            gains[i] = 1 / min(self.count[i], self.cap) if self.memory is None else max(self.memory, 1 / self.count[i])
        own = self._learn_turn(turn, f, gains, noise) if self.moved or turn != (0.0, 0.0) else 1.0
        # While the array finds its biases, their sum stays, whatever the gains are.
        drift = sum(own * gains[i] * f[i] for i in pupils) / m if learnt < 5 * self.quiet_after else 0.0
        squares = sum(x * x for x in e.values())
        for i in pupils:
            g = gains[i]
            self.b[i] += own * g * f[i] - drift
            if m > 2:
                grubbs = m / (m - 2) * (e[i] ** 2 - squares / (m * (m - 1)))
                self.v[i] = (1 - g) * (self.v[i] + g * grubbs)
        if m < 3:
            return
        # A jump too small for the gate shows in the mean of a second, where the others' means agree; not in the array's
        # first five seconds, in which its biases settle.
        share = 1 / self.quiet_after
        for i in pupils:
            self.fast[i] = (1 - share) * self.fast[i] + share * (still[i] - rate)
        usual = median_of([self.fast[i] for i in pupils])
        scatter = 1.4826 * median_of([abs(self.fast[i] - usual) for i in pupils])
        young = self.quiet_after * (5 if learnt < 5 * self.quiet_after else 1)
        for i in pupils:
            limit = max(8 * math.sqrt(share / 2), 1.0) * math.sqrt(self._variance(i, vbar))
            limit = max(limit, 8 * scatter, self.motion * abs(middle))
            if self.count[i] >= young and abs(self.fast[i] - usual) > limit:
                self._jump(i)

    def _follow_away(self, i, distance, middle, half, vbar):
        self.away[i] += 1
        if self.away[i] == 1:
            self.away_mean[i] = distance
            self.away_square[i] = 0.0
        else:
            step = distance - self.away_mean[i]
            self.away_mean[i] += step / self.away[i]
            self.away_square[i] += step * (distance - self.away_mean[i])
        if self.away[i] >= self.jump_after:
            scatter = math.sqrt(self.away_square[i] / (self.away[i] - 1))
            least = max(math.sqrt(self._variance(i, vbar)), self.motion * abs(middle))
            if scatter <= half / 2 and abs(self.away_mean[i]) > least:
                if self.away[i] >= self.count[i]:
                    self._forget(i)
                self._jump(i)
            self.away[i] = 0

    def _jump(self, i):
        self.out[i] = self.fresh[i] = self.jumped[i] = True
        self.calm[i] = self.away[i] = 0
        self.fast[i] = 0.0

    def _forget(self, i):
        """Most of what this gyro taught was wrong: the others settle among themselves, and it starts anew."""
        others = [j for j in range(self.n) if j != i and self.count[j]]
        if others:
            mean = mean_of([self.b[j] for j in others])
            for j in others:
                self.b[j] -= mean
        self.b[i] = self.v[i] = self.late[i] = self.scale[i] = 0.0
        self.count[i] = 0

    def _vbar(self):
        known = [self.v[i] for i in range(self.n) if self.count[i] > 1]
        return max(mean_of(known), 0.0) if known else 0.0

    def _remembered(self, i):
        return min(self.count[i], self.cap) if self.memory is None else min(self.count[i], self.cap, 1 / self.memory)

    def _variance(self, i, vbar):
        count = self._remembered(i)
        mixed = (self.prior * self.ratio[i] * vbar + count * self.v[i]) / (self.prior + count)
        return max(mixed, self.floor * vbar, 1e-300)

    def _weigh(self, used, vbar):
        w = [0.0] * self.n
        m = len(used)
        if m <= 2:
            for i in used:
                w[i] = 1 / m
            return w
        inverse = {i: 1 / self._variance(i, vbar) for i in used}
        total = sum(inverse.values())
        top = max(used, key=lambda i: inverse[i])
        for i in used:
            w[i] = inverse[i] / total
        cap = 1 - (1 - self.weight_cap) * min(10 * self.quiet_after / max(self._remembered(top), 1), 1)
        if w[top] > cap:
            rest = 1 - w[top]
            for i in used:
                w[i] = cap if i == top else w[i] / rest * (1 - cap)
        return w

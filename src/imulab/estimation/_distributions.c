/* Distribution functions of statistics, from the incomplete gamma and beta functions, and their inverses.
 *
 * Sources, by numbers of the Digital Library of Mathematical Functions (DLMF, https://dlmf.nist.gov): 8.7.1 and 8.9.2, series
 * and continued fraction of the incomplete gamma function; the even part of the continued fraction 8.17.22 of the incomplete
 * beta function, as DiDonato and Morris, ACM Trans. Math. Softw. 18 (1992) 360, have it; the integrals 8.2.2 and 8.17.1
 * by Gauss and Legendre's rule (3.5(v)) where both parameters are large; 5.11.3, Stirling's series; 6.9.1, the exponential
 * integral of an imaginary argument. Every factor is written so that no digits cancel, in the tails and for millions of
 * degrees of freedom too. */
#include "buffers.h"

#include <math.h>

static const double PI = 3.14159265358979323846;
static const double ROUNDING = 2.220446049250313e-16;
static const double TINY = 1e-300;
static const double LARGE = 1e3;           /* from there on integrals take less time than series and fractions */
static const double LIKE_INFINITY = 1e30;  /* degrees of freedom that change no digit any more */
static const double SHARE = 44.0;          /* integrals end where the integrand has fallen to exp(-44) */
enum { MOST_TERMS = 100000, MOST_STEPS = 200, HALF_NODES = 15 };

/* Nodes, as distances from the middle of (0, 1), and weights of the rule of 30 points, which is exact up to degree 59. */
static const double NODES[HALF_NODES] = {
    0.0257359212776588479, 0.0769349568042917735, 0.127318463083944923, 0.176352362765439057, 0.223516884769044588,
    0.26831207407100995,   0.310263091494621431,  0.348925247396657898, 0.383888716052413097, 0.414782881191384199,
    0.441280267896026341,  0.463100023714637163,  0.480010932484153756, 0.491834061639873605, 0.49844674203732477};
static const double WEIGHTS[HALF_NODES] = {
    0.0514263264467794202, 0.0508811948742027523, 0.0497967102933976335, 0.0481843685873221298, 0.0460612611188930644,
    0.0434498936005414899, 0.0403779476147101077, 0.0368779873688526031, 0.0329871149410902476, 0.0287465781088095332,
    0.0242013364152970265, 0.0193995962848135248, 0.0143923539416616847, 0.00923323415554547957, 0.00398409624808330281};

/* A probability and what it lacks to 1, each with all its digits, and the density over the logarithm of the argument. */
typedef struct {
    double lower, upper, density;
} Tails;

/* ---- Parts of the incomplete functions. ---- */

/* u - ln(1 + u) >= 0, from u and 1 + u. */
static double excess_over_log(double u, double one_plus_u) {
    if (u < -0.5 || u > 1.0) return u - (u < 0.0 ? log(one_plus_u) : log1p(u));
    const double r = u / (2.0 + u), square = r * r; /* ln(1 + u) = 2 artanh r */
    double sum = 0.0, power = 1.0;
    for (int k = 3; power > 0.1 * ROUNDING; k += 2, power *= square) sum += power / k;
    return r * (u - 2.0 * square * sum);
}

/* Gamma(a) over its leading term sqrt(2 pi / a) (a / e)^a. */
static double scaled_gamma(double a) {
    if (a < 10.0) return tgamma(a) * sqrt(a / (2.0 * PI)) * exp(a) * pow(a, -a);
    const double s = 1.0 / (a * a);
    const double series = 1.0 / 12 - s * (1.0 / 360 - s * (1.0 / 1260 - s * (1.0 / 1680 - s * (1.0 / 1188 - s * (691.0 / 360360 - s / 156)))));
    return exp(series / a);
}

/* x^a e^-x / Gamma(a), which is the density of a gamma distribution over ln x. */
static double gamma_density(double a, double x) {
    return sqrt(a / (2.0 * PI)) * exp(-a * excess_over_log((x - a) / a, x / a)) / scaled_gamma(a);
}

/* x^a y^b / B(a, b), y = 1 - x, with d = a y - b x. */
static double beta_density(double a, double b, double x, double y, double d) {
    const double n = a + b;
    const double exponent = a * excess_over_log(-d / a, x * (n / a)) + b * excess_over_log(d / b, y * (n / b));
    return sqrt(a / (2.0 * PI) * (b / n)) * exp(-exponent) * scaled_gamma(n) / (scaled_gamma(a) * scaled_gamma(b));
}

/* Integral over s from 0 of (1 - s)^p (1 + r s)^q e^(-(c + p - q r) s), a function that falls all the way. */
static double falling_integral(double c, double p, double q, double r) {
    const double falling = c > 0.0 ? c : 0.0, curvature = p + q * r * r;
    const double end = 2.0 * SHARE / (falling + sqrt(falling * falling + 2.0 * SHARE * curvature));
    double sum = 0.0;
    for (int i = 0; i < 2 * HALF_NODES; i++) {
        const double node = i % 2 ? NODES[i / 2] : -NODES[i / 2], s = end * (0.5 + node);
        double exponent = c * s;
        if (p > 0.0) exponent += p * excess_over_log(-s, 1.0 - s);
        if (q > 0.0) exponent += q * excess_over_log(r * s, 1.0 + r * s);
        sum += WEIGHTS[i / 2] * exp(-exponent);
    }
    return end * sum;
}

static double away_from_zero(double value) { return fabs(value) < TINY ? TINY : value; }

/* ---- The incomplete gamma and beta functions, regularised. ---- */

static Tails gamma_tails(double a, double x) {
    if (!(x > 0.0)) return (Tails){0.0, 1.0, 0.0};
    const double density = isinf(x) ? 0.0 : gamma_density(a, x);
    if (density == 0.0) return x < a ? (Tails){0.0, 1.0, 0.0} : (Tails){1.0, 0.0, 0.0};
    if (a >= LARGE) {
        if (x < a) {
            const double lower = density * falling_integral(a - 1.0 - x, a - 1.0, 0.0, 0.0);
            return (Tails){lower, 1.0 - lower, density};
        }
        const double upper = density * falling_integral(x - a + 1.0, 0.0, a - 1.0, 1.0);
        return (Tails){1.0 - upper, upper, density};
    }
    if (x < a + 1.0) {
        double term = 1.0 / a, sum = term;
        for (int n = 1; n < MOST_TERMS && term > 0.1 * ROUNDING * sum; n++) sum += term *= x / (a + n);
        return (Tails){density * sum, 1.0 - density * sum, density};
    }
    double b = x + 1.0 - a, c = 1.0 / TINY, d = 1.0 / b, fraction = d; /* by Lentz's algorithm, DLMF 3.10(iii) */
    for (int i = 1; i < MOST_TERMS; i++) {
        const double numerator = i * (a - i);
        b += 2.0;
        d = 1.0 / away_from_zero(numerator * d + b);
        c = away_from_zero(b + numerator / c);
        fraction *= c * d;
        if (fabs(c * d - 1.0) <= ROUNDING) break;
    }
    return (Tails){1.0 - density * fraction, density * fraction, density};
}

/* Of x, with y = 1 - x and difference = a y - b x >= 0: not beyond the mean. */
static Tails lower_beta_tails(double a, double b, double x, double y, double difference) {
    const double density = beta_density(a, b, x, y, difference);
    if (a >= LARGE && b >= LARGE) {
        const double r = x / y, lower = density / y * falling_integral(difference / y - 1.0 + r, a - 1.0, b - 1.0, r);
        return (Tails){lower, 1.0 - lower, density};
    }
    double c = a * (difference + 1.0) / (a + 1.0), d = 0.0, fraction = c;
    for (int m = 1; m < MOST_TERMS; m++) {
        const double odd = a + 2.0 * m - 1.0, e = (a + m - 1.0) / odd * (x / odd);
        const double numerator = e * (a + b + m - 1.0) * (m * (b - m) * x);
        const double denominator = m + m * (b - m) * x / odd + (a + m) * (difference + 1.0 + m * (1.0 + y)) / (odd + 2.0);
        d = 1.0 / away_from_zero(denominator + numerator * d);
        c = away_from_zero(denominator + numerator / c);
        fraction *= c * d;
        if (fabs(c * d - 1.0) <= ROUNDING) break;
    }
    return (Tails){density / fraction, 1.0 - density / fraction, density};
}

/* ---- Distribution functions. ---- */

static double normal_cdf(double x, double unused, double unused2) {
    (void)unused, (void)unused2;
    return 0.5 * erfc(-x * 0.70710678118654752440);
}

static double normal_quantile(double p, double unused, double unused2) {
    (void)unused, (void)unused2;
    if (!(p >= 0.0 && p <= 1.0)) return NAN;
    const double tail = p < 0.5 ? p : 1.0 - p;
    if (tail == 0.0) return p < 0.5 ? -INFINITY : INFINITY;
    /* Abramowitz and Stegun 26.2.23, within 4.5e-4, and three steps of Halley's method. */
    const double t = sqrt(-2.0 * log(tail));
    double x = (2.515517 + t * (0.802853 + t * 0.010328)) / (1.0 + t * (1.432788 + t * (0.189269 + t * 0.001308))) - t;
    for (int i = 0; i < 3; i++) {
        const double root = x * 0.70710678118654752440;
        const double error = tail > 0.25 ? 0.5 * erf(root) - (tail - 0.5) : 0.5 * erfc(-root) - tail;
        const double step = error * sqrt(2.0 * PI) * exp(0.5 * x * x);
        x -= step / (1.0 + 0.5 * x * step);
    }
    return p < 0.5 ? x : 0.0 - x; /* no negative zero */
}

/* Of f, a ratio of mean squares with m and n degrees of freedom, and f - 1. */
static Tails ratio_tails(double f, double f_minus_1, double m, double n) {
    if (isnan(f) || !(m > 0.0 && n > 0.0)) return (Tails){NAN, NAN, NAN};
    if (!(f > 0.0)) return (Tails){0.0, 1.0, 0.0};
    if (isinf(f)) return (Tails){1.0, 0.0, 0.0};
    if (m >= LIKE_INFINITY && n >= LIKE_INFINITY) {
        const double upper = f > 1.0 ? 0.0 : f < 1.0 ? 1.0 : 0.5;
        return (Tails){1.0 - upper, upper, 0.0};
    }
    if (n >= LIKE_INFINITY) return gamma_tails(0.5 * m, 0.5 * m * f);
    if (m >= LIKE_INFINITY) {
        const Tails tails = gamma_tails(0.5 * n, 0.5 * n / f);
        return (Tails){tails.upper, tails.lower, tails.density};
    }
    const double a = 0.5 * m, b = 0.5 * n, q = m / n * f, x = q / (1.0 + q), y = 1.0 / (1.0 + q);
    if (isinf(q)) return (Tails){1.0, 0.0, 0.0};
    const double difference = -a * f_minus_1 / (1.0 + q); /* a y - b x */
    if (difference >= 0.0) return lower_beta_tails(a, b, x, y, difference);
    const Tails tails = lower_beta_tails(b, a, y, x, -difference);
    return (Tails){tails.upper, tails.lower, tails.density};
}

static double chi_square_tail(double value, double freedom, double unused) {
    (void)unused;
    if (isnan(value) || !(freedom >= 0.0)) return NAN;
    if (!(value >= 0.0)) return 1.0;
    if (freedom == 0.0) return 0.0;
    if (isinf(freedom)) return 1.0;
    return gamma_tails(0.5 * freedom, 0.5 * value).upper;
}

static double f_tail(double f, double m, double n) { return ratio_tails(f, f - 1.0, m, n).upper; }

static double t_cdf(double t, double freedom, double unused) {
    (void)unused;
    if (freedom >= LIKE_INFINITY) return normal_cdf(t, 0.0, 0.0);
    const double tail = 0.5 * ratio_tails(t * t, (t - 1.0) * (t + 1.0), 1.0, freedom).upper;
    return t > 0.0 ? 1.0 - tail : tail;
}

/* ---- Their inverses. ---- */

/* The f that a ratio of mean squares is below and above with two probabilities whose sum is 1.
 *
 * By Newton's method on the logarithms of f and of the smaller probability, which is a concave function, from Paulson's
 * normal approximation (Annals of Math. Statistics 13 (1942) 233); by halving of an interval where a step leaves it. */
static double ratio_quantile(double lower, double upper, double m, double n) {
    if (!(lower >= 0.0 && upper >= 0.0 && m > 0.0 && n > 0.0)) return NAN;
    if (lower == 0.0) return 0.0;
    if (upper == 0.0) return INFINITY;
    if (m >= LIKE_INFINITY && n >= LIKE_INFINITY) return 1.0;
    const int from_above = upper < lower;
    const double target = log(from_above ? upper : lower);
    const double z = from_above ? -normal_quantile(upper, 0.0, 0.0) : normal_quantile(lower, 0.0, 0.0);
    const double u = 2.0 / 9.0 / m, v = 2.0 / 9.0 / n, square = (1.0 - u) * (1.0 - u) * v + (1.0 - v) * (1.0 - v) * u - z * z * u * v;
    const double cube_root = ((1.0 - u) * (1.0 - v) + z * sqrt(square > 0.0 ? square : 0.0)) / ((1.0 - v) * (1.0 - v) - z * z * v);
    double low = -760.0, high = 709.7, x = cube_root > 1e-3 && cube_root < 1e3 ? 3.0 * log(cube_root) : 0.0;
    for (int i = 0; i < MOST_STEPS; i++) {
        const double f = exp(x);
        const Tails tails = ratio_tails(f, expm1(x), m, n);
        const double tail = from_above ? tails.upper : tails.lower, slope = (from_above ? -1.0 : 1.0) * tails.density / tail;
        const double step = (target - log(tail)) / slope; /* inf or nan where the tail vanishes */
        if (from_above ? log(tail) > target : log(tail) < target) low = x;
        else high = x;
        if (fabs(step) * fmax(1.0, fabs(slope)) < 1e-8) return exp(x + step);
        x = x + step > low && x + step < high ? x + step : 0.5 * (low + high);
        if (high - low <= ROUNDING * fabs(x)) break;
    }
    return x < 709.0 ? exp(x) : INFINITY;
}

static double chi_square_upper_quantile(double probability, double freedom, double unused) {
    (void)unused;
    if (isinf(freedom) || freedom == 0.0) return probability >= 0.0 && probability <= 1.0 ? freedom : NAN;
    return freedom * ratio_quantile(1.0 - probability, probability, freedom, INFINITY);
}

static double f_quantile(double probability, double m, double n) { return ratio_quantile(probability, 1.0 - probability, m, n); }

static double t_quantile(double probability, double freedom, double unused) {
    (void)unused;
    if (freedom >= LIKE_INFINITY) return normal_quantile(probability, 0.0, 0.0);
    const double tail = probability < 0.5 ? probability : 1.0 - probability;
    const double t = sqrt(ratio_quantile(2.0 * fabs(probability - 0.5), 2.0 * tail, 1.0, freedom));
    return probability < 0.5 ? -t : t;
}

/* Integral of sin(t) / t from 0 to x. */
static double sine_integral(double x, double unused, double unused2) {
    (void)unused, (void)unused2;
    const double t = fabs(x);
    double value;
    if (isinf(x)) {
        value = 0.5 * PI;
    } else if (t <= 4.0) { /* DLMF 6.6.5 */
        double power = t;
        value = t;
        for (int k = 1; fabs(power) > 0.1 * ROUNDING * value; k++) {
            power *= -t * t / (2.0 * k * (2.0 * k + 1.0));
            value += power / (2.0 * k + 1.0);
        }
    } else { /* pi/2 + Im E1(i t), the fraction of 6.9.1 by Lentz's algorithm in complex numbers */
        double br = 1.0, bi = t, norm = br * br + bi * bi;
        double cr = 1.0 / TINY, ci = 0.0, dr = br / norm, di = -bi / norm, hr = dr, hi = di;
        for (int i = 1; i < MOST_TERMS; i++) {
            const double numerator = -(double)i * i;
            br += 2.0;
            const double er = numerator * dr + br, ei = numerator * di + bi, e = er * er + ei * ei;
            dr = er / e, di = -ei / e;
            const double c = cr * cr + ci * ci, fr = br + numerator * (cr / c), fi = bi - numerator * (ci / c);
            cr = fr, ci = fi;
            const double gr = cr * dr - ci * di, gi = cr * di + ci * dr, h = hr;
            hr = hr * gr - hi * gi, hi = h * gi + hi * gr;
            if (fabs(gr - 1.0) + fabs(gi) <= 2.0 * ROUNDING) break;
        }
        value = 0.5 * PI + hi * cos(t) - hr * sin(t);
    }
    return x < 0.0 ? -value : value;
}

/* ---- The module: functions of numbers, over buffers. ---- */

typedef double Function(double, double, double);

static PyObject *filled(PyObject *args, const char *format, int count, Function *function) {
    Py_buffer v[4];
    if (!PyArg_ParseTuple(args, format, &v[0], &v[1], &v[2], &v[3])) return NULL;
    int fits = 1;
    for (int i = 1; i <= count; i++) fits = fits && (v[i].len == v[0].len || v[i].len == DOUBLE_BYTES);
    if (fits) {
        const double *argument[3] = {v[1].buf, v[1].buf, v[1].buf};
        Py_ssize_t stride[3] = {0, 0, 0};
        for (int i = 0; i < count; i++) argument[i] = v[i + 1].buf, stride[i] = v[i + 1].len == DOUBLE_BYTES ? 0 : 1;
        const Py_ssize_t n = v[0].len / DOUBLE_BYTES;
        double *values = v[0].buf;
        Py_BEGIN_ALLOW_THREADS
        for (Py_ssize_t i = 0; i < n; i++) {
            values[i] = function(argument[0][i * stride[0]], argument[1][i * stride[1]], argument[2][i * stride[2]]);
        }
        Py_END_ALLOW_THREADS
    }
    return done(v, count + 1, fits);
}

#define FUNCTION(name, signature, format, count)                                                                  \
    PyDoc_STRVAR(name##_doc, "fill_" #name "(values, " signature ") -> None\n\nfloat64 buffers as long as values, or of 1."); \
    static PyObject *fill_##name(PyObject *module, PyObject *args) { return (void)module, filled(args, format, count, name); }

FUNCTION(normal_cdf, "value", "w*y*", 1)
FUNCTION(normal_quantile, "probability", "w*y*", 1)
FUNCTION(chi_square_tail, "value, freedom", "w*y*y*", 2)
FUNCTION(chi_square_upper_quantile, "probability, freedom", "w*y*y*", 2)
FUNCTION(f_tail, "value, numerator_freedom, denominator_freedom", "w*y*y*y*", 3)
FUNCTION(f_quantile, "probability, numerator_freedom, denominator_freedom", "w*y*y*y*", 3)
FUNCTION(t_cdf, "value, freedom", "w*y*y*", 2)
FUNCTION(t_quantile, "probability, freedom", "w*y*y*", 2)
FUNCTION(sine_integral, "value", "w*y*", 1)

#define FILL(name) {"fill_" #name, fill_##name, METH_VARARGS, name##_doc}

MODULE(_distributions, "Distribution functions of statistics, over buffers.", FILL(normal_cdf), FILL(normal_quantile), FILL(chi_square_tail),
       FILL(chi_square_upper_quantile), FILL(f_tail), FILL(f_quantile), FILL(t_cdf), FILL(t_quantile), FILL(sine_integral))

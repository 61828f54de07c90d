/* imulab runtime: compensation and fusion of inertial sensors, the same source in the unit and under Python.
 *
 * C99, no allocation, no global state, no input or output. The caller owns every struct; settings (what a calibration
 * found, constant) are apart from state (what a stream remembers). Not-a-number in gives not-a-number out and a flag;
 * no input traps, loops without bound or reads out of bounds.
 *
 * IMULAB_REAL is the type of all arithmetic: double by default, or -DIMULAB_REAL=float, where no double occurs.
 * Units are SI: s, m/s^2, rad, rad/s; temperature in degC; `output` is the raw unit that a record was made in.
 */
#ifndef IMULAB_H
#define IMULAB_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#ifndef IMULAB_REAL
#define IMULAB_REAL double
#endif
typedef IMULAB_REAL il_real;

#define IL_VERSION 3 /* of the table format; 3 with whole IMUs, 2 where gyroscopes have powers of the rate, else 1 */

/* Elements of a gyro array per axis; each costs 16 words of state per axis. */
#ifndef IL_ARRAY_ELEMENTS
#define IL_ARRAY_ELEMENTS 32
#endif
#define IL_ARRAY_ROOM (IL_ARRAY_ELEMENTS / 2 * 2 + 2) /* taken two at a time */

typedef enum {
    IL_OK = 0,
    IL_ARGUMENT,         /* a null pointer, or a setting that cannot be */
    IL_TABLE_SHORT,      /* the bytes end before the table does */
    IL_TABLE_LONG,       /* bytes follow the table */
    IL_TABLE_NOT_TABLE,  /* the first bytes are not those of a table */
    IL_TABLE_NEWER,      /* written by a newer imulab: update this runtime */
    IL_TABLE_CORRUPT,    /* CRC-32 does not match */
    IL_TABLE_WIDTH,      /* numbers of a width that this build does not read */
    IL_TABLE_NOT_FINITE, /* a number is infinite or not a number */
    IL_TABLE_CONTENT,    /* counts or kinds that no table has */
    IL_TABLE_MEMORY      /* the caller's memory is too small */
} il_status;

/* What one sample met; the functions return these or-ed together, 0 when all is well. */
enum {
    IL_NOT_FINITE = 1, /* an input was infinite or not a number */
    IL_GATED = 2,      /* array: reading beyond the median gate in this sample */
    IL_STUCK = 4,      /* array: identical readings while the others move */
    IL_JUMPED = 8,     /* array: bias jump, being estimated again */
    IL_EXCLUDED = 16,  /* array: not in the fused output in this sample */
    IL_QUIET = 32,     /* array: coming back, watched before it is used */
    IL_BEYOND = 64,    /* tumble, gyro: output that no specific force or rate gives; centrifuge: beyond the levels
                        * tested; thermal: outside the temperatures measured; array: a reading held, as at the end of a range */
    IL_ALONE = 128     /* array: fewer than three gyros left, nothing to compare with */
};

/* ---- accelerometer triad: M_i = S_i (A_i + b_i), A = s + k2 s^2 + ..., s = T f ------------------------------------
 * With cross terms A_x has k_xy s_x s_y more, A_y k_yz s_y s_z, and A_z k_zx s_z s_x. */

#define IL_TUMBLE_ORDER 5

typedef struct {
    int32_t order;                              /* of the polynomial, 1 to 5 */
    il_real gain[3];                            /* 1 / S, (m/s^2) per output */
    il_real bias[3];                            /* b, m/s^2 */
    il_real misalignment[3];                    /* m_yx, m_zx, m_zy, rad */
    il_real low[3], high[3];                    /* A between the polynomial's turning points, m/s^2 */
    il_real nonlinearity[IL_TUMBLE_ORDER - 1][3]; /* k2 .. k5, 1/(m/s^2)^(power - 1) */
    int32_t has_cross;
    il_real cross[3];                           /* k_xy, k_yz, k_zx, 1/(m/s^2) */
} il_tumble;

/* Outputs to specific force [m/s^2]; force may be output. */
unsigned il_tumble_apply(const il_tumble *settings, const il_real output[3], il_real force[3]);

/* The same for n samples: channel i of sample k is output[i][k * stride]. Returns the flags of all samples or-ed. */
unsigned il_tumble_block(const il_tumble *settings, size_t n, const il_real *const output[3], size_t stride,
                         il_real *const force[3], size_t force_stride);

/* The s of each axis at which s + k2 s^2 + ... is a, between the turning points next to zero, and the slope there; not a
 * number where there is none. k[0] holds k2 of the axes, k[1] k3. Order 2 in closed form, 2 a / (1 + sqrt(1 + 4 k2 a)). */
void il_tumble_solve(int32_t order, const il_real (*k)[3], const il_real a[3], il_real s[3], il_real slope[3]);

/* ---- gyroscope triad: w = T^-1 s, s + k2 s^2 + ... = M / S - b - G f ---------------------------------------------- */

typedef struct {
    int32_t has_sensitivity;   /* 0: G is zero and no specific force is needed */
    il_real gain[3];           /* 1 / S, (rad/s) per output */
    il_real bias[3];           /* b, rad/s */
    il_real turn[3][3];        /* T^-1, 1 */
    il_real sensitivity[3][3]; /* G, (rad/s)/(m/s^2) */
    int32_t order;             /* of the polynomial, 1 to 5; 0 is 1 */
    il_real low[3], high[3];   /* s + k2 s^2 + ... between its turning points, rad/s */
    il_real nonlinearity[IL_TUMBLE_ORDER - 1][3]; /* k2 .. k5, 1/(rad/s)^(power - 1) */
} il_gyro;

/* Outputs, and specific force [m/s^2] (may be NULL without G), to angular rate [rad/s]; rate may be output. */
unsigned il_gyro_apply(const il_gyro *settings, const il_real output[3], const il_real force[3], il_real rate[3]);

/* The same for n samples; force may be NULL without G. */
unsigned il_gyro_block(const il_gyro *settings, size_t n, const il_real *const output[3], const il_real *const force[3],
                       size_t stride, il_real *const rate[3], size_t rate_stride);

/* ---- magnetometer triad: m = T^-1 s, s + k2 s^2 = M / S - b ------------------------------------------------------- */

typedef struct {
    int32_t order;       /* 1, or 2 with k2 */
    il_real gain[3];     /* 1 / S of each output, T (or 1) per output */
    il_real bias[3];     /* b, T (or 1): hard iron, as each output has it */
    il_real turn[3][3];  /* T^-1, and which output is which axis, 1 */
    il_real quadratic[3]; /* k2, 1/T (or 1) */
} il_mag;

/* Outputs to field [T, or parts of the local field], in the body frame; field may be output. */
unsigned il_mag_apply(const il_mag *settings, const il_real output[3], il_real field[3]);

/* The same for n samples. */
unsigned il_mag_block(const il_mag *settings, size_t n, const il_real *const output[3], size_t stride,
                      il_real *const field[3], size_t field_stride);

/* ---- accelerometer triad over temperature: M_i = S_i(T) (A_i + b_i(T)), A = T_m(T) f ------------------------------ */

#define IL_THERMAL_LAWS 9
#define IL_THERMAL_TERMS 8

typedef struct {
    int32_t pieces;             /* intervals between knots, 1 for polynomials over the whole range */
    int32_t terms;              /* coefficients of each law in each piece, 1 to IL_THERMAL_TERMS */
    const il_real *knot;        /* [pieces + 1], ascending, degC; the first and last are the range that was measured */
    const il_real *coefficient; /* [piece][law][term], of powers of theta, which is -1 to 1 over a piece; the laws are
                                 * b of x, y, z, m/s^2; S of x, y, z, output per m/s^2; m_yx, m_zx, m_zy, rad */
} il_thermal;

typedef struct {
    int32_t known;       /* 0: no temperature yet */
    unsigned flags;      /* of that temperature */
    il_real temperature; /* the last one, degC */
    il_tumble at;        /* the triad there */
} il_thermal_state;

/* The triad at one temperature, degC: IL_BEYOND outside the range, where the laws hold their values at its ends;
 * IL_NOT_FINITE, and nothing but not a number, for a temperature that is none. */
unsigned il_thermal_at(const il_thermal *settings, il_real temperature, il_tumble *at);

/* Clear the state for the first sample. */
void il_thermal_start(il_thermal_state *state);

/* Outputs at a temperature [degC] to specific force [m/s^2]; force may be output. */
unsigned il_thermal_apply(const il_thermal *settings, il_thermal_state *state, il_real temperature,
                          const il_real output[3], il_real force[3]);

/* The same for n samples; temperatures are `stride` apart as the outputs are. Returns the flags of all samples or-ed. */
unsigned il_thermal_block(const il_thermal *settings, size_t n, const il_real *temperature,
                          const il_real *const output[3], size_t stride, il_real *const force[3], size_t force_stride);

/* ---- gyroscope triad over temperature: M_i = S_i(T) (s_i + b_i(T) + (G f)_i), w = T^-1 s -------------------------- */

#define IL_THERMAL_GYRO_LAWS 6

typedef struct {
    int32_t has_sensitivity;    /* 0: G is zero and no specific force is needed */
    int32_t pieces, terms;      /* as in il_thermal */
    il_real turn[3][3];         /* T^-1, 1 */
    il_real sensitivity[3][3];  /* G, (rad/s)/(m/s^2) */
    const il_real *knot;        /* [pieces + 1], as in il_thermal */
    const il_real *coefficient; /* [piece][law][term]; the laws are b of x, y, z, rad/s; S of x, y, z, output per rad/s */
} il_thermal_gyro;

typedef struct {
    int32_t known;       /* 0: no temperature yet */
    unsigned flags;      /* of that temperature */
    il_real temperature; /* the last one, degC */
    il_gyro at;          /* the triad there */
} il_thermal_gyro_state;

/* As il_thermal_at, il_thermal_start, il_thermal_apply and il_thermal_block, from outputs and specific force [m/s^2] (may
 * be NULL without G) to angular rate [rad/s]; rate may be output. */
unsigned il_thermal_gyro_at(const il_thermal_gyro *settings, il_real temperature, il_gyro *at);
void il_thermal_gyro_start(il_thermal_gyro_state *state);
unsigned il_thermal_gyro_apply(const il_thermal_gyro *settings, il_thermal_gyro_state *state, il_real temperature,
                               const il_real output[3], const il_real force[3], il_real rate[3]);
unsigned il_thermal_gyro_block(const il_thermal_gyro *settings, size_t n, const il_real *temperature,
                               const il_real *const output[3], const il_real *const force[3], size_t stride,
                               il_real *const rate[3], size_t rate_stride);

/* ---- flexible gyroscope: drift K(a) (ax cos theta + ay sin theta), K(a) = K0 (1 + c1 a + c2 a^2) ------------------ */

typedef struct {
    int32_t has[2];             /* whether x, y were tested */
    il_real highest;            /* highest level tested, m/s^2 */
    il_real k0[2];              /* (rad/s)/(m/s^2) */
    il_real c1[2];              /* 1/(m/s^2) */
    il_real c2[2];              /* 1/(m/s^2)^2 */
    il_real cosine[2], sine[2]; /* of the direction theta */
} il_centrifuge;

/* Rates of the two input axes [rad/s], less the drift under the level specific force [m/s^2]; done in place. */
unsigned il_centrifuge_apply(const il_centrifuge *settings, const il_real force[2], il_real rate[2]);

/* The same for n samples; rate[i] may be NULL for an axis that is not there. */
unsigned il_centrifuge_block(const il_centrifuge *settings, size_t n, const il_real *const force[2],
                             il_real *const rate[2]);

/* ---- warm-up: bias Z(t) after power-on, selected by the temperature at power-on ----------------------------------- */

enum { IL_INTERVAL_CUBIC = 0, IL_KNOT_CUBIC = 1, IL_KNOT_LOG_CUBIC = 2, IL_EXPONENTIAL = 3 };
enum { IL_EXIT_ZERO = 0, IL_EXIT_HOLD = 1, IL_EXIT_TAPER = 2 };

typedef struct {
    int32_t model;               /* IL_INTERVAL_CUBIC ... */
    int32_t exit;                /* from the settling time on: IL_EXIT_ZERO ... */
    int32_t temperatures;        /* how many edges (interval model) or knots */
    int32_t axes;                /* how many channels the table corrects */
    int32_t terms;               /* coefficients per axis: 4, or the number of exponentials */
    il_real settling_time;       /* T_M, s */
    il_real taper_time;          /* s, from the settling time to zero (IL_EXIT_TAPER) */
    il_real time_scale;          /* tau0, s (IL_KNOT_LOG_CUBIC) */
    il_real time_constant[3];    /* s (IL_EXPONENTIAL) */
    const il_real *temperature;  /* ascending, degC */
    const il_real *coefficient;  /* [row][axis][term], SI unit of the axis */
    const il_real *slope;        /* [row][axis][term], the same per K (IL_EXPONENTIAL), else NULL */
} il_warmup;

typedef struct {
    int32_t active;          /* 0: the table does not cover this power-on temperature */
    int32_t row;             /* interval, or lower knot */
    il_real share[4];        /* of lower and upper value, lower and upper slope */
    il_real rate[3];         /* per tick: of u, or of t / tau0; or the exponents -tick / time_constant */
    il_real log_scale;       /* 1 / log(1 + T_M / tau0) */
    uint32_t settled, ended; /* ticks at T_M, and at the end of the taper */
    uint32_t span;           /* ticks, a power of two: exp and log1p are led on from multiples of it by a series */
} il_warmup_state;

/* Once, at power-on: pick the row. Outside the table, or for a temperature that is no number, nothing is corrected. */
il_status il_warmup_start(const il_warmup *settings, il_warmup_state *state, il_real temperature, il_real tick);

/* The bias of every axis, `ticks` ticks (of the length given at start) after power-on. */
void il_warmup_bias(const il_warmup *settings, const il_warmup_state *state, uint32_t ticks, il_real *bias);

/* n samples less their bias: output[i][k] = input[i][k] - factor[i] * bias of axis i. `factor`, by which columns in other
 * units are larger, may be NULL: 1. output[i] may be input[i], or NULL for an axis that is not there. */
void il_warmup_block(const il_warmup *settings, const il_warmup_state *state, size_t n, const uint32_t *ticks,
                     const il_real *const *input, const il_real *factor, il_real *const *output);

/* ---- gyro array: n gyros per axis, one or three axes, to one rate ------------------------------------------------- */

enum { IL_MEAN = 0, IL_SUPPORT, IL_LEAST_SQUARES, IL_FEEDBACK, IL_ROBUST, IL_COVARIANCE, IL_KALMAN, IL_METHODS };
enum { IL_FIRST = 0, IL_ZERO = 1, IL_GIVEN = 2 };
enum { IL_GAUSSIAN = 0, IL_EXPONENTIAL_KERNEL = 1 };

typedef struct {
    int32_t method;            /* IL_MEAN ... */
    int32_t elements;          /* gyros per axis, 1 to IL_ARRAY_ELEMENTS */
    int32_t axes;              /* 1 or 3 */
    int32_t initial;           /* bias at the first sample: IL_FIRST, IL_ZERO or IL_GIVEN */
    int32_t kernel;            /* of IL_SUPPORT: IL_GAUSSIAN or IL_EXPONENTIAL_KERNEL */
    uint32_t start;            /* growing memory begins at k = start, >= 1 */
    uint32_t cap;              /* robust: samples that its memory grows to */
    uint32_t stuck;            /* robust: identical readings that may make a gyro stuck */
    uint32_t jump;             /* robust: samples beyond the gate that make a bias jump */
    uint32_t quiet;            /* robust: samples that a returning gyro is watched */
    il_real memory;            /* fixed gain in (0, 1), or 0: growing memory, gain 1/k */
    il_real gate;              /* robust: standard deviations of a gyro's own noise */
    il_real spread_gate;       /* robust: standard deviations of the array in this sample */
    il_real scale_tolerance;   /* robust: share of the rate by which healthy gyros may differ, 1 */
    il_real weight_cap;        /* robust: largest weight of one gyro while it is new, 1 */
    il_real weight_floor;      /* robust: smallest variance, in mean variances, 1 */
    const il_real *offset;     /* [axes][elements] calibrated bias, subtracted first, or NULL */
    const il_real *matrix;     /* [elements][axes][axes] alignment and scale, applied after it, or NULL */
    const il_real *bias;       /* [axes][elements] bias at the first sample for IL_GIVEN */
    const il_real *weight;     /* [axes][elements] > 0: weights of IL_COVARIANCE; IL_ROBUST: 1 / variance, relative */
    const il_real *gain;       /* [axes][elements + 1][elements] Kalman gain of (rate, bias_1 .. bias_n) */
} il_array;

typedef struct {
    il_real rate;                           /* fused rate of the last sample */
    il_real common;                         /* bias common to all, from zero-rate updates */
    il_real spread;                         /* support: mean square difference of pairs */
    il_real filtered;                       /* kalman: rate */
    il_real resolution;                     /* robust: smallest change of a reading seen, 0 before any */
    il_real slow;                           /* robust: rate, smoothed over 10 ms */
    il_real motion_mean[2];                 /* robust: of change and hundredth of the rate, */
    il_real motion_square[3];               /* and their squares and product about it */
    uint32_t motion;                        /* robust: rates so far, up to 16; 17 while what moves with the rate is told apart */
    uint32_t count;                         /* samples so far, from settings.start on */
    uint32_t still;                         /* zero-rate updates so far */
    uint32_t clean;                         /* robust: samples not yet counted in seen, compared, changed */
    uint32_t well;                          /* robust: not 0 while no gyro is under suspicion */
    il_real bias[IL_ARRAY_ROOM];        /* estimated */
    il_real variance[IL_ARRAY_ROOM];    /* of the noise, estimated */
    il_real weight[IL_ARRAY_ROOM];      /* in the last fused sample */
    il_real last[IL_ARRAY_ELEMENTS];        /* last finite reading */
    il_real ratio[IL_ARRAY_ROOM];       /* variance by calibration, in mean variances */
    il_real fast[IL_ARRAY_ROOM];        /* mean residual of the last second or so */
    il_real late[IL_ARRAY_ROOM];        /* robust: residual in a change of the rate within 10 ms, */
    il_real scale[IL_ARRAY_ROOM];       /* and in a hundredth of the rate */
    il_real away_mean[IL_ARRAY_ELEMENTS];   /* of a run of gated readings, */
    il_real away_square[IL_ARRAY_ELEMENTS]; /* and the sum of squares about it */
    uint32_t seen[IL_ARRAY_ELEMENTS];       /* residuals learnt from */
    uint32_t repeats[IL_ARRAY_ELEMENTS];    /* identical readings in a row, less one */
    uint32_t compared[IL_ARRAY_ELEMENTS];   /* finite readings */
    uint32_t changed[IL_ARRAY_ELEMENTS];    /* finite readings that differ from the one before */
    uint32_t bad[IL_ARRAY_ELEMENTS];        /* samples in a row without a reading to use */
    uint32_t calm[IL_ARRAY_ELEMENTS];       /* good samples in a row while waiting */
    uint32_t away[IL_ARRAY_ELEMENTS];       /* gated readings in a row */
    uint8_t standing[IL_ARRAY_ELEMENTS];    /* stuck, waiting, learnt anew, jumped */
    uint8_t flags[IL_ARRAY_ELEMENTS];       /* IL_NOT_FINITE ... of the last sample */
} il_array_axis;

typedef struct {
    il_array_axis axis[3];
} il_array_state;

/* Whether settings can be run; IL_OK or IL_ARGUMENT. */
il_status il_array_check(const il_array *settings);

/* Clear the state for the first sample. */
il_status il_array_start(const il_array *settings, il_array_state *state);

/* One sample, reading[axis * elements + element], to the fused rate[axis]; flags and weights are in the state. */
unsigned il_array_step(const il_array *settings, il_array_state *state, const il_real *reading, il_real *rate);

/* The unit stood still in the sample just fused: what is left of its rate is bias common to all gyros. */
void il_array_still(const il_array *settings, il_array_state *state);

/* n samples; flags and weights [sample][axis][element] and still [sample] may be NULL. Returns the flags met, or-ed;
 * without flags and weights those are only IL_NOT_FINITE of a fused rate, and all of the last sample. */
unsigned il_array_block(const il_array *settings, il_array_state *state, size_t n, const il_real *reading,
                        const uint8_t *still, il_real *rate, uint8_t *flags, il_real *weight);

/* ---- whole IMUs on one rigid board, to one specific force, rate and angular acceleration ---------------------------
 * Accelerometers read y = Ta (s + (W^2 + [al]x) r) + ba, gyroscopes z = Tg w + bg; W = [w]x, al = dw/dt. */

#ifndef IL_IMUS
#define IL_IMUS 32 /* each costs 26 words of state */
#endif

typedef struct {
    int32_t count;              /* IMUs, 2 to IL_IMUS */
    uint32_t stuck;             /* identical samples that may make a triad stuck */
    uint32_t quiet;             /* most good samples that a returning triad is watched */
    il_real gate;               /* chi-square of three degrees of freedom, beyond which a triad is left out */
    il_real at[3];              /* where the specific force is wanted, m */
    const il_real *position;    /* [count][3], m */
    const il_real *accel;       /* [count][3][3] Ta^-1, 1 */
    const il_real *accel_bias;  /* [count][3] ba, m/s^2 */
    const il_real *accel_noise; /* [count] standard deviation of a reading, m/s^2 */
    const il_real *accel_limit; /* [count] size of a reading at the end of the range, m/s^2 */
    const il_real *gyro;        /* [count][3][3] Tg^-1, 1 */
    const il_real *gyro_bias;   /* [count][3] bg, rad/s */
    const il_real *gyro_noise;  /* [count] rad/s */
    const il_real *gyro_limit;  /* [count] rad/s */
    const il_real *gyro_rows;   /* [count][3][3] Tg, 1 */
} il_imus;

typedef struct {
    int32_t members;                   /* accelerometers used in the last sample; what follows is of these: */
    int32_t by_gyroscopes;             /* judged with the angular acceleration of the gyroscopes */
    uint32_t unknown;                  /* bits of the principal axes about which they tell no angular acceleration */
    il_real weight;                    /* sum of 1 / variance */
    il_real centroid[3];               /* m */
    il_real axes[3][3];                /* principal axes, as columns */
    il_real root[3];                   /* square roots of the principal moments sum p rho rho' */
    il_real inertia[3];                /* (tr R I - R)^-1 */
    il_real leverage[IL_IMUS][3][3];   /* inverse covariance of a residual */
    il_real last[6 * IL_IMUS];         /* last readings */
    il_real share[2][IL_IMUS];         /* 1 / variance of accelerometers and gyroscopes */
    il_real before[3];                 /* rate of the gyroscopes in the sample before, rad/s, */
    il_real turning[3];                /* and how it changed into that, rad/s^2 */
    il_real step;                      /* s, since that */
    int32_t known;                     /* samples in a row with a rate of the gyroscopes, up to 3 */
    uint32_t repeats[2][IL_IMUS];      /* accelerometers, gyroscopes: identical readings in a row, less one */
    uint32_t compared[2][IL_IMUS];     /* readings that are numbers */
    uint32_t changed[2][IL_IMUS];      /* those that differ from the one before */
    uint32_t owed[2][IL_IMUS];         /* good samples until it is used again */
    uint8_t used[IL_IMUS];             /* accelerometers */
    uint8_t flags[2][IL_IMUS];         /* IL_NOT_FINITE ... of the last sample */
} il_imus_state;

typedef struct {
    il_real force[3], rate[3], acceleration[3];             /* at settings.at, m/s^2; rad/s; rad/s^2 */
    il_real force_std[3], rate_std[3], acceleration_std[3]; /* standard uncertainties from the noise */
} il_imus_fused;

/* Whether settings can be run; IL_OK or IL_ARGUMENT. */
il_status il_imus_check(const il_imus *settings);

/* Clear the state for the first sample. */
il_status il_imus_start(const il_imus *settings, il_imus_state *state);

/* One sample: count accelerometers x, y, z [m/s^2], then count gyroscopes [rad/s]; `step` seconds after the one before, or 0
 * where that is not known. IL_BEYOND: a gyroscope is at the end of its range, and the accelerometers tell the rate.
 * IL_ALONE: fewer than three accelerometers are left. What is not determined is not a number. */
unsigned il_imus_step(const il_imus *settings, il_imus_state *state, il_real step, const il_real *reading,
                      il_imus_fused *fused);

/* n samples; flags [sample] and health [sample][2][count], of accelerometers and gyroscopes, may be NULL. */
unsigned il_imus_block(const il_imus *settings, il_imus_state *state, size_t n, const il_real *step, const il_real *reading,
                       il_imus_fused *fused, uint8_t *flags, uint8_t *health);

/* ---- all that one unit has, from a table ("blob") ----------------------------------------------------------------- */

enum { IL_HAS_TUMBLE = 1, IL_HAS_GYRO = 2, IL_HAS_CENTRIFUGE = 4, IL_HAS_WARMUP = 8, IL_HAS_ARRAY = 16, IL_HAS_MAG = 32,
       IL_HAS_THERMAL = 64, IL_HAS_THERMAL_GYRO = 128, IL_HAS_IMUS = 256 };

typedef struct {
    uint32_t has; /* IL_HAS_TUMBLE ... or-ed */
    il_tumble tumble;
    il_gyro gyro;
    il_centrifuge centrifuge;
    il_warmup warmup;
    il_array array;
    il_mag mag;
    il_thermal thermal;
    il_thermal_gyro thermal_gyro;
    il_imus imus;
} il_unit;

/* Check a table and unpack it; arrays go to the caller's memory, which must outlive the unit; the bytes need not. On
 * failure unit->has is 0. `size / 4` numbers of memory are always enough. */
il_status il_table_load(il_unit *unit, const uint8_t *bytes, size_t size, il_real *memory, size_t capacity);

/* CRC-32 (IEEE 802.3) of n bytes. */
uint32_t il_crc32(const uint8_t *bytes, size_t n);

/* A few words for a status, for messages. */
const char *il_status_text(il_status status);

#ifdef __cplusplus
}
#endif
#endif

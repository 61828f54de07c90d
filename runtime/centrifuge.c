/* Flexible gyroscope: removes the acceleration-sensitive drift measured on the centrifuge. */
#include "real.h"

unsigned il_centrifuge_apply(const il_centrifuge *settings, const il_real force[2], il_real rate[2]) {
    il_real a = il_sqrt(force[0] * force[0] + force[1] * force[1]);
    unsigned flags = il_finite(a) ? 0u : (unsigned)IL_NOT_FINITE;
    if (a > settings->highest) flags |= IL_BEYOND;
    for (int i = 0; i < 2; i++) {
        if (!settings->has[i]) continue;
        il_real k = settings->k0[i] * (IL_C(1.0) + a * (settings->c1[i] + a * settings->c2[i]));
        rate[i] -= k * (force[0] * settings->cosine[i] + force[1] * settings->sine[i]);
        if (!il_finite(rate[i])) {
            rate[i] = il_nan();
            flags |= IL_NOT_FINITE;
        }
    }
    return flags;
}

unsigned il_centrifuge_block(const il_centrifuge *settings, size_t n, const il_real *const force[2],
                             il_real *const rate[2]) {
    unsigned flags = 0;
    for (size_t k = 0; k < n; k++) {
        const il_real f[2] = {force[0][k], force[1][k]};
        il_real w[2] = {IL_C(0.0), IL_C(0.0)};
        for (int i = 0; i < 2; i++) {
            if (rate[i] != NULL) w[i] = rate[i][k];
        }
        flags |= il_centrifuge_apply(settings, f, w);
        for (int i = 0; i < 2; i++) {
            if (rate[i] != NULL) rate[i][k] = w[i];
        }
    }
    return flags;
}

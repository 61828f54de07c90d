/* Checks that count, and the tests themselves. No framework: a failed check prints its line, main() returns the verdict. */
#ifndef CHECK_H
#define CHECK_H

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "imulab.h"

void check_that(int holds, const char *file, int line, const char *what);
void check_close(il_real found, il_real expected, il_real limit, const char *file, int line, const char *what);

#define CHECK(condition) check_that((condition) != 0, __FILE__, __LINE__, #condition)

/* |found - expected| <= limit, or neither is a number. */
#define CHECK_CLOSE(found, expected, limit) check_close(found, expected, limit, __FILE__, __LINE__, #found)

/* To the last bit, for arrays of n items. */
#define CHECK_SAME(a, b, n) check_that(memcmp(a, b, (n) * sizeof *(a)) == 0, __FILE__, __LINE__, #a " same as " #b)

#define REAL(x) ((il_real)(x))
#define NAN_REAL ((il_real)NAN)
#define INF_REAL ((il_real)INFINITY)
#define LENGTH(array) (sizeof(array) / sizeof *(array))

enum { IS_FLOAT = sizeof(il_real) == sizeof(float) };

/* What rounding may cost, as a fraction of full scale. */
#define ROUNDING_LIMIT (IS_FLOAT ? REAL(2e-6) : REAL(1e-13))

/* The same numbers on every machine: uniform in [-1, 1), multiples of 2^-20. */
il_real random_real(void);

void test_triads(void);
void test_thermal(void);
void test_warmup(void);
void test_array(void);
void test_robust(void);
void test_imus(void);
void test_table(void);

#endif

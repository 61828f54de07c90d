/* Runs all tests of the C core; prints one line, exits 0 when every check held. */
#include "check.h"

static unsigned long checks, failures;

void check_that(int holds, const char *file, int line, const char *what) {
    checks++;
    if (holds) return;
    failures++;
    printf("%s:%d: %s\n", file, line, what);
}

void check_close(il_real found, il_real expected, il_real limit, const char *file, int line, const char *what) {
    const il_real error = found < expected ? expected - found : found - expected;
    const int holds = error <= limit || (found != found && expected != expected);
    check_that(holds, file, line, what);
    if (!holds) printf("    found %.17g, expected %.17g\n", (double)found, (double)expected);
}

il_real random_real(void) {
    static uint32_t state = 1u;
    state = state * 1664525u + 1013904223u;
    return REAL((int32_t)(state >> 11)) / REAL(1 << 20) - REAL(1);
}

int main(void) {
    test_triads();
    test_thermal();
    test_warmup();
    test_array();
    test_robust();
    test_imus();
    test_table();
    printf("C core, %s: %lu checks, %lu failed\n", IS_FLOAT ? "float" : "double", checks, failures);
    return failures == 0 ? EXIT_SUCCESS : EXIT_FAILURE;
}

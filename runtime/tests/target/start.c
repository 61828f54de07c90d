/* From reset to main() on a Cortex-M4F; printf and exit go to the emulator by semihosting (newlib's rdimon). */
#include <stdint.h>

extern uint32_t data_start, data_end, data_load, bss_start, bss_end;
void initialise_monitor_handles(void);
int main(void);
void exit(int status);
void reset(void);
void _init(void);
void _fini(void);

#define COPROCESSORS (*(volatile uint32_t *)0xE000ED88u)

void reset(void) {
    COPROCESSORS |= 0xFu << 20; /* the floating-point unit on */
    __asm volatile("dsb\n isb");
    for (uint32_t *to = &data_start, *from = &data_load; to < &data_end;) *to++ = *from++;
    for (uint32_t *to = &bss_start; to < &bss_end;) *to++ = 0;
    initialise_monitor_handles();
    exit(main());
}

void _init(void) {}

void _fini(void) {}

static void fault(void) {
    exit(99); /* a trap of any kind: the core must never cause one */
}

__attribute__((section(".vectors"), used)) static void (*const vectors[])(void) = {
    (void (*)(void))0x20400000u, reset, fault, fault, fault, fault, fault,
};

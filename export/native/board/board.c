/* A detector and a recording in flash, on a board that QEMU emulates: prints every alarm, the
 * instructions of decisions and the memory that they took, as lines of JSON. Nothing but the
 * detector and this file is in the image: no printf, no heap, no system. */
#include <stdint.h>

#include "tactslip.h"

#ifndef STATE_BYTES
#define STATE_BYTES (1 << 20)
#endif
enum { STACK_WORDS = 4096, PER_TICK = 40, PUSH = 10 }; /* 40 ns, of an instruction each: -icount shift=0 */

extern const uint64_t tactslip_detector[];
extern const size_t tactslip_detector_bytes;
extern const int16_t recording[];
extern const size_t recording_samples;
extern uint32_t data_begin[], data_end[], data_kept[], bss_begin[], bss_end[], stack_end[];

static uint64_t state[STATE_BYTES / 8];
static volatile uint32_t *const TICKS = (uint32_t *)0xE000E010; /* SysTick: control, reload, value */

int main(void);
void start(void);

/* Semihosting: 4 writes a text, 0x18 ends the program. */
static void call_host(int what, const void *with) {
    register int r0 __asm__("r0") = what;
    register const void *r1 __asm__("r1") = with;
    __asm__ volatile("bkpt 0xab" : "+r"(r0) : "r"(r1) : "memory");
}

static void say(const char *text) { call_host(4, text); }

static void say_number(const char *before, uint64_t number) {
    char text[24], *at = text + sizeof text;
    *--at = 0;
    do *--at = (char)('0' + number % 10);
    while (number /= 10);
    say(before);
    say(at);
}

static void say_us(const char *before, double seconds) {
    say_number(before, (uint64_t)(seconds * 1e6 + 0.5));
}

/* What ticked since; the counter runs down from 2^24 - 1. */
static uint64_t instructions_since(uint32_t then) {
    return (uint64_t)((then - TICKS[2]) & 0xFFFFFF) * PER_TICK;
}

int main(void) {
    struct tactslip_info info;
    struct tactslip *slip;
    struct tactslip_decision decision;
    uint64_t of_bins = 0, most = 0, num = 0, taken, of_pushes = 0;
    TICKS[1] = 0xFFFFFF, TICKS[2] = 0, TICKS[0] = 5;
    uint32_t then = TICKS[2];
    int code = tactslip_open(tactslip_detector, tactslip_detector_bytes, &info);
    uint64_t of_open = instructions_since(then);
    if (!code)
        code = tactslip_init(tactslip_detector, tactslip_detector_bytes, state, sizeof state, &slip);
    if (code) {
        say("error: ");
        say(tactslip_error(code));
        return 1;
    }
    uint32_t *stack = stack_end - STACK_WORDS;
    for (uint32_t *at = stack; at < (uint32_t *)&code - 64; at++) *at = 0xA5A5A5A5;
    for (size_t at = 0; at < recording_samples;) {
        size_t n = recording_samples - at < PUSH ? recording_samples - at : PUSH;
        then = TICKS[2];
        at += tactslip_push_int16(slip, recording + at * info.num_channels, n);
        of_pushes += instructions_since(then);
        for (then = TICKS[2]; tactslip_next(slip, &decision); then = TICKS[2]) {
            taken = instructions_since(then);
            of_bins += taken, num++;
            most = taken > most ? taken : most;
            if (decision.is_alarm) {
                say_us("{\"alarm_us\": ", decision.time_s);
                say_us(", \"onset_us\": ", decision.onset_s);
                say("}\n");
            }
        }
    }
    while (*stack == 0xA5A5A5A5) stack++;
    say_number("{\"decisions\": ", num);
    say_number(", \"instructions\": ", of_bins / num);
    say_number(", \"most_instructions\": ", most);
    say_number(", \"instructions_of_sample\": ", of_pushes / recording_samples);
    say_number(", \"instructions_of_open\": ", of_open);
    say_number(", \"hop_samples\": ", info.hop_samples);
    say_number(", \"state_bytes\": ", info.state_bytes);
    say_number(", \"stack_bytes\": ", (uint64_t)(stack_end - stack) * 4);
    say("}\n");
    return 0;
}

void start(void) {
    *(volatile uint32_t *)0xE000ED88 |= 0xF << 20; /* floating point on */
    __asm__ volatile("dsb\nisb");
    const uint32_t *from = data_kept;
    for (uint32_t *to = data_begin; to < data_end;) *to++ = *from++;
    for (uint32_t *to = bss_begin; to < bss_end;) *to++ = 0;
    call_host(0x18, (const void *)(uintptr_t)(main() ? 0x20023 : 0x20026)); /* failed, or ended */
    for (;;) {}
}

static void fault(void) {
    say("error: fault\n");
    call_host(0x18, (const void *)0x20023);
}

__attribute__((section(".vectors"), used)) static const void *const vectors[16] = {
    stack_end, (void *)start, (void *)fault, (void *)fault, (void *)fault, (void *)fault, (void *)fault};

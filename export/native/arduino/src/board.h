// What this program needs of a board. board.cpp of your own holds it; on a Teensy an IntervalTimer
// and an SPI converter, say.
#pragma once
#include <stdint.h>

void board_start_timer(double rate_hz, void (*on_timer)());  // calls it at this rate, in an interrupt
void board_read_counts(int16_t* counts);                     // of all channels, in the detector's order
void board_set_slip(bool is_slipping);
void board_report(const char* text);

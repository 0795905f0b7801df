// A hand on a microcontroller: a timer interrupt reads the converter into a ring, the loop hands the
// ring to the detector and switches a pin while an alarm stands.
//
// What is the board's own stands in board.h: the timer, the converter, the pin.

#include <stdint.h>

#include "board.h"
#include "tactslip.h"

extern "C" const uint64_t tactslip_detector[];  // detector.c, of tactslip export
extern "C" const size_t tactslip_detector_bytes;

namespace {

constexpr uint32_t CHANNELS = 24, PLACES = 256;  // instants in the ring, a power of two: 128 ms at 2 kHz
constexpr size_t STATE_BYTES = 48 * 1024;        // at least what tactslip_open says

alignas(8) uint8_t state[STATE_BYTES];
int16_t ring[PLACES][CHANNELS];
volatile uint32_t written = 0;  // instants so far, by the interrupt alone
uint32_t taken = 0;             // by the loop alone
tactslip* slip = nullptr;

void on_timer() {  // every 500 us
  board_read_counts(ring[written % PLACES]);
  __atomic_store_n(&written, written + 1, __ATOMIC_RELEASE);
}

void stop(const char* why) {
  board_report(why);
  for (;;) {}
}

}  // namespace

void setup() {
  tactslip_info info;
  int code = tactslip_open(tactslip_detector, tactslip_detector_bytes, &info);
  if (!code) code = tactslip_init(tactslip_detector, tactslip_detector_bytes, state, sizeof state, &slip);
  if (code) stop(tactslip_error(code));
  if (info.num_channels != CHANNELS) stop("a detector of other channels");
  board_start_timer(info.sample_rate_hz, on_timer);
}

void loop() {
  uint32_t waiting = __atomic_load_n(&written, __ATOMIC_ACQUIRE) - taken;
  if (waiting >= PLACES) {  // the loop came too late: what was overwritten is missing
    uint32_t lost = waiting - PLACES / 2;
    for (uint32_t at = 0; at < lost; at += tactslip_push(slip, nullptr, lost - at)) {
      tactslip_decision skipped;
      while (tactslip_next(slip, &skipped)) {}
    }
    taken += lost;
    return;
  }
  uint32_t place = taken % PLACES, rows = waiting < PLACES - place ? waiting : PLACES - place;
  taken += (uint32_t)tactslip_push_int16(slip, ring[place], rows);
  tactslip_decision decision;
  while (tactslip_next(slip, &decision)) board_set_slip(decision.is_on);
}

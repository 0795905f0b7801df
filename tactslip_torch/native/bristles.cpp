// The scheme of simulation/_bristles.py, which defines it: lanes of skin and bristles through time.
//
// A vector holds one quantity of as many lanes, each with the steps of Newton that the definition
// takes; those that are done wait for the slowest. No lane depends on its neighbours.

#include "engine.h"
#include "vectors.h"

namespace {

typedef Lanes<double>::V D;
constexpr int DL = Lanes<double>::NUM;

constexpr double FADED = 6.5;  // Stribeck speeds, beyond which exp(-r^2) is no part of 1
constexpr double EPS = 0x1p-52, CLOSE = 0x1p-26;
constexpr double LEAST_LOAD = 1.221338669755462e-77;  // fourth root of the smallest normal number

// What a lane is given, in the order of the rows of a table, and its state.
struct Lane {
  D mass, k, k1, tau, c, mu_s, mu_k, stribeck, s, d0, relaxed, inertia;
};
struct State {
  D u, v, q;
};

// One implicit stage of length a; x is the patch's speed, turned so that it is not negative.
struct Stage {
  Lane own;
  State base;
  D arm, load, turn, offset, low, high, x, rate_v;
  D mu, mu_slope, force, slope;
  double a;

  // Friction coefficient and its slope at the speeds; exp(-r^2) as a power of 256.
  void friction() {
    D ratio = smaller(x / own.stribeck, D{} + FADED);
    D y = ratio * ratio * (-1.0 / 256.0), power = D{} + 1.0;
    for (int k = 11; k > 0; --k) power = 1.0 + y / (double)k * power;
    for (int k = 0; k < 8; ++k) power *= power;
    power = ratio < FADED ? power : D{};
    D fading = (own.mu_s - own.mu_k) * power;
    mu = own.mu_k + fading;
    mu_slope = fading * (-2.0 * ratio / own.stribeck);
  }

  // What bristles start from, the side of the root and its bracket.
  void begin(const D* z, D* bent, const double* pressure, int64_t n) {
    D ahead = own.relaxed * (base.q + a * own.k1 * arm);
    D pulled = own.k * (base.u + a * arm) + ahead;
    offset = -own.mass * base.v - a * (pulled + own.c * arm);
    load = load > LEAST_LOAD ? load : D{};
    force = D{};
    for (int64_t i = 0; i < n; ++i) {
      D most = load * pressure[i] * (own.mu_s / own.s);
      bent[i] = smaller(larger(z[i], -most), most);
      force += own.s * bent[i];
    }
    turn = offset + a * force > 0.0 ? D{} - 1.0 : D{} + 1.0;
    offset *= turn;
    high = larger((3.0 * a * own.mu_s * load - offset) / own.inertia, D{});
    low = D{};
    x = smaller(larger(turn * x, D{}), high);
    for (int64_t i = 0; i < n; ++i) bent[i] *= turn;
  }

  // Force and slope of all bristles at the speeds: _Stage.pull.
  void pull(const D* bent, const double* pressure, int64_t n) {
    friction();
    force = slope = D{};
    D lag = a * own.s;
    for (int64_t i = 0; i < n; ++i) {
      D held = load * pressure[i];
      D most = held * own.mu_k, g = held * mu, g_slope = held * mu_slope;
      D below = held > 0.0 ? g + lag * x : D{} + 1.0;
      D damped = held > 0.0 ? most + own.d0 * x : D{} + 1.0;
      D both = 1.0 / (below * damped), share = damped * both;
      damped = below * both;
      D reached = bent[i] + a * x, bristle = g * reached * share;
      D free = g - own.s * bent[i], rate = x * free * share;
      D damping = own.d0 * most * damped;
      force += own.s * bristle + damping * rate;
      slope += (own.s * (g_slope * reached + g * a - bristle * (g_slope + lag)) +
                damping * (free + x * g_slope - rate * (g_slope + lag))) * share -
               damping * own.d0 * damped * rate;
    }
  }

  // The root of the stage's equation: _Stage.root. It ends: see _PATIENCE.
  void solve(const D* bent, const double* pressure, int64_t n, int64_t patience) {
    D done = {}, tried = {};
    for (int64_t number = 0; any(done == 0.0); ++number) {
      pull(bent, pressure, n);
      bool late = number >= patience, halve = late && number % 2;
      D left = inertia_at() + offset + a * force;
      auto exact = magnitude(left) <=
                   4.0 * EPS * (inertia_at() + magnitude(offset) + a * magnitude(force));
      D wanted = x - left / (own.inertia + a * slope);
      high = left < 0.0 ? high : x;
      low = left < 0.0 ? x : low;
      auto inside = (wanted >= low) & (wanted <= high);
      if (halve) inside = inside & ~inside;
      auto to_low = ~inside & ~exact & (tried == 0.0);
      if (late) to_low = to_low & ~to_low;
      D half = low + 0.5 * (high - low);
      auto is_empty = ~((half > low) & (half < high));  // no number between, or NaN
      auto close = exact | (inside & (magnitude(wanted - x) <= CLOSE * x)) | is_empty;
      D other = to_low ? low : half;
      other = exact ? x : other;
      wanted = inside ? wanted : other;
      x = done > 0.0 ? x : wanted;
      tried = to_low ? D{} + 1.0 : tried;
      done = close ? D{} + 1.0 : done;
    }
  }
  D inertia_at() const { return own.inertia * x; }

  // The stage's end, and from there `rest` seconds of its rates.
  void end(State& state, D* z, const D* bent, D* rates, const double* pressure, int64_t n,
           double rest) {
    friction();
    for (int64_t i = 0; i < n; ++i) {
      D held = load * pressure[i], g = held * mu;
      D share = turn / (held > 0.0 ? g + a * own.s * x : D{} + 1.0);
      rates[i] = x * (g - own.s * bent[i]) * share;
      z[i] = g * (bent[i] + a * x) * share + rest * rates[i];
    }
    D v = turn * x, stretching = arm - v;
    D q = own.relaxed * (base.q + a * own.k1 * stretching);
    rate_v = (v - base.v) / a;
    state.u = base.u + (a + rest) * stretching;
    state.v = v + rest * rate_v;
    state.q = q + rest * (own.k1 * stretching - q / own.tau);
  }
};

}  // namespace

namespace LEVEL {

size_t bristles_space(const BristleRun* run) { return (3 * run->num_bristles + 1) * sizeof(D); }

void bristles(const BristleRun* run, void* space) {
  int64_t num_lanes = run->num_lanes, n = run->num_bristles;
  D* z = (D*)aligned((char*)space);
  D *bent = z + n, *rates = bent + n;
  for (int64_t first = 0; first < num_lanes; first += DL) {
    int64_t lane[DL];  // the last lane fills up the last vector
    for (int b = 0; b < DL; ++b) lane[b] = first + b < num_lanes ? first + b : num_lanes - 1;
    auto gather = [&lane](const double* row) {
      D v;
      for (int b = 0; b < DL; ++b) v[b] = row[lane[b]];
      return v;
    };
    Stage stage;
    stage.a = run->gamma * run->step_s;
    D* own = (D*)&stage.own;
    for (int r = 0; r < 12; ++r) own[r] = gather(run->table + r * num_lanes);
    State state;
    D* of_state = (D*)&state;
    for (int r = 0; r < 3; ++r) of_state[r] = gather(run->states + r * num_lanes);
    for (int64_t i = 0; i < n; ++i)
      for (int b = 0; b < DL; ++b) z[i][b] = run->bristles[lane[b] * n + i];
    for (int64_t step = 0; step < run->num_steps; ++step) {
      D start = state.v;
      stage.x = start;
      for (int which = 0; which < 2; ++which) {
        stage.arm = gather(run->arm + (2 * step + which) * num_lanes);
        stage.load = gather(run->load + (2 * step + which) * num_lanes);
        stage.base = state;
        stage.begin(z, bent, run->pressure, n);
        stage.solve(bent, run->pressure, n, run->patience);
        double rest = (1 - which) * (run->step_s - 2.0 * stage.a);
        stage.end(state, z, bent, rates, run->pressure, n, rest);
        stage.x = start + (stage.turn * stage.x - start) / run->gamma;
      }
      if ((step + 1) % run->every) continue;
      D slip = state.v, friction = stage.own.k * state.u + state.q;
      for (int64_t i = 0; i < n; ++i) slip -= run->pressure[i] * rates[i];
      D inertia = stage.own.mass * stage.rate_v;
      int64_t row = (step + 1) / run->every - 1, size = run->num_steps / run->every * num_lanes;
      for (int b = 0; b < DL && first + b < num_lanes; ++b) {
        double* to = run->out + row * num_lanes + first + b;
        to[0] = friction[b];
        to[size] = inertia[b];
        to[2 * size] = slip[b];
      }
    }
    for (int b = 0; b < DL && first + b < num_lanes; ++b) {
      for (int r = 0; r < 3; ++r) run->states[r * num_lanes + first + b] = of_state[r][b];
      for (int64_t i = 0; i < n; ++i) run->bristles[(first + b) * n + i] = z[i][b];
    }
  }
}

}  // namespace LEVEL

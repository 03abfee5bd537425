/* The work unit and nothing around it: the bound for what a batch of it can cost on one core.
 *
 * The closed loop of benches/work_unit.toml for VECTOR * BLOCKS scenarios side by side: semi-implicit Euler at the servo
 * rate, the hand's true force, a wall, the windowed safety controller (paper Eq. 11 and 13) and the two sums that
 * benches/batch.py compares. All state stands in registers but the ring of the window. No parameter is read, no fault
 * looked for, nothing else measured.
 */
#include <cstddef>
#include <cstdint>

using std::size_t;

#define WINDOW 100
#define WIDTH (VECTOR * BLOCKS)
#define EACH_BLOCK _Pragma("GCC unroll 16") for (size_t b = 0; b < BLOCKS; b++)

typedef double lanes __attribute__((vector_size(8 * VECTOR)));
typedef int64_t mask __attribute__((vector_size(8 * VECTOR)));

static inline lanes splat(double value) { return value - (lanes){0}; }

static void run(const double *depth, size_t ticks, double *peaks, int64_t *ons)
{
    const double mass = 0.157, viscous = -0.005, coulomb = 0.038, wall_stiffness = 200.0;
    const double stiffness = 300.0, damping = 5.0, safety_damping = 5.0, ratio = 0.5, threshold = -0.03, h = 1e-3;
    const lanes zero = {0}, one = splat(1.0);
    lanes end[BLOCKS], z[BLOCKS], v[BLOCKS], sum[BLOCKS], peak[BLOCKS], ring[WINDOW][BLOCKS];
    mask on[BLOCKS];
    EACH_BLOCK
    {
        for (size_t lane = 0; lane < VECTOR; lane++)
            end[b][lane] = -depth[b * VECTOR + lane] - 0.02;
        z[b] = splat(0.02);
        v[b] = sum[b] = peak[b] = zero;
        on[b] = (mask){0};
    }
    for (size_t i = 0; i < WINDOW; i++)
        EACH_BLOCK ring[i][b] = zero;
    size_t next = 0;
    for (size_t k = 0; k < ticks; k++) {
        const double t = (double)k * h;
        double grip = 1.0 - (t - 1.0) / 0.05;
        grip = grip < 0.0 ? 0.0 : grip > 1.0 ? 1.0 : grip;
        const double s = 2.0 * t < 1.0 ? 2.0 * t : 1.0;
        const double share = s * s * (3.0 - 2.0 * s);
        EACH_BLOCK
        {
            const lanes target = 0.02 + end[b] * share;
            const lanes hand = grip * (stiffness * (target - z[b]) - damping * v[b]);
            const lanes wall = z[b] < zero ? -wall_stiffness * z[b] : zero;
            const lanes power = hand * v[b];
            sum[b] += power - ring[next][b];
            ring[next][b] = power;
            const mask trips = h * sum[b] - (mass / (2.0 * ratio)) * v[b] * v[b] < splat(threshold);
            on[b] -= trips;
            const lanes control = trips ? -wall - safety_damping * v[b] : zero;
            lanes slip = v[b] / splat(1e-3);
            slip = slip > one ? one : slip;
            slip = slip < -one ? -one : slip;
            v[b] += h * (hand + wall + control - viscous * v[b] - coulomb * slip) / splat(mass);
            z[b] += h * v[b];
            if (t >= 1.0)
                peak[b] = v[b] > peak[b] ? v[b] : peak[b];
        }
        next = next + 1 == WINDOW ? 0 : next + 1;
    }
    EACH_BLOCK for (size_t lane = 0; lane < VECTOR; lane++)
    {
        peaks[b * VECTOR + lane] = peak[b][lane];
        ons[b * VECTOR + lane] = on[b][lane];
    }
}

extern "C" {

/* How many scenarios stand side by side. */
size_t bare_width() { return WIDTH; }

/* Peak in m/s and ticks under intervention of each of `scenarios`, a multiple of the width, from its depth in m. */
void bare_kernel(const double *depth, size_t scenarios, size_t ticks, double *peaks, int64_t *ons)
{
    for (size_t first = 0; first < scenarios; first += WIDTH)
        run(depth + first, ticks, peaks + first, ons + first);
}
}
